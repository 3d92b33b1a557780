"""bake_filter: the low-pass filter of a mesh as part of its triangles, for programs that draw without one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats._common.chunks import chunks
from meshsplats._common.kinds import need, need_all
from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion.footprint import FRAMING_PIXELS, FRAMING_VIEWS, CameraCoverage
from meshsplats.scene.camera import Camera
from meshsplats.scene.face_splats import FaceSplats
from meshsplats.scene.mesh import SplatMesh, checked_filter

MIN_VARIANCE = 1e-4
"""Least variance of a splat as a share of the filter's, as in ``render``."""
OPACITY_BIAS = 1e-6
"""Added to opacities, so that a splat with none has a shape, too."""
FLAT_SHARE = 1e-10
"""A splat is flat along an axis with less than this share of its largest variance: that is rounding, and is
not widened."""

_CHUNK = 1 << 13
"""Splats per chunk."""


def bake_filter(
    mesh: SplatMesh,
    cameras: Sequence[Camera] | None = None,
    *,
    pixel: float | None = None,
    filter_px2: float | None = None,
) -> SplatMesh:
    """``mesh`` with its low-pass filter as part of the triangles, for programs that draw them as they are.

    The result is right for one size of a pixel at each splat: the mean for ``cameras``, or ``pixel``; by
    default that of images of 1000 pixels from all sides that just hold the mesh. With c and S the mean and
    the covariance of a splat's opacity in the world, its vertices p move to ``c + (S + s I)^(1/2) S^(-1/2) (p
    - c)``, where s is ``filter_px2`` times the square of that size. The variance along each principal axis is
    taken from the two views along the other axes, so that each of two crossed ellipses counts only where it
    is seen. Flat splats stay flat.

    Args:
        mesh: a mesh with ``face_splat``.
        cameras: where it will be seen from, with the size of the images. Splats that none of them sees take
            the median pixel of the others.
        pixel: instead of cameras, the size of a pixel at the mesh in scene units: distance / focal length.
        filter_px2: variance in square pixels; ``mesh.filter_px2`` by default.

    Returns:
        A mesh of ``filter_px2`` 0. It has no binding, as its vertices have left the base mesh. Without a
        filter, nothing but these two fields changes.

    Raises:
        ValueError: both of cameras and pixel, cameras that see nothing of the mesh, a mesh without
            ``face_splat``, or splats that share vertices.
    """
    need(SplatMesh, mesh=mesh)
    need_all(Camera, cameras=cameras, optional=True)
    variance = checked_filter(mesh.filter_px2 if filter_px2 is None else filter_px2, mesh.face_splat)
    if cameras and pixel is not None:
        raise ValueError("give bake_filter cameras or the size of a pixel, not both")
    if pixel is not None and not (np.isfinite(pixel) and pixel > 0):
        raise ValueError(f"pixel must be a size in scene units above 0, got {pixel!r}")
    if variance == 0 or not len(mesh.faces):
        return replace(mesh, filter_px2=0.0)
    if not cameras and pixel is None:
        cameras = orbit(mesh, FRAMING_VIEWS, width=FRAMING_PIXELS, height=FRAMING_PIXELS)
    assert mesh.face_splat is not None
    splats = mesh.splats
    if splats.share_vertices:
        raise ValueError("two splats share a vertex: the filter moves each splat's vertices on their own")
    owner = splats.of_vertex
    means = np.empty((len(splats), 3))
    axes = np.empty((len(splats), 3, 3))
    variances = np.empty((len(splats), 3))
    for part in chunks(len(splats), _CHUNK):
        means[part], axes[part], variances[part] = _shapes(mesh, splats.part(part))
    if cameras:
        sizes = CameraCoverage(means.astype(np.float32), cameras).pixel_sizes().astype(np.float64)
        if not (sizes > 0).any():
            raise ValueError(f"none of the {len(cameras)} cameras sees any splat of the mesh")
        sizes = np.where(sizes > 0, sizes, np.median(sizes[sizes > 0]))
    else:
        sizes = np.full(len(splats), float(pixel))  # type: ignore[arg-type]
    added = (variance * sizes**2)[:, None]
    least = variances + MIN_VARIANCE * added
    flat = variances <= FLAT_SHARE * variances.max(axis=1, keepdims=True)
    spread = np.where(flat, 1, np.sqrt((least + added) / least))

    vertices = mesh.vertices.copy()
    used = np.flatnonzero(owner >= 0)
    for part in chunks(len(used), 4 * _CHUNK):
        rows = used[part]
        fan = owner[rows]
        offsets = np.einsum("nji,nj->ni", axes[fan], mesh.vertices[rows] - means[fan])
        vertices[rows] = means[fan] + np.einsum("nij,nj->ni", axes[fan], spread[fan] * offsets)
    return replace(mesh, vertices=vertices, filter_px2=0.0, binding=None)


def _shapes(mesh: SplatMesh, splats: FaceSplats) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Moments of the opacity of n ``splats`` of ``mesh``.

    The integral of opacity, linear in a triangle, and its moments are polynomials of the corners; a constant
    factor that all share is left out.

    Returns:
        (n, 3) means, (n, 3, 3) principal axes as columns, and (n, 3) variances along them.
    """
    faces, counts, total = splats.faces, splats.counts, splats.sums
    corners = mesh.vertices[faces].astype(np.float64)
    origin = corners[splats.starts, 0]
    corners -= np.repeat(origin, counts, axis=0)[:, None]
    opacity = mesh.colors[faces, 3].astype(np.float64) + OPACITY_BIAS
    whole = opacity.sum(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    mass = 20 * whole
    first = 5 * np.einsum("tk,tkc->tc", opacity + whole[:, None], corners)
    everything = total(area * mass)
    solid = everything > 0
    center = total(area[:, None] * first) / np.where(solid, everything, 1)[:, None]
    corners -= np.repeat(center, counts, axis=0)[:, None]
    sums = corners.sum(axis=1)
    weighted = np.einsum("tk,tkc->tc", opacity, corners)
    mixed = weighted[:, :, None] * sums[:, None, :]
    second = (
        whole[:, None, None] * sums[:, :, None] * sums[:, None, :]
        + mixed
        + mixed.transpose(0, 2, 1)
        + np.einsum("tk,tki,tkj->tij", whole[:, None] + 2 * opacity, corners, corners)
    )
    covariance = total(area[:, None, None] * second) / np.where(solid, everything, 1)[:, None, None]
    axes = np.linalg.eigh(covariance)[1]
    of_face = np.repeat(axes, counts, axis=0)
    seen = np.abs(np.einsum("tc,tck->tk", normal, of_face))  # areas of projections along each axis
    along = np.einsum("tik,tij,tjk->tk", of_face, second, of_face)
    others = seen.sum(axis=1, keepdims=True) - seen
    masses = total(others * mass[:, None])
    variances = np.divide(total(others * along), masses, out=np.zeros_like(masses), where=masses > 0)
    return origin + center, axes, np.maximum(variances, 0)
