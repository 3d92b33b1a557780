# ruff: noqa: E402
"""Hue, saturation, brightness, contrast and opacity of splat meshes in a Blender file."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import random_mesh

from meshsplats.blender.inside import meshes, objects
from meshsplats.blender.inside.adjusting import Adjustment, adjust
from meshsplats.scene.colors import srgb_to_linear

LUMA = np.array([0.213, 0.715, 0.072])
CHANGE = Adjustment(hue=40, saturation=0.6, brightness=0.9, contrast=0.8, opacity=0.5)


def changed(rgb: np.ndarray) -> np.ndarray:
    """One after the other, by the definitions of the W3C's Filter Effects."""
    matrix, _ = Adjustment(hue=40).color_map
    turned = rgb @ matrix.T
    grey = (turned @ LUMA)[..., None]
    return ((grey + 0.6 * (turned - grey)) * 0.9 - 0.5) * 0.8 + 0.5


def data_of(lit: bool, **fields) -> tuple:
    mesh = random_mesh(30, **fields)
    display, made = mesh.colors.copy(), None
    display[:, :3] = 0.3 + 0.4 * display[:, :3]
    if lit:
        made = display.copy()
        made[:, :3] = 0.8 * srgb_to_linear(display[:, :3])
        made[:, 3] = 1 - (1 - display[:, 3]) ** 0.7
    data = meshes.make_mesh(
        "m",
        mesh.vertices,
        mesh.faces,
        made if lit else display,
        face_splat=mesh.face_splat,
        display=display if lit else None,
    )
    objects.mark(data, up=mesh.up, origin=np.zeros(3), lit=lit, linear=mesh.blending == "linear", layers=10)
    return data, display, made


def test_what_the_parts_mean():
    for angle in (0, 360):
        np.testing.assert_allclose(Adjustment(hue=angle).color_map[0], np.eye(3), atol=1e-3)
    third = Adjustment(hue=120).color_map[0]
    np.testing.assert_allclose(third @ third @ third, np.eye(3), atol=5e-3)
    np.testing.assert_allclose(LUMA @ third, LUMA, atol=2e-3, err_msg="hues keep their brightness")
    assert (third @ [1, 0, 0]).argmax() == 1, "red becomes green"
    grey = Adjustment(saturation=0).color_map[0] @ [0.2, 0.6, 0.4]
    np.testing.assert_allclose(grey, LUMA @ [0.2, 0.6, 0.4])


@pytest.mark.parametrize("lit", [False, True])
def test_display_values_change_in_both_materials(lit):
    data, display, _ = data_of(lit)
    adjust(data, CHANGE)
    after = objects.unlit_colors(data)
    np.testing.assert_allclose(after[:, :3], changed(display[:, :3]), atol=2e-6)
    np.testing.assert_allclose(after[:, 3], display[:, 3] / 2, atol=1e-6)
    if lit:  # what fits them to linear light stays
        shown = meshes.read_colors(data, meshes.COLOR)
        np.testing.assert_allclose(shown[:, :3], 0.8 * srgb_to_linear(after[:, :3]), atol=2e-5)
        np.testing.assert_allclose(shown[:, 3], 1 - (1 - after[:, 3]) ** 0.7, atol=1e-4)
        assert (meshes.read_colors(data, meshes.MADE) == shown).all(), "not painted by hand"


def test_colours_that_depend_on_the_view_change_alike():
    data, display, _ = data_of(False)
    rng = np.random.default_rng(0)
    harmonics = np.repeat(rng.normal(0, 0.03, (30, 3, 3)), 3, axis=0).astype(np.float32)
    meshes.store_harmonics(data, harmonics)
    adjust(data, CHANGE)
    weights = rng.normal(0, 0.4, 3)  # of some direction

    def seen(colors, terms):
        return colors[:, :3] + np.einsum("k,vkc->vc", weights, terms)

    after = seen(objects.unlit_colors(data), meshes.read_harmonics(data))
    np.testing.assert_allclose(after, changed(seen(display, harmonics)), atol=1e-5)


def test_meshes_for_linear_light_change_as_they_look():
    data, linear, _ = data_of(False, blending="linear")
    from meshsplats.scene.colors import linear_to_srgb

    adjust(data, CHANGE)
    after = objects.unlit_colors(data)[:, :3]
    np.testing.assert_allclose(linear_to_srgb(after), changed(linear_to_srgb(linear[:, :3])), atol=1e-5)
