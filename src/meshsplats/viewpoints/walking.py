"""A smooth round through views of a place: what a turntable is to an object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats._common.geometry import level_axes
from meshsplats.cameras.framing import unit_up
from meshsplats.cameras.trajectories import look_at
from meshsplats.scene.camera import Camera

MOST_KEYS = 12
"""Views that a round passes, at most: through more of them it hurries."""


def keys_of(count: int) -> int:
    """Number of views that a round of ``count`` frames passes."""
    return min(MOST_KEYS, count)


def walk(cameras: Sequence[Camera], count: int, up: Sequence[float] | np.ndarray) -> list[Camera]:
    """``count`` cameras on a smooth closed path through all ``cameras``, level and at an even pace.

    Position, direction, focal length and near plane change together; the path begins at the first camera and
    comes back to it. As few frames as cameras are these themselves, in the order of the path. It does not
    know of walls between them.

    Args:
        cameras: at least one, each with a near plane, none of which looks straight along ``up``.
        count: number of frames, at least 1.
        up: (3,) direction.

    Raises ValueError for no camera, fewer frames than one, or a bad direction.
    """
    if not cameras or count < 1:
        raise ValueError(f"a walk needs a camera and a frame, got {len(cameras)} and {count}")
    upward = unit_up(up)
    first, second = level_axes(upward)
    places = np.array([camera.center for camera in cameras])
    gaze = np.array([camera.world_to_camera[2, :3] for camera in cameras])
    lens = np.log([[camera.fx, camera.near or 1.0] for camera in cameras])
    spread = np.linalg.norm(places.std(axis=0)) or 1.0
    angles = np.arccos(np.clip(gaze @ gaze.T, -1, 1))
    lengths = np.hypot(np.linalg.norm(places[:, None] - places, axis=2) / spread, angles)
    tour = short_round(lengths)
    if count == len(cameras):
        return [replace(cameras[k], name=f"view_{i:04d}") for i, k in enumerate(tour)]
    azimuth = np.arctan2(gaze @ second, gaze @ first)[tour]
    turns = np.diff(azimuth, append=azimuth[0])
    turns = (turns + np.pi) % (2 * np.pi) - np.pi  # the shorter way round
    height = np.arcsin(np.clip(gaze @ upward, -1, 1))[tour]
    knots = np.concatenate([[0], np.cumsum(np.maximum(lengths[tour, np.roll(tour, -1)], 1e-6))])
    at = knots[-1] * np.arange(count) / count
    path = _smooth(np.column_stack([places, lens])[tour], knots, at)
    height = _smooth(height[:, None], knots, at)[:, 0]
    along = np.concatenate([[azimuth[0]], azimuth[0] + np.cumsum(turns)])
    # What is left of the turn after an even one repeats itself.
    even = (along[-1] - along[0]) / knots[-1]
    azimuth = _smooth((along - even * knots)[:-1, None], knots, at)[:, 0] + even * at
    found = []
    for i in range(count):
        level = np.cos(azimuth[i]) * first + np.sin(azimuth[i]) * second
        toward = np.cos(height[i]) * level + np.sin(height[i]) * upward
        place, (focal, near) = path[i, :3], np.exp(path[i, 3:])
        camera = look_at(place, place + 50 * near * toward, up=upward, near=near, name=f"view_{i:04d}")
        size = {name: getattr(cameras[0], name) for name in ("cx", "cy", "width", "height")}
        found.append(replace(camera, fx=focal, fy=focal, **size))
    return found


def short_round(lengths: np.ndarray) -> np.ndarray:
    """(k,) order of a closed path, beginning at 0, that no exchange of two steps makes shorter.

    Args:
        lengths: (k, k) symmetric distances.
    """
    tour, open_ones = [0], set(range(1, len(lengths)))
    while open_ones:
        tour.append(min(open_ones, key=lambda k: (lengths[tour[-1], k], k)))
        open_ones.remove(tour[-1])
    better = True
    while better:
        better = False
        for i in range(1, len(tour) - 1):
            for j in range(i + 1, len(tour)):
                a, b, c, d = tour[i - 1], tour[i], tour[j], tour[(j + 1) % len(tour)]
                if lengths[a, c] + lengths[b, d] < lengths[a, b] + lengths[c, d] - 1e-9:
                    tour[i : j + 1] = tour[i : j + 1][::-1]
                    better = True
    return np.array(tour)


def _smooth(values: np.ndarray, knots: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(n, m) closed cubic curve through ``values`` (k, m) at ``knots`` (k + 1,), evaluated ``at`` (n,); its
    slope at a knot is that between the neighbours."""
    k, steps = len(values), np.diff(knots)
    after = np.roll(values, -1, axis=0)
    slope = (after - np.roll(values, 1, axis=0)) / (steps + np.roll(steps, 1))[:, None]
    part = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, k - 1)
    step = steps[part][:, None]
    t = (at - knots[part])[:, None] / step
    ends = (2 * t**3 - 3 * t**2 + 1) * values[part] + (3 * t**2 - 2 * t**3) * after[part]
    slopes = (t**3 - 2 * t**2 + t) * slope[part] + (t**3 - t**2) * np.roll(slope, -1, axis=0)[part]
    curve: np.ndarray = ends + step * slopes
    return curve
