"""The picture of what photographs show: counts by hand, colours by counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _balls import ball_view, cameras_around

from meshsplats.cameras.trajectories import look_at
from meshsplats.datasets.views import View, ViewImage
from meshsplats.training.coverage import CAMERA, FAR, MORE, NONE, ONE, SIDE, counts_of_fans, coverage_picture
from meshsplats.training.growth import SHELL
from meshsplats.training.initial import fans_of
from meshsplats.training.patches import Patches, flat_splats


def squares(points, normal, side=0.3):
    points = np.asarray(points, np.float64)
    return Patches.squares(points, np.tile(np.asarray(normal, np.float64), (len(points), 1)), side, 0.99)


def view_from(place, target) -> View:
    camera = look_at(place, target, up=(0, 0, 1), width=40, height=40, fov=60)
    return View(camera, ViewImage(np.zeros((40, 40, 3), np.uint8)))


@pytest.fixture(scope="module")
def two_walls():
    """Fans of a wall at y = 2, and one fan at y = 4, behind it."""
    x, z = (0.2 * axis.ravel() for axis in np.meshgrid(np.arange(-5, 6), np.arange(-5, 6)))
    wall = squares(np.column_stack([x, np.full(len(x), 2.0), z]), (0, -1, 0))
    mesh = fans_of(flat_splats(Patches.joined(wall, squares([[0, 4, 0]], (0, -1, 0)))), 6)
    return replace(mesh, up=np.array([0, 0, 1], np.float32))


def test_a_fan_counts_the_views_that_nothing_hides_it_from(two_walls):
    middle = len(two_walls.vertices) // 7 // 2
    front, back, away = ([0, -1, 0], [0, 0, 0]), ([0, 7, 0], [0, 6, 0]), ([0, -1, 0], [0, -2, 0])
    for looks, in_front, behind in (
        ([front], 1, 0),
        ([back], 0, 1),
        ([front, back, front], 2, 1),
        ([away], 0, 0),
    ):
        counts = counts_of_fans(two_walls, [view_from(*look) for look in looks])
        assert counts[-1] == behind
        assert counts[middle] == in_front


def share_of(image: np.ndarray, color) -> float:
    return float((np.abs(image - np.array(color)).max(axis=2) < 0.02).mean())


def parts_of(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The row of sides by counts, and the plan in its colours and by counts."""
    top = picture.shape[0] - 2 * SIDE
    return picture[top // 2 : top - 20], picture[top:, : 2 * SIDE], picture[top:, 2 * SIDE :]


def test_a_ball_seen_from_around_is_green_and_the_unseen_side_of_one_is_black():
    views = [ball_view(camera) for camera in cameras_around(24, side=32)]
    points = np.random.default_rng(0).normal(size=(800, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    mesh = fans_of(flat_splats(Patches.squares(points, points, 0.25, 0.99)), 6)
    mesh = replace(mesh, up=np.array([0, 0, 1], np.float32))
    sides, _, plan = parts_of(coverage_picture(mesh, views))
    assert share_of(sides, MORE) > 0.1
    assert share_of(sides, ONE) < 0.001
    assert share_of(sides, NONE) > 0.3  # around the ball
    assert share_of(plan, CAMERA) > 0.001
    half = [view for view in views if view.camera.center[0] > 1.5]
    one_side, _, _ = parts_of(coverage_picture(mesh, half))
    assert share_of(one_side, NONE) > share_of(sides, NONE) + 0.03  # a side of the ball
    assert share_of(one_side, MORE) < 0.5 * share_of(sides, MORE)


def test_the_shell_is_far_and_no_part_of_the_plan():
    """Seen from amid cameras that look outwards."""
    ways = [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]
    views = [view_from(0.1 * np.array(way), way) for way in ways]
    points = np.random.default_rng(0).normal(size=(3000, 3))
    points *= 5 / np.linalg.norm(points, axis=1, keepdims=True)
    mesh = fans_of(flat_splats(Patches.squares(points, -points / 5, 0.6, 0.99)), 6)
    corners = len(mesh.vertices) // len(points)
    shell = np.repeat(points[:, 0] > 0, corners)
    mesh = replace(mesh, up=np.array([0, 0, 1], np.float32), attributes={SHELL: shell.astype(np.float32)})
    sides, _, plan = parts_of(coverage_picture(mesh, views))
    assert share_of(sides, FAR) > 0.05
    assert share_of(sides, ONE) > 0.05
    assert share_of(plan, FAR) == 0
    assert np.array_equal(coverage_picture(mesh, views), coverage_picture(mesh, views))
