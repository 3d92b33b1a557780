"""Which photographs depths are found of: evenly spread ones, and those of rooms that few show."""

from __future__ import annotations

import numpy as np
from _balls import cameras_around

from meshsplats.scene.camera import Camera
from meshsplats.training.references import NEEDED, references


def in_a_room(middle: np.ndarray, count: int) -> list[Camera]:
    """Looking at its far wall, all from the same side."""
    cameras = []
    for x in np.linspace(-0.5, 0.5, count):
        matrix = np.eye(4)
        matrix[:3, 3] = -(middle + np.array([x, 0, 0]))
        cameras.append(Camera(matrix, 60, 60, 32, 32, 64, 64))
    return cameras


def wall(middle: np.ndarray, count: int = 200) -> np.ndarray:
    return middle + np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 3.1), (count, 3))


def test_a_room_that_few_photographs_show_is_not_left_out():
    first, second = np.zeros(3), np.array([0, 0, 12.0])  # one behind the other
    cameras = [*in_a_room(first, 140), *in_a_room(second, 5), *in_a_room(first, 55)]
    points = np.concatenate([wall(first), wall(second)])
    chosen = references(cameras, points, 20)
    assert len(set(chosen)) == 20
    assert chosen == sorted(chosen)
    inner = [i for i in chosen if 140 <= i < 145]
    assert len(inner) >= NEEDED
    assert np.ptp(chosen) > 150  # the others stay spread


def test_references_are_evenly_spread_where_all_show_the_same():
    cameras = cameras_around(50)
    points = np.random.default_rng(0).normal(0, 0.2, (300, 3))
    assert references(cameras, points, 10) == list(range(0, 50, 5))
    assert references(cameras, points, 60) == list(range(50))
    assert references(cameras, points[:0], 10) == list(range(0, 50, 5))
