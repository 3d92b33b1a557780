"""Layers behind each other are counted from every side that light takes."""

from __future__ import annotations

import numpy as np
import pytest
from _blender_scenes import random_mesh, sheets

from meshsplats.blender.layers import bounce_limit, count_layers, hidden_by_limit, most_layers
from meshsplats.cameras.trajectories import look_at


@pytest.mark.parametrize("count", [1, 7, 300, 3000])
def test_sheets_are_counted_whatever_hides_them(count):
    camera = look_at((0.1, 0.2, -60), (0, 0, 0), width=9, height=9, fov=1)
    counted = count_layers(sheets(count, 0.99), camera)
    assert abs(counted[4, 4] - count) <= max(0, count / 1000)


def test_count_agrees_with_triangles_met_one_by_one():
    mesh = random_mesh(40)
    camera = look_at((0, 0, -4), (0, 0, 0), width=16, height=16)
    points = camera.world_to_camera[:3, :3] @ mesh.vertices.T + camera.world_to_camera[:3, 3:]
    flat = np.stack(
        [camera.fx * points[0] / points[2] + camera.cx, camera.fy * points[1] / points[2] + camera.cy]
    )
    turn = lambda u, v: u[0] * v[1] - u[1] * v[0]  # noqa: E731
    expected = np.zeros((16, 16), int)
    for face in mesh.faces:
        a, b, c = flat[:, face].T
        for row in range(16):
            for column in range(16):
                p = np.array([column + 0.5, row + 0.5])
                signs = [turn(v - u, p - u) > 0 for u, v in ((a, b), (b, c), (c, a))]
                expected[row, column] += all(signs) or not any(signs)
    assert (count_layers(mesh, camera) == expected).all()


def test_most_layers_looks_along_the_light_too():
    mesh = sheets(50, 0.5)  # behind each other along z, side by side from elsewhere
    sideways = look_at((5, 0.1, 0.2), (0, 0, 0.2), width=20, height=20)
    assert count_layers(mesh, sideways).max() < 50
    assert 50 <= most_layers(mesh, [sideways]) <= 100  # twice where a ray meets the squares' diagonals
    assert most_layers(mesh.take(np.zeros(len(mesh.faces), bool))) == 0


def test_bounce_limit_leaves_room_and_stops_at_blenders_own():
    assert bounce_limit(0) == 64
    assert bounce_limit(100) == 125
    assert bounce_limit(5000) == 1024


def test_hidden_by_limit_is_a_share_of_pixels():
    camera = look_at((0, 0, -3), (0, 0, 0), width=40, height=40, fov=30)
    assert hidden_by_limit(sheets(30, 0.05), camera, 10) > 0.5
    assert hidden_by_limit(sheets(30, 0.05), camera, 30) == 0
    assert hidden_by_limit(sheets(30, 1.0), camera, 1) == 0  # what nobody sees does not count
