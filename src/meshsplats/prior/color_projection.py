"""Colours of a surface from the pictures that see it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._arrays import subsample
from meshsplats.binding import Binding
from meshsplats.datasets.views import View
from meshsplats.mesh import SplatMesh
from meshsplats.rendering import render

BEST = 4
"""Views that a place takes its colour from: those that look at it most squarely."""
MOST_VIEWS = 128
"""Most views, evenly spread, that are looked at."""
_SOLID = 0.5
"""Opacity from which a pixel of a picture with alpha has a colour of its own."""
_TOLERANCE = 1.5
"""Pixels, laid on the surface, that a place may lie behind what is drawn there and still count as seen."""
_GRAZING = 0.1
"""Cosine below which a view sees a place too slantwise to tell its colour."""
_ROUNDS = 64
"""Rings of the base that colours spread over from what was seen."""


def colors_from_views(binding: Binding, views: Sequence[View], *, threads: int | None = None) -> np.ndarray:
    """(v, 3) float32 display RGB at the vertices of ``binding`` on its base, as the ``views`` show them.

    A place counts as seen where the base itself does not hide it, or by no more than what lies above its
    layer. Its colour is the mean over the ``BEST`` views with the largest cosine between the base's normal
    (either side) and the direction to the camera, weighted by its square. Places that no view sees take the
    colours next to them on the base; mid grey where no view sees anything.
    """
    base = SplatMesh(
        binding.base_vertices,
        binding.base_faces,
        np.tile(np.array([0.5, 0.5, 0.5, 1], np.float32), (len(binding.base_vertices), 1)),
    )
    points, normals = binding.positions().astype(np.float64), binding.normals()
    depths = np.abs(binding.layers * binding.lift)
    scores = np.zeros((len(points), BEST), np.float32)
    colors = np.zeros((len(points), BEST, 3), np.float32)
    for view in subsample(views, MOST_VIEWS):
        rows, score, color = _seen(base, points, normals, depths, view, threads)
        # In place of the least of the best so far, where it is better.
        least = scores[rows].argmin(axis=1)
        better = score > scores[rows, least]
        rows, least = rows[better], least[better]
        scores[rows, least] = score[better]
        colors[rows, least] = color[better]
    weights = np.square(scores)
    total = weights.sum(axis=1)
    seen = total > 0
    result = np.einsum("vb,vbc->vc", weights, colors) / np.where(seen, total, 1)[:, None]
    return _filled(binding, result.astype(np.float32), seen)


def _seen(
    base: SplatMesh,
    points: np.ndarray,
    normals: np.ndarray,
    depths: np.ndarray,
    view: View,
    threads: int | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers of the points that ``view`` sees, the cosines at which it does, and their colours (k, 3).

    ``depths`` (n,) are how far from the base they lie.
    """
    camera, picture = view.camera, view.load()
    positions, z = camera.project(points)
    rows = np.flatnonzero(camera.in_image(positions))
    column, row = positions[rows].T.astype(np.int64)
    place = row, column
    away = camera.center - points[rows]
    cosine = np.abs(np.einsum("ij,ij->i", away, normals[rows])) / np.linalg.norm(away, axis=1)
    # Where nothing is drawn at the middle of its pixel, a point at an outline is in front of all there is.
    surface = render(base, camera, depth=True, threads=threads).mean_depth(min_alpha=0.5)[place]
    slack = _TOLERANCE * z[rows] / min(camera.fx, camera.fy) + depths[rows]
    slack /= np.maximum(cosine, 0.25)
    keep = (z[rows] <= surface + slack) & (cosine > _GRAZING)
    color = picture.over((0, 0, 0))
    if picture.alpha is not None:
        alpha = view.alpha
        assert alpha is not None
        keep &= alpha[place] > _SOLID
        color = color / np.maximum(alpha, 1e-6)[..., None]
    if picture.mask is not None:
        keep &= picture.mask[place]
    return rows[keep], cosine[keep].astype(np.float32), np.clip(color[place][keep], 0, 1)


def _filled(binding: Binding, colors: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """``colors`` with those of unseen places taken from what lies next to them, outwards from what was
    seen."""
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
    for _ in range(_ROUNDS):
        here = known[faces]
        open_faces = faces[here.any(axis=1) & ~here.all(axis=1)]
        if not len(open_faces):
            break
        told = known[open_faces]
        mean = (at_base[open_faces] * told[..., None]).sum(axis=1) / told.sum(axis=1)[:, None]
        target, value = open_faces[~told], np.repeat(mean, (~told).sum(axis=1), axis=0)
        number = np.bincount(target, minlength=n)
        fresh = number > 0
        for c in range(3):
            at_base[fresh, c] = np.bincount(target, value[:, c], n)[fresh] / number[fresh]
        known |= fresh
    at_base[~known] = colors[seen].mean(axis=0, dtype=np.float64)
    result = colors.copy()
    mixed = np.einsum("vk,vkc->vc", binding.weights[~seen].astype(np.float64), at_base[corners[~seen]])
    result[~seen] = np.clip(mixed, 0, 1)
    return result
