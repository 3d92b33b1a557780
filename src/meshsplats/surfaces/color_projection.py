"""Colours of a surface, projected from images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.datasets.views import View
from meshsplats.rendering import render
from meshsplats.scene.binding import Binding
from meshsplats.scene.mesh import SplatMesh

BEST_VIEWS = 4
"""Number of views that determine the colour of a point: those that see it most frontally."""
MAX_VIEWS = 128
"""Maximum number of views, evenly spread, that are used."""
_SOLID = 0.5
"""Minimum alpha of a pixel whose colour is used."""
_TOLERANCE = 1.5
"""Depth tolerance of visibility, in pixels at the depth of the point."""
_GRAZING = 0.1
"""Cosine below which the angle is too grazing to use a view's colour."""
_RINGS = 64
"""Maximum number of rings of base faces that colours spread over into unseen regions."""


def colors_from_views(binding: Binding, views: Sequence[View], *, threads: int | None = None) -> np.ndarray:
    """Colours of the vertices of ``binding``, projected from the ``views``.

    A vertex counts as visible unless the base occludes it by more than its layer's distance from the base.
    Its colour is the mean over the ``BEST_VIEWS`` views with the largest cosine between the base's normal (of
    either side) and the direction to the camera, weighted by the squared cosine. Unseen vertices take the
    colours next to them on the base; mid grey if no view sees any vertex.

    Returns:
        (v, 3) float32 display RGB.
    """
    base = SplatMesh(
        binding.base_vertices,
        binding.base_faces,
        np.tile(np.array([0.5, 0.5, 0.5, 1], np.float32), (len(binding.base_vertices), 1)),
    )
    points, normals = binding.positions().astype(np.float64), binding.normals()
    depths = np.abs(binding.layers * binding.lift)
    scores = np.zeros((len(points), BEST_VIEWS), np.float32)
    colors = np.zeros((len(points), BEST_VIEWS, 3), np.float32)
    for view in subsample(views, MAX_VIEWS):
        rows, score, color = _visible_points(base, points, normals, depths, view, threads)
        # A better view replaces the worst of the best so far.
        worst = scores[rows].argmin(axis=1)
        better = score > scores[rows, worst]
        rows, worst = rows[better], worst[better]
        scores[rows, worst] = score[better]
        colors[rows, worst] = color[better]
    weights = np.square(scores)
    total = weights.sum(axis=1)
    seen = total > 0
    result = np.einsum("vb,vbc->vc", weights, colors) / np.where(seen, total, 1)[:, None]
    return _fill_unseen(binding, result.astype(np.float32), seen)


def _visible_points(
    base: SplatMesh,
    points: np.ndarray,
    normals: np.ndarray,
    depths: np.ndarray,
    view: View,
    threads: int | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices (k,) of the points that ``view`` sees, cosines (k,) of the viewing angle, and colours (k, 3).

    ``depths`` (n,) are the distances of the points from the base.
    """
    camera, image = view.camera, view.load()
    positions, z = camera.project(points)
    rows = np.flatnonzero(camera.in_image(positions))
    column, row = positions[rows].T.astype(np.int64)
    place = row, column
    to_camera = camera.center - points[rows]
    cosine = np.abs(np.einsum("ij,ij->i", to_camera, normals[rows])) / np.linalg.norm(to_camera, axis=1)
    # A point at a silhouette whose pixel centre misses the base has nothing in front of it.
    surface = render(base, camera, depth=True, threads=threads).mean_depth(min_alpha=0.5)[place]
    slack = _TOLERANCE * z[rows] / min(camera.fx, camera.fy) + depths[rows]
    slack /= np.maximum(cosine, 0.25)
    keep = (z[rows] <= surface + slack) & (cosine > _GRAZING)
    color = image.over((0, 0, 0))
    if image.alpha is not None:
        alpha = view.alpha
        assert alpha is not None
        keep &= alpha[place] > _SOLID
        color = color / np.maximum(alpha, 1e-6)[..., None]
    if image.mask is not None:
        keep &= image.mask[place]
    return rows[keep], cosine[keep].astype(np.float32), np.clip(color[place][keep], 0, 1)


def _fill_unseen(binding: Binding, colors: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """``colors`` (v, 3) with those of unseen vertices filled in from their neighbours on the base."""
    if seen.all():
        return colors
    if not seen.any():
        return np.full_like(colors, 0.5)
    n, faces = len(binding.base_vertices), binding.base_faces
    corners = faces[binding.vertex_face]
    sums, weight = np.zeros((n, 3)), np.zeros(n)
    for k in range(3):
        share = binding.weights[seen, k].astype(np.float64)
        weight += np.bincount(corners[seen, k], share, n)
        for c in range(3):
            sums[:, c] += np.bincount(corners[seen, k], share * colors[seen, c], n)
    known = weight > 0
    at_base = np.where(known[:, None], sums / np.where(known, weight, 1)[:, None], 0)
    for _ in range(_RINGS):
        at_corner = known[faces]
        front = faces[at_corner.any(axis=1) & ~at_corner.all(axis=1)]
        if not len(front):
            break
        known_corner = known[front]
        mean = (at_base[front] * known_corner[..., None]).sum(axis=1) / known_corner.sum(axis=1)[:, None]
        target, value = front[~known_corner], np.repeat(mean, (~known_corner).sum(axis=1), axis=0)
        count = np.bincount(target, minlength=n)
        filled = count > 0
        for c in range(3):
            at_base[filled, c] = np.bincount(target, value[:, c], n)[filled] / count[filled]
        known |= filled
    at_base[~known] = colors[seen].mean(axis=0, dtype=np.float64)
    result = colors.copy()
    blend = np.einsum("vk,vkc->vc", binding.weights[~seen].astype(np.float64), at_base[corners[~seen]])
    result[~seen] = np.clip(blend, 0, 1)
    return result
