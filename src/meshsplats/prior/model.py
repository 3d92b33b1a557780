"""MeshPrior: splats on a base mesh that move with it."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from meshsplats._common.arrays import checked_array
from meshsplats._common.kinds import need, need_path
from meshsplats.prior.matching import matched_vertices
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.mesh import SplatMesh

LIFT = 2e-5
"""Distance between two layers of exported meshes, relative to the diagonal of the base's bounding box: enough
for the float32 positions of ray tracers and engines, and too small to be visible."""
_FLAT = 1e-5
"""Least thickness of a base, relative to its length, that tells a mirror from a turn."""
_ROUNDING = 1e-4
"""Error of an affine map, relative to the size of the base."""


@dataclass(frozen=True, eq=False)
class MeshPrior:
    """A splat mesh whose vertices are bound to the faces of a base mesh.

    The splats move with the base: ``pose`` computes them from new positions of the base's vertices, without
    training. ``save_mesh(prior.mesh, path)`` stores the binding in `.npz` and `.glb`; ``load_prior`` reads it
    back.

    Raises ValueError for a mesh without a binding.
    """

    mesh: SplatMesh
    """The splats in the pose of the base in ``mesh.binding``, with the base's normals as shading normals."""

    def __post_init__(self) -> None:
        need(SplatMesh, mesh=self.mesh)
        if self.mesh.binding is None:
            raise ValueError(
                "the mesh is bound to no base; bind() makes a mesh prior, which .npz and .glb files keep"
            )

    @property
    def base_vertices(self) -> np.ndarray:
        """(n, 3) float32 positions of the base that the mesh is posed by."""
        assert self.mesh.binding is not None
        return self.mesh.binding.base_vertices

    @property
    def base_faces(self) -> np.ndarray:
        """(m, 3) int32 vertex indices of the base's triangles."""
        assert self.mesh.binding is not None
        return self.mesh.binding.base_faces

    @property
    def lift(self) -> float:
        """Distance between layers in scene units, negative inwards; 0: all layers lie in the base."""
        assert self.mesh.binding is not None
        return self.mesh.binding.lift

    @property
    def export_lift(self) -> float:
        """Distance between layers of exported meshes, in scene units: ``lift``, or for coplanar layers
        ``LIFT`` times the diagonal of the base's bounding box."""
        binding = self.mesh.binding
        assert binding is not None
        if binding.lift or not binding.layers.any():
            return binding.lift
        used = binding.base_vertices[binding.base_faces].reshape(-1, 3).astype(np.float64)
        return LIFT * float(np.linalg.norm(np.ptp(used, axis=0)))

    def pose(self, vertices: np.ndarray | None = None, *, lift: float | None = None) -> SplatMesh:
        """The splats on a posed base.

        Every vertex is the barycentric combination of the posed corners of its face, which layers above 0
        have moved along the posed base's normals. Where an affine map mirrors the whole base, its triangles
        are seen from behind: normals and layers then are on the other side of them, and view-dependent
        colours are mirrored.

        Args:
            vertices: (n, 3) posed positions of the base's vertices, relative to the origin of the mesh; the
                stored ones by default.
            lift: distance between layers in scene units, negative inwards. By default that of the prior, and
                where the base is stretched, that times what the faces around are stretched by
                (``Binding.posed``). With 0 the layers are coplanar, and this project's renderer blends them
                in their order (``depth_group``); for other programs use ``export_lift``.

        Returns:
            The mesh with the posed base's shading normals, and a binding to the posed base.

        Raises:
            ValueError: another number of vertices, or positions that are not finite.
        """
        binding = self.mesh.binding
        assert binding is not None
        positions = binding.base_vertices
        if vertices is not None:
            positions = checked_array("vertices", vertices, np.float32, (None, 3))
            if len(positions) != len(binding.base_vertices):
                count = len(binding.base_vertices)
                raise ValueError(f"the base has {count:,} vertices, got positions of {len(positions):,}")
        mirror = None if vertices is None else _mirror(binding.base_vertices, positions)
        side = 1 if mirror is None else -1
        posed = binding.posed(positions) if lift is None else binding.moved(positions, lift)
        if mirror is not None:
            posed = posed.moved(positions, -posed.lift)
        normals = side * posed.normals()
        if mirror is None:
            return self.mesh.moved(posed.positions(), normals=normals, binding=posed)
        return replace(
            replace(self.mesh, binding=None).transformed(mirror),
            vertices=posed.positions(),
            normals=normals,
            binding=posed,
            up=self.mesh.up,
            origin=self.mesh.origin,
        )

    def in_file(self, path: str | os.PathLike[str]) -> SplatMesh:
        """The mesh for the format of ``path``: for other programs than this one, which reads .npz, coplanar
        layers are set apart by ``export_lift``."""
        return self.mesh if Path(path).suffix.lower() == ".npz" else self.pose(lift=self.export_lift)

    def vertices_of(self, base: BaseMesh) -> np.ndarray:
        """(n, 3) float32 positions of this base's vertices in ``base``, an edited one as ``load_base`` reads
        it: with the same vertices in the same order and the same triangles, or with the same triangles in the
        same order, whose vertices an exporter has split at seams of a texture.

        Raises ValueError for another base.
        """
        assert self.mesh.binding is not None
        return matched_vertices(self.mesh.binding, base)


def _mirror(before: np.ndarray, after: np.ndarray) -> np.ndarray | None:
    """(3, 3) linear part of the affine map of the points ``before`` (n, 3) to ``after`` where there is one
    and it mirrors, else None. Points in a plane are mirrored by a turn, too, so they are not."""
    old, new = (
        points.astype(np.float64) - points.mean(axis=0, dtype=np.float64) for points in (before, after)
    )
    matrix, _, rank, _ = np.linalg.lstsq(old, new, rcond=_FLAT)
    if rank < 3 or np.linalg.det(matrix) >= 0 or np.linalg.cond(matrix) > 1 / _FLAT:
        return None
    return matrix.T if np.abs(old @ matrix - new).max() <= _ROUNDING * np.abs(new).max() else None


def load_prior(path: str | os.PathLike[str]) -> MeshPrior:
    """Loads the mesh prior in a `.npz` or `.glb` file.

    Raises the errors of ``load_mesh``, and ValueError for a mesh that is bound to no base.
    """
    need_path(path=path)
    from meshsplats.formats.meshes import load_mesh

    mesh = load_mesh(path)
    if mesh.binding is None:
        raise ValueError(
            f"{path}: the mesh is bound to no base; files that meshsplats prior wrote as .npz or .glb are"
        )
    return MeshPrior(mesh)
