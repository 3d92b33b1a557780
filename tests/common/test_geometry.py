"""Geometry that several rooms share."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats._common.geometry import direction, rotation_rows, vertex_normals

AXES = np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
"""Right, up and forward of someone who looks along +y in a world whose z is up."""


def test_a_quaternion_is_the_rotation_by_its_angle_around_its_axis():
    half = np.sqrt(0.5)
    quarter_turn = np.array(list(rotation_rows(half, 0.0, 0.0, half)))  # around z: x to y, y to -x
    np.testing.assert_allclose(quarter_turn, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    rng = np.random.default_rng(0)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    rotation = np.array(list(rotation_rows(np.cos(0.4), *np.sin(0.4) * axis)))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(rotation @ axis, axis, atol=1e-15)
    assert np.trace(rotation) == pytest.approx(1 + 2 * np.cos(0.8))


def test_rotations_of_arrays_are_those_of_their_items():
    quaternions = np.random.default_rng(1).normal(size=(5, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    together = np.moveaxis(np.array(list(rotation_rows(*quaternions.T))), 2, 0)
    np.testing.assert_array_equal(together, [list(rotation_rows(*map(float, q))) for q in quaternions])


@pytest.mark.parametrize(
    ("azimuth", "elevation", "expected"),
    [
        (0, 0, (0, -1, 0)),  # in front, from where one looks along +y
        (90, 0, (1, 0, 0)),
        (180, 0, (0, 1, 0)),
        (35, 90, (0, 0, 1)),
        (90, 30, (np.sqrt(0.75), 0, 0.5)),
    ],
)
def test_directions_worked_out_by_hand(azimuth, elevation, expected):
    np.testing.assert_allclose(direction(AXES, azimuth, elevation), expected, atol=1e-15)


def test_vertex_normals_are_weighted_by_area_and_shared_at_a_seam():
    """Two right triangles that meet at the x axis: one of area 2 in the plane z = 0, one of area 1/2 in the
    plane y = 0. Its vertices at the seam are split."""
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 0], [1, 0, 0], [0, 0, 1], [9, 9, 9]], float)
    faces = np.array([[0, 1, 2], [3, 5, 4]])
    up, side = np.array([0, 0, 1.0]), np.array([0, 1.0, 0])
    alone = vertex_normals(vertices, faces, fallback=(1, 0, 0))
    np.testing.assert_array_equal(alone, [up, up, up, side, side, side, (1, 0, 0)])
    joined = vertex_normals(vertices, faces, same_place=np.array([0, 1, 2, 0, 3, 4, 5]))
    corner = (4 * up + side) / np.sqrt(17)
    np.testing.assert_allclose(joined, [corner, up, up, corner, side, side, up], atol=1e-15)
