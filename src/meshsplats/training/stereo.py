"""Multi-view stereo: each photograph is matched with a few others, and depths that these do not confirm
(geometric consistency) are dropped.

The core runs a plane sweep at half the resolution and PatchMatch with slanted windows at the full one
(csrc/stereo.h). Here: which photographs are matched, which depths stay, and what is filled in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._core.stereo import (
    Layout,
    Pairs,
    Planes,
    SurfaceArrays,
    count_consistent,
    count_views,
    fill_depths,
    match_photos,
)
from meshsplats.datasets.reduced import reduced_image
from meshsplats.datasets.views import View
from meshsplats.rendering.core_arguments import camera_struct
from meshsplats.scene.camera import Camera
from meshsplats.training.references import references

SIDE = 400
"""Longer side of the images that are matched, in pixels."""
REFERENCES = 64
"""Maximum number of views whose depths are found (``references``). They are matched with any others."""
PLANES = 128
"""Depths that are tried at half the size, evenly spaced in inverse depth."""
ROUNDS = 1
"""Iterations of PatchMatch."""
SOURCES = 5
"""Views that each view is matched with."""
NEIGHBORS = 12
"""Views with depths that confirm or refute those of a view, at most."""
ANGLES = (2.5, 8.0, 30.0)
"""Least, best and greatest angle in degrees between two views of a pair, seen from points in both."""
POINTS, POINTS_IN_VIEW = 1500, 80
"""Known points that angles are taken at, at most: of the scene, and of a view."""
LEAST_SUITED = 0.005
"""Views that suit another less are not matched with it."""
MIN_CORRELATION = 0.5
AGREEMENT, PAST = 0.01, 0.03
"""Relative differences of depth up to which two views agree, and from which one sees past the other."""
CONSISTENT = 2
"""Views that must be consistent with a depth..."""
FEW = 3
"""... but one is enough where only so many views have the place in their image."""
OUTLINE = 2
"""Pixels of what is in front that are dropped beside what is farther: windows widen outlines."""
BEHIND = 0.1
"""Relative difference of depth of an outline."""
MATCHED_BYTES, PHOTO_BYTES = 150, 20
"""Memory of a pixel of a view whose depths are found, and of a photograph that takes part."""
FILL_AGREEMENT, FILL_PAST = 0.03, 0.05
"""The same as ``AGREEMENT`` and ``PAST`` for filled depths."""
FILL_CONSISTENT = 3
"""Views whose filled depths must agree."""
FILL_PER_PIXEL = 0.3
"""Cost of filling across a pixel, in differences of colour from 0 to 255."""
SEED_STEP = 0.05
"""Relative difference to a depth two pixels away from which a pixel does not fill others."""
SEED_NEIGHBOURS = 6
"""Known ones of the 3 x 3 pixels around a pixel that fills others, at least."""


class Depths(NamedTuple):
    """Depths of several views, one image after the other."""

    layout: Layout
    cameras: tuple[Camera, ...]
    color: np.ndarray
    """(pixels, 3) uint8 display RGB over black."""
    planes: Planes
    sure: np.ndarray
    """(pixels,) float32 inverse depths that other views confirm, 0: none."""
    filled: np.ndarray
    """(pixels,) float32 those between them, where the filled ones of several views agree or no other view
    sees the place; 0: none."""

    def counts(self, points: np.ndarray, threads: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """(n,) each: views that have a surface at ``points`` (n, 3), and that see past them."""
        places = np.ascontiguousarray(points, np.float64)
        return count_views(self.layout, self.sure, places, (2 * AGREEMENT, 2 * PAST), threads)

    def surface(self, origin: np.ndarray) -> SurfaceArrays:
        """The points of all pixels with a depth, relative to ``origin`` (3,)."""
        parts = [self._points(i, sure, origin) for i in range(len(self.cameras)) for sure in (True, False)]
        return SurfaceArrays(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def _points(self, index: int, sure: bool, origin: np.ndarray) -> SurfaceArrays:
        """Those of one view."""
        camera = self.cameras[index]
        inverse = self.layout.image(self.sure if sure else self.filled, index)
        rows, columns = np.nonzero(inverse)
        q = inverse[rows, columns].astype(np.float64)
        x, y = columns + 0.5 - camera.cx, rows + 0.5 - camera.cy
        turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        local = np.stack([x / camera.fx, y / camera.fy, np.ones_like(q)], axis=1) / q[:, None]
        # The normal of a plane of inverse depths q + a x + b y. Filled pixels have the planes of others, and
        # face the camera.
        a, b = (
            self.layout.image(slopes, index)[rows, columns] * np.float64(sure)
            for slopes in (self.planes.along_x, self.planes.along_y)
        )
        normals = np.stack([a * camera.fx, b * camera.fy, q - a * x - b * y], axis=1) @ turn
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return SurfaceArrays(
            ((local - shift) @ turn - origin).astype(np.float32),
            normals.astype(np.float32),
            (1 / (q * camera.fx)).astype(np.float32),
            self.layout.image(self.color, index)[rows, columns],
            np.full(len(q), sure, np.uint8),
        )


def matching_bytes(views: Sequence[View]) -> int:
    """Estimated memory of ``find_depths`` and of its points in bytes."""
    some = [view.camera.within(SIDE) for view in subsample(views, REFERENCES)]
    matched = sum(camera.width * camera.height for camera in some)
    return int(matched * (MATCHED_BYTES + PHOTO_BYTES * min(len(views) / len(some), 1 + SOURCES)))


def find_depths(
    views: Sequence[View], near: np.ndarray, far: np.ndarray, points: np.ndarray, threads: int | None = None
) -> Depths:
    """Depths of up to ``REFERENCES`` of ``views``.

    Args:
        near, far: (views,) least and greatest depth that is tried in each view.
        points: (n, 3) where the scene is, roughly, for the angles between views, and for which views.
    """
    cameras = [view.camera.within(SIDE) for view in views]
    chosen = references(cameras, points, REFERENCES)
    suited = suited_views(cameras, points, chosen)
    sources = [_spread(cameras, i, *found) for i, found in zip(chosen, suited, strict=True)]
    place = {view: i for i, view in enumerate(chosen)}
    neighbors = _table([[place[j] for j in order if j in place] for order, _ in suited], NEIGHBORS)
    # Thousands of photographs would not fit: only those that take part are read.
    read = sorted({*chosen, *(j for row in sources for j in row)})
    photos = _layout([cameras[i] for i in read])
    color = np.empty((photos.pixels, 3), np.uint8)
    counted = np.ones(photos.pixels, bool)
    for i, view in enumerate(read):
        _read(views[view], photos.image(color, i), photos.image(counted, i))
    number = {view: i for i, view in enumerate(read)}
    own = np.array([number[i] for i in chosen], np.int32)
    matched = _layout([cameras[i] for i in chosen])
    rows = list(chosen)
    pairs = Pairs(
        own,
        _table([[number[j] for j in row] for row in sources], SOURCES),
        np.stack([1 / far[rows], 1 / near[rows]], axis=1).astype(np.float32),
    )
    planes = match_photos(photos, color, matched, pairs, planes=PLANES, rounds=ROUNDS, threads=threads)
    pixels = np.concatenate([np.arange(photos.start[i], photos.start[i + 1]) for i in own])
    color, counted = color[pixels], counted[pixels]
    fits = counted & (planes.score > MIN_CORRELATION)
    sure = confirmed(matched, planes, fits, neighbors, threads)
    filled = between(matched, color, planes._replace(inverse=sure), counted, neighbors, threads)
    return Depths(matched, tuple(cameras[i] for i in chosen), color, planes, sure, filled)


def _layout(cameras: Sequence[Camera]) -> Layout:
    # Stereo has no use for near planes, which belong to scenes that are drawn.
    return Layout([camera_struct(replace(camera, near=camera.near or 1.0)) for camera in cameras])


def _read(view: View, color: np.ndarray, counted: np.ndarray) -> None:
    """Writes the image of ``view`` and which of its pixels count, at the size of ``color`` (h, w, 3)."""
    image = reduced_image(view.load(), color.shape[1], color.shape[0])
    values = image.over((0, 0, 0))
    if image.mask is not None:
        counted &= image.mask
        values[~image.mask] = 0
    if image.alpha is not None:
        counted &= image.alpha > 0.5
    color[:] = np.round(255 * np.clip(values, 0, 1))


def suited_views(
    cameras: Sequence[Camera], points: np.ndarray, chosen: Sequence[int]
) -> list[tuple[list[int], np.ndarray]]:
    """For each ``chosen`` camera the others that suit it, best first, and (cameras,) how well each does: by
    the angles and the distances at ``points`` (n, 3) that both have in the image."""
    rng = np.random.default_rng(0)
    points = points[np.sort(rng.permutation(len(points))[:POINTS])]
    projected = [camera.project(points) for camera in cameras]
    seen = np.array([camera.in_image(at) for camera, (at, _) in zip(cameras, projected, strict=True)])
    depth = np.array([z for _, z in projected])
    centers = np.array([camera.center for camera in cameras])
    least, best, most = ANGLES
    result: list[tuple[list[int], np.ndarray]] = []
    for i in chosen:
        mine = subsample(np.flatnonzero(seen[i]), POINTS_IN_VIEW)
        if not len(mine):
            result.append(([], np.zeros(len(cameras))))
            continue
        away = centers[:, None] - points[mine]
        away /= np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-12)
        angle = np.degrees(np.arccos(np.clip((away * away[i]).sum(axis=2), -1, 1)))
        ratio = np.abs(np.log(np.clip(depth[:, mine] / depth[i, mine], 0.01, 100)))
        weight = np.exp(-np.square(np.log(np.maximum(angle, 0.1) / best)) - np.square(ratio))
        weight[ratio > np.log(2)] = 0
        weight[(angle < least) | (angle > most)] *= 0.2
        suited = (weight * seen[:, mine]).mean(axis=1)
        suited[i] = 0
        order = np.argsort(-suited, kind="stable")
        result.append(([int(j) for j in order if suited[j] > LEAST_SUITED], suited))
    return result


def _spread(cameras: Sequence[Camera], i: int, order: Sequence[int], suited: np.ndarray) -> list[int]:
    """Up to ``SOURCES`` of the views ``order`` that suit camera ``i``, in several directions from it: what
    one does not see past an edge, the one on the other side does."""
    left = suited.copy()
    turn = cameras[i].world_to_camera[:2, :3]
    across = np.array([turn @ (camera.center - cameras[i].center) for camera in cameras])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    chosen: list[int] = []
    for _ in range(min(SOURCES, len(order))):
        j = max((j for j in order if j not in chosen), key=lambda j: left[j])
        chosen.append(j)
        left *= 1 - 0.5 * np.maximum(across @ across[j], 0) ** 4
    return chosen


def _table(rows: Sequence[Sequence[int]], width: int) -> np.ndarray:
    """(rows, width) int32 of the first entries of each row; -1 where it has fewer."""
    table = np.full((len(rows), width), -1, np.int32)
    for line, row in zip(table, rows, strict=True):
        line[: len(row)] = row[:width]
    return table


def confirmed(
    views: Layout, planes: Planes, fits: np.ndarray, neighbors: np.ndarray, threads: int | None = None
) -> np.ndarray:
    """(pixels,) float32 inverse depths that the depths of other views confirm, of those that ``fits``."""
    inverse = np.where(fits, planes.inverse, 0).astype(np.float32)
    found = count_consistent(views, inverse, inverse, neighbors, (AGREEMENT, PAST), threads)
    enough = (found.agree >= CONSISTENT) | ((found.agree >= 1) & (found.seen <= FEW))
    good = (inverse > 0) & enough & (found.past <= found.agree)
    sure = np.where(good, inverse, 0).astype(np.float32)
    for i in range(len(views)):
        image, near = views.image(sure, i), views.image(inverse, i)
        image[_least(np.where(near > 0, near, np.inf), OUTLINE) < (1 - BEHIND) * image] = 0
    return sure


def between(
    views: Layout,
    color: np.ndarray,
    planes: Planes,
    counted: np.ndarray,
    neighbors: np.ndarray,
    threads: int | None = None,
) -> np.ndarray:
    """(pixels,) float32 inverse depths where ``planes`` has none, on walls without texture, say: continued
    from the pixels around, where those of other views agree and none sees past them. What the others do not
    have in their images, or hidden by known depths, has no other depth either: parts of the background of a
    subject that the views go around."""
    sure = planes.inverse
    seeds = np.zeros(views.pixels, bool)
    for i in range(len(views)):
        views.image(seeds, i)[:] = _inner(views.image(sure, i))
    whole = fill_depths(views, color, planes, seeds, per_pixel=FILL_PER_PIXEL, threads=threads)
    whole = np.where(sure > 0, sure, np.where(counted, whole, 0)).astype(np.float32)
    limits = (FILL_AGREEMENT, FILL_PAST)
    found = count_consistent(views, whole, whole, neighbors, limits, threads)
    against = count_consistent(views, whole, sure, neighbors, limits, threads).past
    enough = (found.agree >= FILL_CONSISTENT) | ((found.agree >= 1) & (found.seen <= FEW))
    enough |= found.seen == 0
    return np.where((sure == 0) & enough & (against == 0), whole, 0).astype(np.float32)


def _inner(inverse: np.ndarray) -> np.ndarray:
    """(h, w) bool: the known pixels of ``inverse`` (h, w) amid others, not beside a step of depth."""
    known = inverse > 0
    height, width = known.shape
    around = np.pad(known, 1).astype(np.int8)
    count = sum(around[i : i + height, j : j + width] for i in range(3) for j in range(3))
    inner = known & (count >= SEED_NEIGHBOURS)
    for depths, kept in ((inverse, inner), (inverse.T, inner.T)):
        ahead, behind = depths[2:], depths[:-2]
        step = (ahead > 0) & (behind > 0)
        step &= np.abs(ahead - behind) > SEED_STEP * np.maximum(ahead, behind)
        kept[2:] &= ~step
        kept[:-2] &= ~step
    return np.asarray(inner)


def _least(values: np.ndarray, reach: int) -> np.ndarray:
    """The least of ``values`` (h, w) within ``reach`` pixels to each side."""
    for axis in (0, 1):
        result = values.copy()
        for k in range(1, reach + 1):
            for to, of in ((slice(k, None), slice(None, -k)), (slice(None, -k), slice(k, None))):
                part = np.moveaxis(result, axis, 0)[to]
                np.minimum(part, np.moveaxis(values, axis, 0)[of], out=part)
        values = result
    return values
