"""Which photographs depths are found of, where not of all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.scene.camera import Camera

NEEDED = 3
"""Photographs that should show a place: a depth counts if two others confirm it."""
FARTHER = 3.0
"""Multiple of the depth in the nearest photograph beyond which one does not count as showing a place: walls
may be between."""
POINTS = 2000
"""Places that are looked at, at most."""
WORTH = 0.005
"""Share of them that an exchange must gain."""


def references(cameras: Sequence[Camera], points: np.ndarray, most: int) -> list[int]:
    """At most ``most`` indices of ``cameras``, ascending, of those whose depths are found: evenly spread, but
    for some that are exchanged for others, where fewer than ``NEEDED`` would show one of ``points`` (n, 3).

    A room that few of many photographs show is not left out so.
    """
    chosen = list(subsample(range(len(cameras)), most))
    if len(chosen) == len(cameras) or not len(points):
        return chosen
    shown = _shown(cameras, subsample(points, POINTS))
    wanted = np.minimum(shown.sum(axis=0), NEEDED)
    count = shown[chosen].sum(axis=0)
    while True:
        gain = (shown & (count < wanted)).sum(axis=1)
        gain[chosen] = 0
        best = int(gain.argmax())
        more = count + shown[best]
        loss = (shown[chosen] & (more <= wanted)).sum(axis=1)
        least = int(loss.argmin())
        if gain[best] - loss[least] <= WORTH * shown.shape[1]:
            return sorted(chosen)
        count = more - shown[chosen[least]]
        chosen[least] = best


def _shown(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """(cameras, n) bool: which of ``points`` (n, 3) each has in its image, not much farther than others."""
    depths = np.full((len(cameras), len(points)), np.inf, np.float32)
    for row, camera in zip(depths, cameras, strict=True):
        at, depth = camera.project(points)
        inside = camera.in_image(at)
        row[inside] = depth[inside]
    return np.isfinite(depths) & (depths <= FARTHER * depths.min(axis=0))
