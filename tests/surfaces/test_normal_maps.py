"""Normal maps: a shader that reads one has the normals of the fine surface."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshsplats.formats.surfaces.tangents import corner_frames
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.surfaces import make_surface
from meshsplats.surfaces.normal_maps import _continued, _texels, normal_map, relief_of

needs_scipy = pytest.mark.skipif(importlib.util.find_spec("scipy") is None, reason="install meshsplats[base]")
SIDE = 64


def square(n: int, height) -> tuple[np.ndarray, np.ndarray]:
    """A square from 0 to 1 of n x n cells that faces +z, at ``height`` of x and y."""
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
    points = np.stack([x, y, height(x, y)], axis=2).reshape(-1, 3)
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (k.ravel() for k in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    return points, np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3).astype(np.int32)


def waves(x, y):
    return 0.03 * np.sin(9 * x) * np.cos(5 * y)


def rotation(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@needs_scipy
@settings(max_examples=6, deadline=None)
@given(angle=st.floats(0, 6.2), mirrored=st.booleans())
def test_the_map_of_a_flat_square_holds_the_normals_of_waves(angle, mirrored):
    fine = square(120, waves)
    light = square(1, lambda x, y: 0 * x)
    place = light[0][:, :2] - 0.5
    turned = place @ rotation(angle).T * (0.6, 0.6) * (1, -1 if mirrored else 1) + 0.5
    uv = turned[light[1]].astype(np.float32)
    pixels = normal_map(*light, uv, SIDE, relief_of(*fine))
    # By hand: where a texel lies on the square, and the normal of the waves there.
    v, u = (np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE
    back = (np.stack([u, v], axis=2) - 0.5) / 0.6 * (1, -1 if mirrored else 1)
    x, y = np.moveaxis(back @ rotation(angle) + 0.5, 2, 0)
    slope = np.stack([0.27 * np.cos(9 * x) * np.cos(5 * y), -0.15 * np.sin(9 * x) * np.sin(5 * y)], axis=2)
    normal = np.concatenate([-slope, np.ones((SIDE, SIDE, 1))], axis=2)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    right = rotation(angle).T @ (1, 0)
    up = rotation(angle).T @ (0, 1 if mirrored else -1)
    expected = np.stack([normal[..., :2] @ right, normal[..., :2] @ up, normal[..., 2]], axis=2)
    inside = (np.abs(x - 0.5) < 0.45) & (np.abs(y - 0.5) < 0.45)
    assert inside.sum() > 500
    np.testing.assert_allclose(pixels[inside] / 127.5 - 1, expected[inside], atol=0.03)
    # Where the texture shows nothing, it goes on.
    assert (pixels[..., 2] > 200).all()


@needs_scipy
def test_the_border_of_a_chart_reads_no_other_one():
    """Two charts, three texels apart: interpolation at the border of one takes its own texels."""
    corners = np.array([[(4, 5), (24, 7), (4, 27)], [(28, 7), (28, 27), (8, 27)]]) + 0.3
    face, weights = _continued(*_texels((corners / 32).astype(np.float32), 32), corners / 32)
    share = np.linspace(0, 1, 50)[:, None]
    for number, triangle in enumerate(corners):
        border = np.concatenate(
            [share * p + (1 - share) * q for p, q in zip(triangle, triangle[[1, 2, 0]], strict=True)]
        )
        column, row = np.floor(border - 0.5).astype(int).T
        read = face[[row, row, row + 1, row + 1], [column, column + 1, column, column + 1]]
        assert (read == number).mean() > 0.97, "all but at sharp corners"
        assert (read != 1 - number).all()
    assert weights.min() >= 0
    np.testing.assert_allclose(weights[face >= 0].sum(axis=1), 1, atol=1e-5)


def test_tangents_follow_a_curved_surface_and_join_across_its_triangles():
    # A half pipe along y, u around it: tangents are the derivative by the angle.
    angle, y = np.meshgrid(np.linspace(0, np.pi, 33), np.linspace(0, 1, 5), indexing="ij")
    points = np.stack([-np.cos(angle), y, np.sin(angle)], axis=2).reshape(-1, 3)
    number = np.arange(33 * 5).reshape(33, 5)
    a, b, c, d = (k.ravel() for k in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)
    flat = np.stack([angle / np.pi, 1 - y], axis=2).reshape(-1, 2)
    frames = corner_frames(points, faces, flat[faces].astype(np.float32))
    expected = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=2).reshape(-1, 3)[faces]
    np.testing.assert_allclose(frames.tangents, expected, atol=0.06)
    assert (frames.signs == 1).all()
    for vertex in (7, 81, 150):
        here = frames.tangents[faces == vertex]
        np.testing.assert_allclose(here, np.broadcast_to(here[0], here.shape), atol=1e-12)
    mirrored = corner_frames(points, faces, (flat * (-1, 1))[faces].astype(np.float32))
    np.testing.assert_allclose(mirrored.tangents, -frames.tangents, atol=1e-9)
    assert (mirrored.signs == -1).all()


def test_triangles_without_an_area_in_the_texture_have_some_tangent():
    points, faces = square(2, waves)
    frames = corner_frames(points, faces, np.zeros((len(faces), 3, 2), np.float32))
    np.testing.assert_allclose(np.linalg.norm(frames.tangents, axis=2), 1)
    np.testing.assert_allclose((frames.tangents * frames.normals).sum(axis=2), 0, atol=1e-12)


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("skimage", "fast_simplification", "uvunwrap")),
    reason="install meshsplats[base], with Python 3.11 or newer",
)
def test_a_surface_with_fewer_triangles_than_voxels_gives_has_a_map():
    from _meshes import unit_ball

    from meshsplats import SplatMesh

    points, faces = unit_ball(3)
    ball = SplatMesh(points, faces, np.tile([0.8, 0.4, 0.2, 1], (len(points), 1)))
    how = {"views": 12, "size": 64, "resolution": 24, "threads": 1, "rounds": 0, "texture": 128}
    light: BaseMesh = make_surface(ball, faces=300, **how)
    assert light.normal_map is not None
    assert light.normal_map.shape == (32, 32, 3)
    assert make_surface(ball, faces=300, normal_map=False, **how).normal_map is None
    assert make_surface(ball, faces=0, **how).normal_map is None, "nothing is left out of the fine surface"
    with pytest.raises(ValueError, match="normal_map has no effect without texture"):
        make_surface(ball, normal_map=False, **(how | {"texture": 0}))
