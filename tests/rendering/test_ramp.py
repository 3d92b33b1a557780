"""The ramp in place of a hard cut, and the expected error of images of random fragments."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from _rendering import FLIPS, camera, fan, layers, soup

from meshsplats import SplatMesh
from meshsplats.rendering import render
from meshsplats.rendering.backward import ExpectedError, OpacityRamp, TapedRendering, TapeOptions

VIEW = camera(48, 40)


def drawn(
    mesh: SplatMesh, ramp: OpacityRamp | None, samples: int = 1, background=(1, 1, 1), **options
) -> TapedRendering:
    exact = TapeOptions(background, samples, 0.0, ramp=ramp)
    return TapedRendering(mesh.triangles, VIEW, exact, **options)


def gradients(rendering: TapedRendering, grad_color, expected=None):
    count = rendering.vertex_count
    vertices, colors = np.zeros((count, 3), np.float32), np.zeros((count, 4), np.float32)
    rendering.backward(grad_color, None, None, vertices=vertices, colors=colors, expected=expected)
    return vertices, colors


def test_a_ramp_of_slope_one_changes_nothing():
    mesh = soup(0)
    same = drawn(mesh, OpacityRamp(0.3, height=0.3, slope=1, width=0))
    np.testing.assert_allclose(same.color, drawn(mesh, None).color, atol=1e-6)


def test_a_steep_ramp_is_the_hard_cut():
    mesh = soup(1)
    steep = drawn(mesh, OpacityRamp(0.3, slope=1e9, width=0), samples=2)
    wrong = np.abs(steep.color - render(mesh, VIEW, cutoff=0.3, samples=2).color).max(axis=2) > 1e-4
    assert wrong.mean() <= 5 * FLIPS


def test_a_ramp_of_a_pixel_is_the_covered_share():
    # The level set is a straight line across the image: what 16 x 16 samples of a hard cut average to.
    corners = np.array([(-3.0, -4.0, 2.0), (3.0, -4.0, 2.0), (0.0, 9.0, 2.0)])
    mesh = SplatMesh(corners, [(0, 1, 2)], [(1, 0, 0, 0.0), (1, 0, 0, 1.0), (1, 0, 0, 0.5)])
    soft = drawn(mesh, OpacityRamp(0.4)).alpha
    exact = render(mesh, VIEW, cutoff=0.4, samples=16).alpha
    edge = (exact > 0) & (exact < 1)
    assert edge.sum() > 20
    assert np.abs(soft - exact).max() < 0.15
    assert np.abs(soft - exact)[edge].mean() < 0.05


@pytest.mark.slow(keep=9)
@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("leak", [0.0, 0.05])
@pytest.mark.parametrize("shape", [(0.2, 0.3, 4.0, 1.0), (0.4, 0.5, 1e6, 3.0), (0.3, 0.4, 2.0, 0.0)])
@pytest.mark.parametrize("mesh", [soup(2), fan(5, 8, 0.6), soup(7, z=0.6)], ids=["soup", "fan", "near"])
def test_gradients_are_those_of_float64(mesh, shape, leak, samples):
    torch = pytest.importorskip("torch")
    from meshsplats.rendering import reference_autograd

    rng = np.random.default_rng(0)
    if len(np.unique(mesh.colors[:, 3])) == 1:
        colors = mesh.colors.copy()
        colors[:, 3] = rng.random(len(colors))
        mesh = SplatMesh(mesh.vertices, mesh.faces, colors)
    ramp = OpacityRamp(*shape[:1], height=shape[1], slope=shape[2], width=shape[3], leak=leak)
    grad = rng.normal(size=(40, 48, 3)).astype(np.float32)
    target = rng.random((40, 48, 3)).astype(np.float32)
    weight = (rng.random((40, 48)) * (rng.random((40, 48)) > 0.3)).astype(np.float32)
    found = gradients(
        drawn(mesh, ramp, samples=samples, background=(0.2, 0.5, 0.9)), grad, ExpectedError(target, weight)
    )
    vertices, colors = (
        torch.from_numpy(part).double().requires_grad_() for part in (mesh.vertices, mesh.colors)
    )
    options = {"background": (0.2, 0.5, 0.9), "samples": samples, "ramp": ramp}
    image = reference_autograd.rasterize(vertices, mesh.faces, colors, VIEW, **options)
    errors = reference_autograd.expected_error(
        vertices, mesh.faces, colors, VIEW, torch.from_numpy(target).double(), **options
    )
    loss = (image.color * torch.from_numpy(grad)).sum() + (errors * torch.from_numpy(weight)).sum()
    loss.backward()
    for one, two in zip(found, (vertices.grad, colors.grad), strict=True):
        assert np.linalg.norm(one - two.numpy()) <= 2e-4 * np.linalg.norm(two.numpy())


def test_the_expected_error_is_that_of_all_images_of_random_fragments():
    torch = pytest.importorskip("torch")
    from meshsplats.rendering import reference_autograd

    alphas, target = [0.3, 0.6, 0.2, 0.9], np.array([0.1, 0.7, 0.4])
    mesh = layers([2, 3, 4, 5], alphas)
    view = camera(2, 1)
    expected = 0.0
    for there in product((0, 1), repeat=4):
        chance = np.prod([a if t else 1 - a for a, t in zip(alphas, there, strict=True)])
        image = render(layers([2, 3, 4, 5], there), view)
        expected += chance * ((image.color[0, 0] - target) ** 2).sum()
    found = reference_autograd.expected_error(
        torch.from_numpy(mesh.vertices),
        mesh.faces,
        torch.from_numpy(mesh.colors),
        view,
        torch.from_numpy(target).expand(1, 2, 3),
    )
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5)


def test_no_number_of_threads_changes_a_bit():
    mesh = soup(3, 200)
    rng = np.random.default_rng(1)
    grad, target = (rng.random((40, 48, 3)).astype(np.float32) for _ in range(2))
    expected = ExpectedError(target, np.full((40, 48), 0.5, np.float32))
    ramp = OpacityRamp(0.3, leak=0.05)
    results = [gradients(drawn(mesh, ramp, threads=n), grad, expected) for n in (1, 3)]
    # Without a tape, tiles are rendered again.
    results.append(gradients(drawn(mesh, ramp, tape_bytes=0), grad, expected))
    for other in results[1:]:
        assert all(one.tobytes() == two.tobytes() for one, two in zip(results[0], other, strict=True))


def test_a_ramp_is_checked():
    with pytest.raises(ValueError, match="cutoff must be an opacity"):
        OpacityRamp(1.5)
    with pytest.raises(ValueError, match="not a ramp"):
        OpacityRamp(0.5, slope=0)
