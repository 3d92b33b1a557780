"""Vertex colours multiply the texture (glTF 2.0, 3.9.2), wherever it is shown or written."""

from __future__ import annotations

import base64
import importlib.util
import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from _gltf_meshes import TRIANGLE, gltf

import meshsplats as ms
from meshsplats import DataWarning
from meshsplats.errors import NoTextureWarning
from meshsplats.formats.gltf.scene_writer import png_of
from meshsplats.scene.base_mesh import BaseMesh, Texture
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear

pytest.importorskip("PIL", reason="Pillow is not installed")

PIXEL = np.array([200, 100, 50, 255], np.uint8)
MIDDLE = np.full((1, 3), 1 / 3)
TINTS = np.array([[1, 0, 0.25, 1], [0.25, 0.5, 1, 1], [0.25, 1, 0.25, 1]], np.float32)


def write(
    folder: Path, colors: np.ndarray | None, material: dict | None = None, *, flag: bool = False, **more
) -> Path:
    """A triangle with a texture of one pixel, COLOR_0 ``colors``, normalized by ``flag``, and what
    ``material`` has beyond that."""
    arrays = [(TRIANGLE, "VEC3", False), (TRIANGLE[:, :2].copy(), "VEC2", False)]
    attributes = {"POSITION": 0, "TEXCOORD_0": 1}
    if colors is not None:
        values = np.asarray(colors)
        arrays.append((values if values.dtype.kind == "u" else values.astype("<f4"), "VEC4", flag))
        attributes["COLOR_0"] = 2
    image = "data:image/png;base64," + base64.b64encode(png_of(PIXEL.reshape(1, 1, 4))).decode()
    look = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}} | (material or {})
    document = gltf(arrays, primitive={"attributes": attributes, "material": 0}, **more)
    document |= {"materials": [look], "textures": [{"source": 0}], "images": [{"uri": image}]}
    path = folder / "tinted.gltf"
    path.write_text(json.dumps(document))
    return path


def product(tint: np.ndarray) -> np.ndarray:
    """Display RGB of the pixel times linear ``tint`` (3,)."""
    return linear_to_srgb(srgb_to_linear(PIXEL[:3] / 255) * tint)


def tinted(**changes) -> BaseMesh:
    texture = Texture(np.tile(PIXEL, (4, 4, 1)), ("clamp", "clamp"))
    given = {"uv": TRIANGLE[None, :, :2] / 2, "face_texture": [0], "textures": (texture,), "tints": TINTS}
    return BaseMesh(TRIANGLE, [[0, 1, 2]], **(given | changes))


def test_colours_of_vertices_multiply_a_texture_in_linear_light(tmp_path):
    base = ms.load_base(write(tmp_path, TINTS))
    np.testing.assert_array_equal(base.tints, TINTS)
    shown = base.colors_at(np.zeros(1, int), MIDDLE)[0]
    np.testing.assert_allclose(shown[:3], product(TINTS[:, :3].mean(axis=0)), atol=1e-6)
    with pytest.warns(NoTextureWarning, match="its texture counts as"):
        mesh = ms.load_vertex_colored(tmp_path / "tinted.gltf")
    wanted = [product(tint[:3]) for tint in TINTS]
    np.testing.assert_allclose(mesh.colors[mesh.faces[0], :3], wanted, atol=1e-6)
    laid = ms.bind(base, triangles=1, layers=1).mesh
    assert np.abs(laid.colors[:, :3] - wanted).min(axis=0).max() < 1e-6


@pytest.mark.parametrize("dtype", ["u1", "<u2"])
@pytest.mark.parametrize("flag", [True, False])
def test_whole_numbers_are_fractions_and_warned_of_once(tmp_path, dtype, flag):
    most = np.iinfo(dtype).max
    path = write(tmp_path, np.round(TINTS * most).astype(dtype), flag=flag)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        base = ms.load_base(path)
    np.testing.assert_allclose(base.tints, TINTS, atol=0.5 / most)
    assert ["COLOR_0 has integers without the flag" in str(each.message) for each in found] == [True] * (
        not flag
    )


