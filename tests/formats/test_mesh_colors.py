"""Display and linear colours."""

import numpy as np

from meshsplats import SplatMesh, load_mesh, save_mesh
from meshsplats.formats.gltf.writer import linear_colors
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear


def test_values_of_the_standard():
    # 8-bit display values and their linear light, from the formulas of IEC 61966-2-1 in double precision.
    display = np.array([0, 1, 10, 11, 128, 254, 255]) / 255
    linear = [0, 3.0352698e-4, 3.0352698e-3, 3.3465358e-3, 0.21586050, 0.99110210, 1]
    np.testing.assert_allclose(srgb_to_linear(display), linear, rtol=2e-6)
    np.testing.assert_allclose(linear_to_srgb(linear), display, rtol=2e-6)


def test_ends_are_exact():
    for function in (srgb_to_linear, linear_to_srgb):
        assert function(np.array([0.0, 1.0])).tolist() == [0, 1]


def test_against_double_precision_over_the_range():
    v = np.linspace(0, 1, 200_001)
    decoded = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    encoded = np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(srgb_to_linear(v), decoded, atol=5e-7)
    np.testing.assert_allclose(linear_to_srgb(v), encoded, atol=5e-7)


def test_shape_and_type_are_kept_and_values_outside_follow_the_formulas():
    v = np.array([[[-0.1], [1.5]]])
    assert srgb_to_linear(v).shape == v.shape
    assert srgb_to_linear(v).dtype == np.float32
    np.testing.assert_allclose(srgb_to_linear(v).ravel(), [-0.1 / 12.92, (1.555 / 1.055) ** 2.4], rtol=1e-6)
    assert srgb_to_linear(np.empty((0, 3))).shape == (0, 3)


def test_16_bit_linear_keeps_display_values_over_the_whole_range(tmp_path):
    """Every display value in steps of 1/10000, dark ones too, within 1/10000: well inside 1/2000."""
    n = 10_002
    values = np.linspace(0, 1, n, dtype=np.float32)
    colors = np.stack([values, values[::-1], values, values], axis=1)
    mesh = SplatMesh(np.zeros((n, 3)), np.arange(n).reshape(-1, 3), colors)
    save_mesh(mesh, tmp_path / "m.glb")
    assert np.abs(load_mesh(tmp_path / "m.glb").colors - colors).max() < 1 / 10_000


def test_colors_made_for_linear_blending_are_stored_as_they_are():
    colors = np.array([[0.2, 0.5, 1.0, 0.5]])
    for blending, rgb in (("linear", [0.2, 0.5, 1]), ("display", [0.0331048, 0.2140411, 1])):
        mesh = SplatMesh(np.zeros((1, 3)), np.empty((0, 3), int), colors, blending=blending)
        np.testing.assert_allclose(linear_colors(mesh, "float32"), [[*rgb, 0.5]], rtol=1e-5)
        np.testing.assert_array_equal(
            linear_colors(mesh, "uint16"), [[round(c * 65535) for c in rgb] + [32768]]
        )
