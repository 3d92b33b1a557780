"""Textures as vertex colours: what is drawn with them is what the texture shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _local import shared_data
from hypothesis import given, settings
from hypothesis import strategies as st

from meshsplats import load_mesh, orbit, render
from meshsplats.cameras.files import load_cameras
from meshsplats.cli import main
from meshsplats.errors import NoTextureWarning
from meshsplats.evaluation.metrics import psnr
from meshsplats.formats.base_meshes import load_base, load_vertex_colored, save_base
from meshsplats.formats.surfaces.vertex_colors import texture_to_vertex_colors as colored
from meshsplats.images.reading import load_image
from meshsplats.scene.base_mesh import BaseMesh, Texture
from meshsplats.surfaces.images import draw_surface

RAMP = np.empty((64, 128, 4), np.uint8)
RAMP[..., 0], RAMP[..., 1] = np.arange(128)[None] * 2, np.arange(64)[:, None] * 4
RAMP[..., 2], RAMP[..., 3] = 50, 255


def noise(side: int) -> np.ndarray:
    """Colours of blocks of 8 x 8 texels."""
    blocks = np.random.default_rng(1).integers(0, 256, (side // 8, side // 8, 4), np.uint8)
    pixels = blocks.repeat(8, 0).repeat(8, 1)
    pixels[..., 3] = 255
    return pixels


def square(pixels: np.ndarray = RAMP, **changes) -> BaseMesh:
    """Of 2 x 2 units about 0, at z = 0, with the whole texture; v runs against y."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = (corners[:, :2] * [1, -1] + 1)[faces] / 2
    base = BaseMesh(
        corners, faces, uv=uv, face_texture=[0, 0], textures=(Texture(pixels, ("clamp", "clamp")),)
    )
    return replace(base, **changes)


def area(mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_a_texture_that_is_linear_becomes_exact_colours():
    mesh = colored(square())
    x, y = mesh.vertices[:, :2].astype(np.float64).T
    inner = np.maximum(abs(x), abs(y)) < 0.96  # beyond the middles of the last texels, there is the border
    expected = [(x + 1) * 64 - 0.5, (1 - y) * 32 - 0.5]  # in texels
    for k, texels in enumerate(expected):
        exact = texels * (2, 4)[k] / 255
        np.testing.assert_allclose(mesh.colors[inner, k], exact[inner], atol=2e-5)
    assert inner.sum() > 1000
    np.testing.assert_allclose(mesh.colors[:, 2:], [[50 / 255, 1]] * len(x), atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 40_000), st.sampled_from([8, 64, 256]))
def test_it_keeps_its_shape_and_to_the_limit(limit, side):
    mesh = colored(square(noise(side)), limit)
    assert 2 <= len(mesh.faces) <= min(limit, 2 * side * side)
    assert area(mesh) == pytest.approx(4, rel=1e-6)
    normal = np.cross(*(mesh.vertices[mesh.faces[:, k]] - mesh.vertices[mesh.faces[:, 0]] for k in (1, 2)))
    assert (normal[:, 2] > 0).all(), "as they were wound"
    np.testing.assert_allclose(mesh.normals, [[0, 0, 1]] * len(mesh.vertices), atol=1e-6)
    if 4 * len(mesh.faces) < limit:  # steps between numbers of parts are of a factor of 2
        assert len(mesh.faces) >= side * side


def test_more_triangles_show_more_until_it_is_the_texture():
    base = square(noise(128), up=[0, 1, 0])
    camera = orbit(colored(base, 2), 1, elevation=80, width=200, height=200)[0]
    truth = draw_surface(base, camera)
    scores = [psnr(render(colored(base, n), camera, samples=2).color, truth) for n in (2, 500, 5000, 50_000)]
    assert sorted(scores) == scores
    assert scores[0] < 23
    assert scores[-1] > 30
    alpha = render(colored(base, 5000), camera, samples=2).alpha
    np.testing.assert_allclose(alpha, render(colored(base, 2), camera, samples=2).alpha, atol=1e-6)


def test_faces_without_a_texture_keep_their_colours():
    colors = np.random.default_rng(2).random((4, 4), np.float32)
    half = square(face_texture=[0, -1], colors=colors)
    for base, own in ((half, colors[[0, 2, 3]]), (replace(half, colors=None), [[0.5, 0.5, 0.5, 1]] * 3)):
        mesh = colored(base, 1000)
        (whole,) = mesh.faces[[np.ptp(mesh.vertices[face], axis=0)[0] == 2 for face in mesh.faces]]
        np.testing.assert_allclose(mesh.colors[whole], own, atol=1e-6)
        assert 400 < len(mesh.faces) <= 1000
    bare = colored(square(face_texture=[-1, -1], colors=colors), 1000)
    np.testing.assert_array_equal(bare.colors, colors)
    assert len(bare.faces) == 2


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_commands_show_what_the_texture_shows(tmp_path, capsys, suffix):
    """Where other programs would see white: in images, and in files without textures."""
    path = tmp_path / f"square{suffix}"
    save_base(square(noise(64)), path)
    with pytest.warns(NoTextureWarning, match=r"its texture counts as the colours of [\d,]+ vertices"):
        mesh = load_vertex_colored(path)
    assert len(mesh.faces) == 2 * 64**2
    assert main(["render", str(path), "-o", str(tmp_path / "a.png"), "--elevation", "40"]) == 0
    assert "its texture counts as the colours of" in capsys.readouterr().err
    camera = load_cameras(tmp_path / "a.png.cameras.json")[0]
    truth = draw_surface(load_base(path), camera)
    assert psnr(load_image(tmp_path / "a.png") / 255, truth) > 30
    assert main(["convert", str(path), "-o", str(tmp_path / "b.ply"), "--no-preview"]) == 0
    np.testing.assert_allclose(load_mesh(tmp_path / "b.ply").colors, mesh.colors, atol=1e-6)


def test_a_real_texture():
    """Of another program's file, whose library of materials names none: it is given."""
    folder = shared_data("meshes/spot_textured/spot")
    base = load_base(folder / "spot_triangulated.obj", texture=folder / "spot_texture.png")
    mesh = colored(base)
    for camera in orbit(mesh, 3, width=300, height=300):
        drawn = render(mesh, camera, samples=2).color
        assert psnr(drawn, draw_surface(base, camera)) > 40
