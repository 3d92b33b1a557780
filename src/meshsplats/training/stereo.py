"""Depth from pairs of photographs: plane sweep with normalised cross-correlation, checked between views.

Collins 1996 (plane sweep); the depth of a pixel is the plane on which its window and those of neighbouring
views correlate best. Depths that other views do not confirm are dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from meshsplats.camera import Camera
from meshsplats.datasets.reduced import reduced_image
from meshsplats.datasets.views import View

SIDE = 200
"""Longer side of the images that are matched, in pixels."""
PLANES = 64
"""Depths that are tried, evenly spaced in inverse depth."""
SOURCES = 4
"""Neighbouring views that each view is matched with."""
BEST = 2
"""Of their correlations the mean of this many counts: in the others the pixel may be hidden."""
RADIUS = 3
"""Pixels to each side of a window."""
MIN_CORRELATION = 0.6
MIN_DEVIATION = 0.02
"""Standard deviation of the grey values in a window below which nothing can be matched."""
ANGLES = (4.0, 12.0, 45.0)
"""Least, best and greatest angle in degrees between two views of a pair, seen from what they look at."""
REFERENCES = 64
"""Maximum number of views, evenly spread, whose depths are found."""
AGREEMENT = 1.5
"""Planes by which depths of two views of a point may differ."""
MATCHING_BYTES = (SOURCES + 4) * PLANES * SIDE * SIDE * 4
"""Memory for matching one view."""
WITNESSES = 2
"""Views that must confirm a depth."""


FILL_STRIDE = 2
"""Of the rows and columns without a depth one in this many is filled."""
FILL_AGREEMENT = 4.0
"""Planes by which filled depths of two views of a point may differ."""
FILL_WITNESSES = 4
"""Other views that must agree with a filled depth."""
FILL_FREE = 1
"""Views that must see past a filled point to refute it."""
FARNESS = 4
"""Power of the depth in the weights of the depths that others are filled from."""


class DepthView(NamedTuple):
    """Depths of a view."""

    camera: Camera
    """At the size of the depths."""
    inverse: np.ndarray
    """(h, w) float32 inverse depths; 0 where none was found."""
    color: np.ndarray
    """(h, w, 3) float32 display RGB over black."""
    step: float
    """Distance of two planes, in inverse depth."""


class Depths(NamedTuple):
    """Points on surfaces, and the views that they were found in."""

    points: np.ndarray
    """(n, 3) float64."""
    colors: np.ndarray
    """(n, 3) float32 display RGB."""
    pixels: np.ndarray
    """(n,) float64 size of a pixel of its view at each point, scene units."""
    views: tuple[DepthView, ...]
    """The depths that other views confirm."""

    def free(self, points: np.ndarray, margin: float = 2.0) -> np.ndarray:
        """(m,) int: how many views see past ``points`` (m, 3): they have a surface behind them, by more than
        ``margin`` planes."""
        count = np.zeros(len(points), int)
        for view in self.views:
            positions, z = view.camera.project(points)
            rows = np.flatnonzero(view.camera.in_image(positions))
            u, v = positions[rows].astype(int).T
            known = view.inverse[v, u]
            count[rows] += (known > 0) & (1 / z[rows] > known + margin * view.step)
        return count

    def between(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (m, 3) and colours (m, 3) where nothing could be matched: on walls without texture, say.

        Each view fills its unknown pixels from the depths around them, the farther ones above all. A point
        stays if the filled depths of ``FILL_WITNESSES`` other views agree, and no view sees past it.
        """
        full = [view._replace(inverse=_filled(view.inverse)) for view in self.views]
        points, colors = [], []
        for view, whole in zip(self.views, full, strict=True):
            rows, columns = np.nonzero((view.inverse == 0) & (whole.inverse > 0))
            chosen = (rows % FILL_STRIDE == 0) & (columns % FILL_STRIDE == 0)
            rows, columns = rows[chosen], columns[chosen]
            there = _places(whole, rows, columns)
            agree = _witnesses(there, [other for other in full if other is not whole], FILL_AGREEMENT)
            keep = (agree >= FILL_WITNESSES) & (self.free(there) < FILL_FREE)
            points.append(there[keep])
            colors.append(view.color[rows[keep], columns[keep]])
        return np.concatenate(points), np.concatenate(colors)


