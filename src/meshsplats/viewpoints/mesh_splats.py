"""Splats about where those of a mesh are, by which the mesh is looked at."""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from meshsplats._common.geometry import quaternions_of
from meshsplats.scene.gaussians import SH_C0, GaussianCloud
from meshsplats.scene.mesh import SplatMesh

MOST = 400_000
"""Splats, at most, by which it is decided from where a mesh is seen."""
WIDTH = 0.65
"""Standard deviation of a splat, as a share of the root mean square of the corners of its triangles."""

_known: WeakKeyDictionary[SplatMesh, GaussianCloud] = WeakKeyDictionary()
"""So that views that were found in them are found again."""


def splats_to_look_at(mesh: SplatMesh) -> GaussianCloud | None:
    """``splats_like`` of at most ``MOST``, the same ones at every call for ``mesh``."""
    cloud = _known.get(mesh)
    if cloud is None and (cloud := splats_like(mesh, MOST)) is not None:
        _known[mesh] = cloud
    return cloud


def splats_like(mesh: SplatMesh, most: int) -> GaussianCloud | None:
    """Splats about where those of ``mesh`` are, whatever their triangles are, so that it is seen as the
    splats that it was made of: at most ``most`` of them, evenly spread and larger for it. None for a mesh
    that does not know its splats, or has no triangles."""
    if mesh.face_splat is None or not len(mesh.faces):
        return None
    splats = mesh.splats
    step = -(-len(splats) // most)
    part = mesh.plain if step == 1 else mesh.take(splats.of_face % step == 0).plain
    some = _of_all(part)
    return replace(some, scales=some.scales * np.float32(step**0.5))


def _of_all(mesh: SplatMesh) -> GaussianCloud:
    splats, corner = mesh.splats, mesh.faces.ravel()
    owner, count = np.repeat(splats.of_face, 3), len(splats)
    opacity = mesh.colors[:, 3].astype(np.float64)
    centers = splats.centers(mesh.vertices, opacity)
    away = mesh.vertices[corner] - centers[owner]
    moments = np.empty((count, 3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        moments[:, i, j] = moments[:, j, i] = np.bincount(owner, away[:, i] * away[:, j], count)
    squares, axes = np.linalg.eigh(moments / (3 * splats.counts)[:, None, None])
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    weight = opacity[corner] + 1e-6
    tints = [np.bincount(owner, weight * mesh.colors[corner, k], count) for k in range(3)]
    colors = np.stack(tints, axis=1) / np.bincount(owner, weight, count)[:, None]
    peaks = np.maximum.reduceat(opacity[corner], 3 * splats.starts)
    return GaussianCloud(
        centers,
        quaternions_of(axes),
        WIDTH * np.sqrt(np.maximum(squares, 0)),
        np.clip(peaks, 0, 1),
        ((colors - 0.5) / SH_C0)[:, None],
        up=mesh.up,
        origin=mesh.origin,
    )
