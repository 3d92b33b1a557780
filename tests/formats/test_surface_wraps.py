"""Factors and wraps of textures in the files of surfaces."""

from __future__ import annotations

import importlib.util
import os

import numpy as np
import pytest

from meshsplats import BaseMesh, load_base, save_base
from meshsplats.scene.base_mesh import Texture

FACTOR = (1.0, 0.25, 0.0, 1.0)


def square(**texture) -> BaseMesh:
    """Two triangles with a texture, which lies on them twice along each side."""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    pixels = np.full((4, 4, 4), 255, np.uint8)
    pixels[:2] = [128, 200, 255, 255]
    uv = 2 * points[faces, :2]
    return BaseMesh(points, faces, uv=uv, face_texture=[0, 0], textures=(Texture(pixels, **texture),))


def written(base: BaseMesh, path) -> BaseMesh:
    if path.suffix.startswith(".usd") and importlib.util.find_spec("pxr") is None:
        pytest.skip("install meshsplats[usd]")
    save_base(base, path)
    return load_base(path)


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply", ".usda"])
def test_the_factor_is_in_the_pixels(tmp_path, suffix):
    base = square(factor=FACTOR)
    again = written(base, tmp_path / f"a{suffix}")
    face, weights = np.array([0, 1]), np.array([[0.25, 0.5, 0.25], [0.125, 0.125, 0.75]])
    shown = again.colors_at(face, weights)
    np.testing.assert_allclose(shown, base.colors_at(face, weights), atol=0.006)


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("suffix", [".glb", ".usda"])
@pytest.mark.parametrize("wrap", [("repeat", "mirror"), ("clamp", "repeat"), ("clamp", "clamp")])
def test_the_wrap_comes_back(tmp_path, suffix, wrap):
    assert written(square(wrap=wrap), tmp_path / f"a{suffix}").textures[0].wrap == wrap


@pytest.mark.parametrize(
    ("suffix", "wrap"),
    [
        (".obj", ("clamp", "clamp")),
        (".obj", ("repeat", "repeat")),
        (".ply", ("repeat", "repeat")),
    ],
)
def test_what_formats_of_text_say_comes_back(tmp_path, suffix, wrap):
    assert written(square(wrap=wrap), tmp_path / f"a{suffix}").textures[0].wrap == wrap


@pytest.mark.parametrize(
    ("suffix", "wrap"),
    [
        (".obj", ("clamp", "repeat")),
        (".obj", ("mirror", "mirror")),
        (".ply", ("clamp", "clamp")),
        (".ply", ("repeat", "mirror")),
    ],
)
def test_what_formats_of_text_do_not_say_is_refused(tmp_path, suffix, wrap):
    base = square(wrap=wrap)
    with pytest.raises(ValueError, match=f"{suffix}.*this one has wrap .'{wrap[0]}', '{wrap[1]}'.*as .glb"):
        save_base(base, tmp_path / f"a{suffix}")
    assert os.listdir(tmp_path) == []
    assert base.uv is not None
    inside = BaseMesh(
        base.vertices, base.faces, uv=base.uv / 2, face_texture=base.face_texture, textures=base.textures
    )
    assert written(inside, tmp_path / f"a{suffix}").textured