class _Photo:
    """An image in grey values at the size for matching."""

    def __init__(self, view: View) -> None:
        self.camera = view.camera.within(SIDE)
        image = reduced_image(view.load(), self.camera.width, self.camera.height)
        self.color = image.over((0, 0, 0))
        counts = np.ones(self.color.shape[:2], np.float32)
        if image.alpha is not None:
            counts = image.alpha.astype(np.float32)
        if image.mask is not None:
            counts = counts * image.mask
            self.color[~image.mask] = 0
        self.opaque = counts > 0.5
        self.grey = self.color @ np.array([0.3, 0.6, 0.1], np.float32)


def dense_points(views: Sequence[View], near: np.ndarray, far: np.ndarray, targets: np.ndarray) -> Depths:
    """Points that several of ``views`` agree on.

    Args:
        near, far: (views,) least and greatest depth that is tried in each view.
        targets: (views, 3) a point that each view looks at, for the angles between views.
    """
    photos = [_Photo(view) for view in views]
    step = max(1, -(-len(views) // REFERENCES))
    chosen = range(0, len(views), step)
    depths = []
    for i in chosen:
        sources = _neighbours(photos, i, targets[i])
        depths.append(_depths(photos[i], [photos[j] for j in sources], near[i], far[i]))
    return _confirmed(depths)


def _neighbours(photos: Sequence[_Photo], i: int, target: np.ndarray) -> list[int]:
    """Indices of the views that suit view ``i`` best, by the angle between them."""
    centers = np.array([photo.camera.center for photo in photos])
    away = target - centers
    distance = np.linalg.norm(away, axis=1)
    away /= np.maximum(distance, 1e-12)[:, None]
    axes = np.array([photo.camera.world_to_camera[2, :3] for photo in photos])
    angle = np.degrees(np.arccos(np.clip(away @ away[i], -1, 1)))
    least, best, most = ANGLES
    ratio = distance / max(distance[i], 1e-12)
    fits = (angle >= least) & (angle <= most) & (ratio > 0.5) & (ratio < 2) & (axes @ axes[i] > 0.5)
    order = np.argsort(np.abs(np.log(np.maximum(angle, 1e-9) / best)), kind="stable")
    return [int(j) for j in order if fits[j] and j != i][:SOURCES]


def _depths(reference: _Photo, sources: Sequence[_Photo], near: float, far: float) -> DepthView:
    camera = reference.camera
    inverse = np.linspace(1 / far, 1 / near, PLANES)
    step = float(inverse[1] - inverse[0])
    found = np.zeros((camera.height, camera.width), np.float32)
    if not sources:
        return DepthView(camera, found, reference.color, step)
    mean = _box(reference.grey)
    spread = _box(np.square(reference.grey)) - np.square(mean)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    correlations = np.stack(
        [_correlations(reference, source, rays, inverse, mean, spread) for source in sources]
    )
    correlations = np.sort(correlations, axis=0)[-BEST:].mean(axis=0)
    best = correlations.argmax(axis=0)
    height = np.take_along_axis(correlations, best[None], axis=0)[0]
    inner = np.clip(best, 1, PLANES - 2)
    before, at, after = (np.take_along_axis(correlations, (inner + k)[None], axis=0)[0] for k in (-1, 0, 1))
    bend = before - 2 * at + after
    shift = np.where(bend < -1e-6, 0.5 * (before - after) / np.minimum(bend, -1e-6), 0)
    good = (height >= MIN_CORRELATION) & (spread >= MIN_DEVIATION**2) & reference.opaque
    good &= (best > 0) & (best < PLANES - 1)
    found[good] = (inverse[0] + (inner + np.clip(shift, -0.5, 0.5)) * step)[good]
    return DepthView(camera, found, reference.color, step)


def _correlations(
    reference: _Photo,
    source: _Photo,
    rays: np.ndarray,
    inverse: np.ndarray,
    mean: np.ndarray,
    spread: np.ndarray,
) -> np.ndarray:
    """(planes, h, w) float32 correlation of each window with the source on each plane; -1 outside of it."""
    other = source.camera
    relative = other.world_to_camera @ np.linalg.inv(reference.camera.world_to_camera)
    turned = (rays @ relative[:3, :3].T).astype(np.float32)
    result = np.empty((len(inverse), *rays.shape[:2]), np.float32)
    grey = source.grey
    flat = np.ascontiguousarray(grey).ravel()
    for i, value in enumerate(inverse):
        x, y, z = (turned[..., k] + np.float32(value * relative[k, 3]) for k in range(3))
        valid = z > 1e-6
        z = np.where(valid, z, 1)
        u = np.float32(other.fx) * x / z + np.float32(other.cx - 0.5)
        v = np.float32(other.fy) * y / z + np.float32(other.cy - 0.5)
        valid &= (u >= 0) & (u <= other.width - 1) & (v >= 0) & (v <= other.height - 1)
        u, v = np.where(valid, u, 0), np.where(valid, v, 0)
        left = np.minimum(u.astype(np.int32), other.width - 2)
        top = np.minimum(v.astype(np.int32), other.height - 2)
        a, b = u - left, v - top
        at = top * np.int32(other.width) + left
        upper = flat[at] * (1 - a) + flat[at + 1] * a
        lower = flat[at + other.width] * (1 - a) + flat[at + other.width + 1] * a
        warped = upper * (1 - b) + lower * b
        own = _box(warped)
        deviation = _box(np.square(warped)) - np.square(own)
        together = _box(warped * reference.grey) - own * mean
        scale = np.sqrt(np.maximum(deviation * spread, 1e-8))
        result[i] = np.where(valid & (deviation > 1e-5), together / scale, -1)
    return result


def _box(values: np.ndarray) -> np.ndarray:
    """Mean over windows of ``RADIUS`` pixels to each side; edges are repeated."""
    size = 2 * RADIUS + 1
    for axis in (0, 1):
        width = [(0, 0), (0, 0)]
        width[axis] = (RADIUS + 1, RADIUS)
        sums = np.cumsum(np.pad(values, width, mode="edge"), axis=axis, dtype=np.float64)
        upper, lower = [slice(None)] * 2, [slice(None)] * 2
        upper[axis], lower[axis] = slice(size, None), slice(None, -size)
        values = ((sums[tuple(upper)] - sums[tuple(lower)]) / size).astype(np.float32)
    return values


def _confirmed(depths: Sequence[DepthView]) -> Depths:
    """The depths that at least ``WITNESSES`` other views have, too."""
    points, colors, pixels, views = [], [], [], []
    for view in depths:
        rows, columns = np.nonzero(view.inverse)
        there = _places(view, rows, columns)
        witnesses = _witnesses(there, [other for other in depths if other is not view], AGREEMENT)
        keep = witnesses >= WITNESSES
        rows, columns = rows[keep], columns[keep]
        inverse = np.zeros_like(view.inverse)
        inverse[rows, columns] = view.inverse[rows, columns]
        views.append(view._replace(inverse=inverse))
        points.append(there[keep])
        colors.append(view.color[rows, columns])
        pixels.append(1 / (inverse[rows, columns].astype(np.float64) * view.camera.fx))
    return Depths(np.concatenate(points), np.concatenate(colors), np.concatenate(pixels), tuple(views))


def _witnesses(points: np.ndarray, views: Sequence[DepthView], planes: float) -> np.ndarray:
    """(n,) int: how many of ``views`` have ``points`` (n, 3) at their depth, give or take ``planes``."""
    count = np.zeros(len(points), int)
    for view in views:
        positions, z = view.camera.project(points)
        rows = np.flatnonzero(view.camera.in_image(positions))
        u, v = positions[rows].astype(int).T
        known = view.inverse[v, u]
        count[rows[(known > 0) & (np.abs(1 / z[rows] - known) < planes * view.step)]] += 1
    return count


def _filled(inverse: np.ndarray) -> np.ndarray:
    """``inverse`` depths (h, w) with values for all pixels, from a pyramid of means of the known ones; all 0
    if none is known."""
    if min(inverse.shape) < 2 or (inverse > 0).all():
        return inverse
    height, width = inverse.shape
    even = np.pad(inverse, ((0, height % 2), (0, width % 2)))
    # Relative to the nearest, and bounded: powers of far ones overflow.
    relative = np.maximum(even / max(float(even.max()), 1e-30), 1e-4)
    weights = np.where(even > 0, relative.astype(np.float64) ** -FARNESS, 0)

    def halved(values: np.ndarray) -> np.ndarray:
        return values.reshape(len(values) // 2, 2, -1, 2).sum(axis=(1, 3))

    total = halved(weights)
    coarse = np.divide(halved(weights * even), total, out=np.zeros_like(total), where=total > 0)
    coarse = _filled(coarse.astype(np.float32))
    fine = np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)[:height, :width]
    edge = np.pad(fine, 1, mode="edge")
    smooth = sum(edge[i : i + height, j : j + width] for i in range(3) for j in range(3)) / np.float32(9)
    return np.where(inverse > 0, inverse, smooth)


def _places(view: DepthView, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(n, 3) positions in the world of the pixels at ``rows`` and ``columns`` (n,)."""
    camera = view.camera
    depth = 1 / view.inverse[rows, columns].astype(np.float64)
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    local = np.stack([x * depth, y * depth, depth], axis=1)
    return (local - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
