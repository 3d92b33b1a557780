"""Which way is up, and where the ground is, from floors, walls and the views that were found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshsplats._geometry import level_axes
from meshsplats.viewpoints.sample import COARSE, Sample, fibonacci
from meshsplats.viewpoints.search import Places

PEAKS = 1200
"""Directions among which the normals of large planes are found."""
CELLS = 20
"""Normals that agree within a share of 1 in so many are looked at together."""
PLANE = 0.96
"""Cosine between a plane's normal and those of its splats, at least."""
FLOOR, SURE = 0.1, 0.2
"""Shares of the picture with one normal from which on it is a floor, perhaps and surely."""
LYING = 0.4
"""Greatest height of what is seen, as a share of its width, above a plane that is a floor and not a wall."""
LEVEL = 0.3
"""Greatest ratio of the two smaller second moments of the directions of gaze that tells what is level."""
KNOWN = 0.5
"""How sure it is at least which way is up where another direction than the default is believed."""
LEANS = 0.8
"""Least cosine between the normal of a plane and the axis of those directions that it makes exact."""
SEEN_FROM = 24
"""Number of the best places from which planes are looked at."""


@dataclass(frozen=True, eq=False)
class Upright:
    """Which way is up."""

    up: np.ndarray
    """(3,) unit direction."""
    ground: float
    """Height of the ground along ``up``."""
    confidence: float
    """0: the format's default, as the splats do not tell; 1: a large floor was found."""


def find_upright(sample: Sample, places: Places, default: np.ndarray) -> Upright:
    """Up from the largest plane in the best views, or from their being level; else ``default`` (3,)."""
    best = places.best()
    area = _area_in_pictures(sample, best)
    scales = np.sort(sample.thin.scales, axis=1)
    flat = (scales[:, 0] < 0.5 * scales[:, 1]) & (area > 0)
    good = np.maximum(best.worth - 0.6 * best.worth.max(), 0)
    gaze = np.einsum("kd,dj->j", good, sample.gaze, optimize=False) / good.sum()
    peaks = _planes(sample.normals[flat], area[flat], sample.axes)
    up, confidence = default, 0.0
    floors = [(share, normal) for share, normal in peaks if share > FLOOR]
    if floors:
        seen = sample.means[area > np.median(area)]
        heights = [max(height_over_width(seen, normal), LYING) for _, normal in floors]
        k = int(np.argmax([share / height for (share, _), height in zip(floors, heights, strict=True)]))
        share, up = floors[k]
        confidence = float(np.clip((share - FLOOR) / (SURE - FLOOR), 0, 1))
        if heights[k] == LYING:
            confidence = max(confidence, KNOWN)
    else:
        moments = np.einsum("kd,di,dj->ij", good, sample.gaze, sample.gaze, optimize=False) / good.sum()
        values, axes = np.linalg.eigh(moments)
        if values[0] < LEVEL * values[1]:
            up, confidence = axes[:, 0], 0.3
            near = [normal for _, normal in peaks if abs(normal @ up) > LEANS]
            up = near[0] if near else up
    if confidence > 0:
        up = up * _sign(up, gaze, default, confidence)
        agrees = float(up @ default)
        if agrees < -0.2 or (agrees < 0.3 and confidence < KNOWN):  # a wall, likely
            up, confidence = default, 0.0
    height = sample.means @ up
    facing = area * (np.abs(sample.normals @ up) > 0.9)
    return Upright(up, _ground(height, facing if facing.any() else area), confidence)


def height_over_width(points: np.ndarray, up: np.ndarray) -> float:
    """Height of most of ``points`` (n, 3) along ``up``, as a share of their mean width across it."""
    spans = []
    for axis in (up, *level_axes(up)):
        low, high = np.quantile(points @ axis, [0.1, 0.9])
        spans.append(high - low)
    return float(spans[0] / max((spans[1] + spans[2]) / 2, 1e-12 * max(spans[0], 1e-12)))


def _sign(axis: np.ndarray, gaze: np.ndarray, default: np.ndarray, confidence: float) -> float:
    """People look down on floors; where they look level, the default tells top from bottom."""
    tilt = float(axis @ gaze)
    return -1.0 if tilt - 0.5 * float(axis @ default) > 0 else 1.0


def _area_in_pictures(sample: Sample, best: Places) -> np.ndarray:
    """(n,) share of each splat of the sample in pictures from the best places."""
    rows = np.arange(len(sample.means))
    area = np.zeros(len(rows))
    worth = np.maximum(best.worth - 0.5 * best.worth.max(), 0)
    directions = sample.gaze.T.astype(np.float32)
    for k in range(min(SEEN_FROM, len(best.places))):
        seen, toward = sample.seen_at(best.depth[k], best.places[k], rows)
        away = np.linalg.norm(sample.means - best.places[k], axis=1) + 1e-9 * sample.radius
        nearest = (toward.astype(np.float32) @ directions).argmax(axis=1)
        area += seen * worth[k][nearest] * np.minimum(sample.size / away, COARSE) ** 2
    area *= sample.thin.opacities
    total = area.sum()
    return area / total if total > 0 else np.full(len(rows), 1 / max(len(rows), 1))


def _planes(normals: np.ndarray, area: np.ndarray, axes: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Shares of the area that face one way, and the mean normal of each, largest first."""
    normals, area = _gathered(normals, area, axes)
    grid = fibonacci(2 * PEAKS)[:PEAKS] @ axes  # one of each pair of opposites
    cosine = np.abs(normals.astype(np.float32) @ grid.T.astype(np.float32))
    share = np.einsum("ng,n->g", cosine > PLANE, area, optimize=False)
    found = []
    for k in np.argsort(-share, kind="stable")[:200]:
        if share[k] >= share[np.abs(grid @ grid[k]) > 0.9].max():
            normal = grid[k]
            for _ in range(4):
                along = normals @ normal
                on = np.abs(along) > PLANE
                mean = (normals[on] * (np.sign(along[on]) * area[on])[:, None]).sum(axis=0)
                normal = mean / max(float(np.linalg.norm(mean)), 1e-30) if on.any() else normal
            found.append((float(share[k]), normal))
    return found[:5]


def _gathered(normals: np.ndarray, area: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(k, 3) mean normals, up to their sign, and (k,) areas of splats that face within ``1 / CELLS`` of one
    way: far fewer than the splats."""
    along = normals @ axes.T
    first = np.abs(along).argmax(axis=1)
    rows = np.arange(len(along))
    along = along * np.sign(along[rows, first])[:, None]
    cells = np.floor(along * CELLS).astype(int) + CELLS
    keys = ((first * (2 * CELLS + 1) + cells[:, 0]) * (2 * CELLS + 1) + cells[:, 1]) * (
        2 * CELLS + 1
    ) + cells[:, 2]
    _, cell = np.unique(keys, return_inverse=True)
    sums = np.stack([np.bincount(cell, along[:, k] * area) for k in range(3)], axis=1)
    length = np.maximum(np.linalg.norm(sums, axis=1), 1e-300)
    return (sums / length[:, None]) @ axes, np.bincount(cell, area)


def _ground(height: np.ndarray, weight: np.ndarray) -> float:
    """The height in the lower part at which most of the ``weight`` lies."""
    low, high = np.quantile(height[weight > 0], [0.01, 0.99])
    cells = np.clip((height - low) / (high - low + 1e-12) * 100, 0, 99).astype(int)
    mass = np.convolve(np.bincount(cells, weight, minlength=100), [1, 1, 1], "same")
    return float(low + (int(mass[:60].argmax()) + 0.5) / 100 * (high - low))
