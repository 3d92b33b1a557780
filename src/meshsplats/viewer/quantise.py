"""Meshes and splats for the viewer, quantised to a few bytes a triangle.

How fine the steps are, and how large that makes the page. ``packing`` says how the numbers are stored.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshsplats.cameras.framing import scene_bounds
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewer.packing import SAMPLE, Precision, pack_in_order, pack_mesh, pack_splats, vertex_order
from meshsplats.viewer.unpacking import unpack_mesh

BYTES_A_TRIANGLE = 8.5
"""The finest of ``PRECISIONS`` is used whose data, without spherical harmonics, stays below this; the
coarsest, where none does..."""

SMALL = 1_000_000
"""... and the finest for meshes of fewer bytes in all."""

RUNS = 12
"""Runs of neighbours from which the size of a page is estimated."""

PRECISIONS = (
    Precision(21, 16, 16),
    Precision(19, 13, 13),
    Precision(18, 12, 12),
    Precision(17, 11, 12),
    Precision(16, 10, 11),
    Precision(15, 9, 10),
    Precision(15, 8, 9),
    Precision(14, 8, 8),
    Precision(13, 8, 8),
)
"""From the finest to the coarsest. Views of the whole scene are about 2^11 pixels wide, so the finest steps
are 1/1000 of a pixel there, the coarsest a quarter. Where layers nearly touch, steps of 1/64 still change
their order in a few pixels, by several levels."""


@dataclass(frozen=True, eq=False)
class QuantisedMesh:
    """A mesh as packed data, and how far it is from the mesh it was made of."""

    data: bytes
    decoded: SplatMesh
    """The mesh in ``data``, as from ``unpack_mesh``."""
    triangles: int
    precision: Precision
    position_error: float
    """Largest distance of a vertex along an axis, scene units."""
    relative_error: float
    """The same in radii of the scene (90 % of its opacity)."""
    color_error: float
    """Largest difference of a channel, in levels of 255."""
    alpha_error: float
    """Largest difference of an opacity, in levels of 255."""

    @property
    def bytes_a_triangle(self) -> float:
        return len(self.data) / max(self.triangles, 1)


def quantise_mesh(mesh: SplatMesh, limit: float = BYTES_A_TRIANGLE) -> QuantisedMesh:
    """``mesh`` in at most about ``limit`` bytes a triangle, and its spherical harmonics in 8 bits each.
    Normals, attributes and the binding of a mesh prior are left out: images do not need them.

    Raises ValueError for a mesh without triangles.
    """
    if not len(mesh.faces):
        raise ValueError("the mesh has no triangles, so there is nothing to view")
    radius = scene_bounds(mesh).radius
    chosen = _finest(mesh, radius, limit)
    order = vertex_order(mesh)
    data = pack_in_order(mesh, order, chosen, radius)
    back = unpack_mesh(data)
    vertices, colors = mesh.vertices[order], mesh.colors[order]
    position = float(np.abs(back.vertices.astype(np.float64) - vertices).max())
    levels = 255 * np.abs(back.colors.astype(np.float64) - colors).max(axis=0)
    return QuantisedMesh(
        data,
        back,
        len(mesh.faces),
        chosen,
        position,
        position / radius,
        float(levels[:3].max()),
        float(levels[3]),
    )


def estimated_bytes(mesh: SplatMesh, splats: GaussianCloud | None = None) -> int:
    """Bytes of the packed data of a mesh and splats, estimated in a fraction of a second from runs of
    neighbours."""
    radius = scene_bounds(mesh).radius
    precision = _finest(mesh, radius, BYTES_A_TRIANGLE)
    parts = np.arange(len(mesh.faces)) if mesh.face_splat is None else mesh.face_splat
    some = mesh.take(_in_runs(parts))
    size = len(pack_mesh(some, precision, radius)) * len(mesh.faces) // len(some.faces)
    if splats is not None:
        part = splats.take(np.flatnonzero(_in_runs(np.arange(len(splats)))))
        size += len(pack_splats(part)) * len(splats) // len(part)
    return size


def _in_runs(parts: np.ndarray) -> np.ndarray:
    """(n,) bool: which of the ascending numbers ``parts`` (n,) lie in a few runs, ``2 * SAMPLE`` numbers
    together."""
    length = max(1, -(-(int(parts[-1]) + 1) // RUNS))
    return parts % length < max(1, 2 * SAMPLE // RUNS)


def _finest(mesh: SplatMesh, radius: float, limit: float) -> Precision:
    """The finest precision with at most about ``limit`` bytes a triangle, besides spherical harmonics."""
    sample = replace(_sample(mesh), harmonics=None)
    share = len(sample.faces) / len(mesh.faces)
    for precision in PRECISIONS[:-1]:
        if len(pack_mesh(sample, precision, radius)) <= max(limit * len(sample.faces), SMALL * share):
            return precision
    return PRECISIONS[-1]


def _sample(mesh: SplatMesh) -> SplatMesh:
    """Part of ``mesh`` from which the size of its data can be estimated."""
    if mesh.face_splat is None:
        return mesh.take(slice(SAMPLE))
    splats = mesh.splats
    return mesh.take(splats.of_face % max(1, len(splats) // SAMPLE) == 0)