def test_white_changes_nothing(tmp_path):
    plain, white = (ms.load_base(write(tmp_path, colors)) for colors in (None, np.ones((3, 4))))
    assert white.tints is None
    at = np.zeros(1, int), MIDDLE
    np.testing.assert_array_equal(white.colors_at(*at), plain.colors_at(*at))
    beside = ms.BaseMesh(
        np.concatenate([TRIANGLE, TRIANGLE]),
        [[0, 1, 2], [3, 4, 5]],
        uv=np.tile(plain.uv, (2, 1, 1)),
        face_texture=[0, 0],
        textures=plain.textures,
        tints=np.concatenate([TINTS, np.ones_like(TINTS)]),
    )
    np.testing.assert_array_equal(beside.colors_at(np.ones(1, int), MIDDLE), plain.colors_at(*at))


@pytest.mark.parametrize(
    ("material", "alpha", "counts"),
    [({"alphaMode": "BLEND"}, 0.25, True), ({}, 1, True), ({"emissiveFactor": [1, 1, 1]}, 1, False)],
)
def test_alpha_modes_and_what_emits(tmp_path, material, alpha, counts):
    if not counts:
        material |= {
            "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
            "emissiveTexture": {"index": 0},
        }
    base = ms.load_base(write(tmp_path, np.full((3, 4), 0.25), material))
    shown = base.colors_at(np.zeros(1, int), MIDDLE)[0]
    np.testing.assert_allclose(shown, [*product(np.full(3, 0.25 if counts else 1)), alpha], atol=1e-6)


def test_opacities_beside_a_texture_that_cuts_out_are_told_of(tmp_path):
    path = write(tmp_path, np.full((3, 4), 0.25), {"alphaMode": "MASK"})
    with pytest.warns(DataWarning, match="opacities of the vertices of 1 primitives were left out"):
        base = ms.load_base(path)
    assert (base.tints == np.array([0.25, 0.25, 0.25, 1], np.float32)).all()


def test_a_texture_of_the_user_is_shown_as_it_is(tmp_path):
    (tmp_path / "own.png").write_bytes(png_of(PIXEL.reshape(1, 1, 4)))
    assert ms.load_base(write(tmp_path, TINTS), texture=tmp_path / "own.png").tints is None


def test_binary_gltf_keeps_both(tmp_path):
    ms.save_base(tinted(), tmp_path / "surface.glb")
    ms.save_scene(tmp_path / "scene.glb", surface=tinted())
    for name in ("surface", "scene"):
        back = ms.load_base(tmp_path / f"{name}.glb")
        np.testing.assert_allclose(back.tints[back.faces[0]], TINTS, atol=1e-5)
        np.testing.assert_array_equal(back.textures[0].pixels, tinted().textures[0].pixels)


def test_translucent_tints_of_a_scene_are_blended(tmp_path):
    faint = TINTS * [1, 1, 1, 0.5]
    ms.save_scene(tmp_path / "scene.glb", surface=tinted(tints=faint))
    np.testing.assert_allclose(ms.load_base(tmp_path / "scene.glb").tints[:, 3], 0.5)


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_what_other_formats_leave_out_is_told_of(tmp_path, suffix):
    path = tmp_path / f"surface{suffix}"
    with pytest.warns(DataWarning, match=f"surface{suffix}: left out are the vertex colours by which"):
        ms.save_base(tinted(), path)
    assert ms.load_base(path).textured
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ms.save_base(tinted(tints=None), path)


@pytest.mark.skipif(importlib.util.find_spec("pxr") is None, reason="install meshsplats[usd]")
def test_packages_of_usd_have_the_texture_alone(tmp_path):
    for write_to, given in ((ms.save_base, (tinted(),)), (ms.save_scene, ())):
        path = tmp_path / f"{write_to.__name__}.usdz"
        with pytest.warns(DataWarning, match="which only .glb keeps beside a texture"):
            write_to(*given, path, **({} if given else {"surface": tinted()}))
        assert ms.load_base(path).textured


def test_tints_are_checked():
    with pytest.raises(ValueError, match=r"tints must lie in \[0, 1\], got 0 to 2"):
        tinted(tints=2 * TINTS)
    with pytest.raises(ValueError, match="tints needs uv"):
        BaseMesh(TRIANGLE, [[0, 1, 2]], tints=TINTS)
    with pytest.raises(ValueError, match="tints must have shape"):
        tinted(tints=TINTS[:2])
