"""Which way is up, and where the ground is, from floors, walls and the views that were found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshsplats._common.geometry import level_axes
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
KNOWN, MEASURED = 0.5, 0.8
"""How sure it is at least which way is up where another direction than the default is believed, and where
floors or ground are level."""
LIKELY = 0.7
"""Cosine to the default of what is believed with less, at least, where nothing is level."""
LEANS = 0.8
"""Least cosine between the normal of a plane and the axis of those directions that it makes exact."""
SEEN_FROM = 24
"""Number of the best places from which planes are looked at."""
FACING = 0.85
"""Cosine between up and the normals of splats, at least, whose heights are looked at."""
TILTS = ((12.0, 1.0, 0.02), (2.0, 0.25, 0.01), (0.5, 0.1, 0.005))
"""Rounds in which up is made exact: how far it is tilted and in which steps, degrees, and the size of a step
of height, as a share of the radius of the scene."""
LEVEL_GROUND = 2.1
"""Floors and ground are level where heights gather so many times as much as along the usual tilt. Lawns and
slopes have 1.4 to 2.2, floors, streets and fields 3 to 6."""
ALIGNED = 3.0
"""Degrees from an axis within which it was meant to be up: few scenes that nobody has turned lie so close."""


@dataclass(frozen=True, eq=False)
class Upright:
    """Which way is up."""

    up: np.ndarray
    """(3,) unit direction."""
    ground: float
    """Height of the ground along ``up``."""
    confidence: float
    """0: the format's default, as the splats do not tell; 1: a large floor was found. ``MEASURED`` at least
    for the coordinates of a survey."""
    level: bool
    """Whether floors or ground are level, by which up is exact."""


def find_upright(sample: Sample, places: Places, default: np.ndarray, *, exact: bool = False) -> Upright:
    """Up from the largest plane in the best views, or from their being level; else ``default`` (3,). If that
    is ``exact``, floors and ground count only where they are level by another direction altogether: if they
    lean from it, it is they that are not level."""
    best = places.best()
    area = _area_in_pictures(sample, best)
    scales = np.sort(sample.thin.scales, axis=1)
    flat = (scales[:, 0] < 0.5 * scales[:, 1]) & (area > 0)
    flat_area = area * flat
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
    measured, level = _measured(sample, flat_area, up)
    if not level and confidence < KNOWN and up @ default < LIKELY:
        up, confidence = default, 0.0
        measured, level = _measured(sample, flat_area, up)
    if level:
        up, confidence = aligned(measured), max(confidence, MEASURED)
    if exact and (not level or up @ default > np.sqrt(0.5)):
        up, confidence = default, MEASURED
    height = sample.means @ up
    facing = area * (np.abs(sample.normals @ up) > 0.9)
    return Upright(up, _ground(height, facing if facing.any() else area), confidence, level)


def _measured(sample: Sample, area: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, bool]:
    """``levelled`` of the splats with ``area`` (n,) in pictures that face ``up`` or down, and whether they
    gather enough for floors or ground."""
    rows = np.flatnonzero((area > 0) & (np.abs(sample.normals @ up) > FACING))
    exact, gathered = levelled(sample.means[rows], area[rows], up, sample.radius)
    return exact, gathered >= LEVEL_GROUND


def levelled(
    points: np.ndarray, weights: np.ndarray, up: np.ndarray, radius: float
) -> tuple[np.ndarray, float]:
    """The direction near ``up`` (3,) along which most of ``points`` (n, 3) lie at few heights: that of
    floors, tables and fields, which are level. And how much more they gather there than along the median of
    the directions around, as the sum of the squares of their ``weights`` (n,) at each height.

    So the projection profiles of a scanned page tell its skew (Postl, ICPR 1986). Normals of splats tell up
    within some 5 degrees, heights within one.
    """
    if not weights.any():
        return up, 0.0
    points = points - np.average(points, axis=0, weights=weights)
    gathered = 0.0
    for reach, step, height in TILTS:
        offsets = np.radians(np.arange(-reach, reach + step / 2, step))
        x, y = (axis.ravel() for axis in np.meshgrid(offsets, offsets))
        inside = np.hypot(x, y) <= np.radians(reach) * (1 + 1e-9)
        first, second = level_axes(up)
        tilted = up + np.tan(x[inside])[:, None] * first + np.tan(y[inside])[:, None] * second
        tilted /= np.linalg.norm(tilted, axis=1)[:, None]
        sharp = np.array([_profile_energy(points @ axis / (height * radius), weights) for axis in tilted])
        k = int(sharp.argmax())
        up, gathered = tilted[k], gathered or float(sharp[k] / np.median(sharp))
    return up, gathered


def _profile_energy(heights: np.ndarray, weights: np.ndarray) -> float:
    """The sum of the squares of the ``weights`` (n,) at each of the ``heights`` (n,), in steps of 1; a weight
    is shared by the two steps around it."""
    heights = heights - heights.min()
    below = np.floor(heights).astype(int)
    above = weights * (heights - below)
    count = int(below.max()) + 2
    mass = np.bincount(below, weights - above, count) + np.bincount(below + 1, above, count)
    return float((mass**2).sum())


def aligned(up: np.ndarray) -> np.ndarray:
    """The axis of the frame that ``up`` (3,) is close to, or ``up`` itself."""
    k = int(np.abs(up).argmax())
    axis = np.sign(up[k]) * np.eye(3)[k]
    return axis if up @ axis > np.cos(np.radians(ALIGNED)) else up


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
