"""The losses of fine-tuning against a float64 twin, against the metrics, and by their laws."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshsplats.evaluation import metrics

torch = pytest.importorskip("torch", reason="the losses need torch: pip install 'meshsplats[torch]'")

from meshsplats._core.kernels import compare_images  # noqa: E402
from meshsplats.finetuning import losses  # noqa: E402
from meshsplats.finetuning.losses import l1, photometric_loss, ssim  # noqa: E402


def pair(seed: int, *shape: int, white: bool = True) -> tuple[torch.Tensor, torch.Tensor]:
    """An image and a noisy version, with equal pixels and a white part whose variance is small."""
    rng = np.random.default_rng(seed)
    target = rng.random(shape)
    rows = shape[-3]
    if white:
        target[..., rows // 2 :, :, :] = 1 - 0.01 * target[..., rows // 2 :, :, :]
    image = np.clip(target + rng.normal(0, 0.1, shape), 0, 1)
    image[..., : rows // 4, :, :] = target[..., : rows // 4, :, :]
    return torch.tensor(image, dtype=torch.float32), torch.tensor(target, dtype=torch.float32)


def twin_sums(image, target, mask=None):
    """Sums of |x - y| and of SSIM by their definitions, in the precision of the arguments; (b, h, w, c)."""
    x, y = image.permute(0, 3, 1, 2), target.permute(0, 3, 1, 2)
    inside = torch.ones_like(x[:, :1]) if mask is None else mask[:, None].to(x.dtype)
    x, y = x * inside, y * inside
    line = torch.exp(-0.5 * (torch.arange(-5, 6, dtype=x.dtype) / 1.5) ** 2)
    window = torch.outer(line, line) / line.sum() ** 2
    channels = x.shape[1]

    def mean(z):
        return torch.nn.functional.conv2d(z, window.expand(channels, 1, 11, 11), padding=5, groups=channels)

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    values = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))
    return (x - y).abs().sum(), (values * inside).sum()


def twin(name, image, target, mask=None):
    absolute, similarity = twin_sums(image, target, mask)
    pixels = image[..., 0].numel() if mask is None else int(mask.sum())
    count = pixels * image.shape[-1]
    if name == "l1":
        return absolute / count
    if name == "ssim":
        return similarity / count
    return 0.6 * absolute / count + 0.4 * (1 - similarity / count)


LOSSES = {"l1": l1, "ssim": ssim, "photometric": photometric_loss}
# Parts of a vector, of a tile, several tiles across and down, other numbers of channels, one pixel.
SHAPES = [(1, 1, 1, 3), (1, 7, 5, 3), (2, 40, 33, 3), (1, 150, 20, 1), (1, 20, 300, 3), (1, 12, 140, 4)]


def relative(a, b) -> float:
    a, b = (np.asarray(v, np.float64) for v in (a, b))
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


# Near white, the variance of float32 images is known to few digits.
@pytest.mark.slow(keep=20)
@pytest.mark.parametrize(("white", "tolerance"), [(False, 1e-6), (True, 1e-5)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", LOSSES)
def test_value_and_gradients_are_those_of_the_twin(name, shape, masked, white, tolerance):
    image, target = pair(len(shape) + shape[1], *shape, white=white)
    if shape[1:3] == (1, 1):
        image = image * 0.5
    mask = torch.rand(shape[:3], generator=torch.Generator().manual_seed(0)) < 0.7
    mask[:, 0, 0] = True
    mask = mask if masked else None
    x, y = image.clone().requires_grad_(), target.clone().requires_grad_()
    value = LOSSES[name](x, y, mask=mask)
    cotangent = torch.tensor(-1.7)
    value.backward(cotangent)
    x64, y64 = image.double().requires_grad_(), target.double().requires_grad_()
    expected = twin(name, x64, y64, mask)
    expected.backward(cotangent.double())
    assert value.dtype == torch.float32
    assert value.shape == ()
    if shape[1:3] == (1, 1):
        # Windows of zeros around one pixel; there is no mean over many windows.
        tolerance *= 5
    assert value.item() == pytest.approx(expected.item(), abs=2e-7 if shape[1:3] != (1, 1) else 1e-6)
    assert relative(x.grad, x64.grad) < tolerance
    assert relative(y.grad, y64.grad) < tolerance


def test_the_twin_has_the_gradient_of_its_value():
    image, target = (t.double() for t in pair(3, 1, 6, 7, 2))
    mask = torch.rand(1, 6, 7, generator=torch.Generator().manual_seed(1)) < 0.8
    image += 0.01  # away from equal values, where |x - y| has no derivative
    for name in LOSSES:
        assert torch.autograd.gradcheck(
            lambda x, y, name=name: twin(name, x, y, mask),
            (image.clone().requires_grad_(), target.clone().requires_grad_()),
            fast_mode=True,
        )


def test_finite_differences_of_the_kernel():
    # Large enough steps for float32, small enough for a curve: one part in a hundred.
    image, target = pair(4, 30, 30, 3)
    x = image.clone().requires_grad_()
    ssim(x, target).backward()
    direction = torch.randn(image.shape, generator=torch.Generator().manual_seed(2))
    ends = [ssim(image + step * direction, target).item() for step in (1e-3, -1e-3)]
    assert (ends[0] - ends[1]) / 2e-3 == pytest.approx((x.grad * direction).sum().item(), rel=1e-2)


@pytest.mark.parametrize("shape", [(40, 50, 3), (200, 300, 3), (5, 9, 1)])
def test_ssim_is_the_metric(shape):
    image, target = pair(5, *shape)
    expected = metrics.ssim(image.numpy(), target.numpy(), convention="3dgs")
    assert ssim(image, target).item() == pytest.approx(expected, abs=2e-7)
    nearly = target + (image - target) * 1e-3
    expected = metrics.ssim(nearly.numpy(), target.numpy(), convention="3dgs")
    # Better than the last digit of 1: errors are relative to 1 - SSIM.
    assert 1 - ssim(nearly, target).item() == pytest.approx(1 - expected, abs=6e-8)


def test_l1_and_the_loss_by_hand():
    image, target = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3)
    image[0, 1, 2], image[1, 0, 0] = 0.5, -0.25
    image.requires_grad_()
    value = l1(image, target)
    assert value.item() == pytest.approx(0.75 / 12, abs=1e-9)
    value.backward()
    expected = torch.zeros(2, 2, 3)
    expected[0, 1, 2], expected[1, 0, 0] = 1 / 12, -1 / 12
    assert torch.equal(image.grad, expected)
    for weight in (0, 0.2, 1):
        mixed = photometric_loss(image, target, ssim_weight=weight).item()
        parts = (1 - weight) * value.item() + weight * (1 - ssim(image, target).item())
        assert mixed == pytest.approx(parts, abs=1e-7)
    assert photometric_loss(image, target).item() == pytest.approx(
        0.6 * value.item() + 0.4 * (1 - ssim(image, target).item()), abs=1e-7
    )


@settings(max_examples=15)
@given(seed=st.integers(0, 1000), height=st.integers(1, 30), width=st.integers(1, 30))
def test_laws(seed, height, width):
    image, target = pair(seed, height, width, 3)
    assert ssim(target, target).item() == 1
    assert photometric_loss(target, target).item() == 0
    assert ssim(image, target).item() == ssim(target, image).item()
    for turned in (
        lambda t: t.flip(0),
        lambda t: t.flip(1),
        lambda t: t.transpose(0, 1),
        lambda t: t.flip(2),
    ):
        assert ssim(turned(image), turned(target)).item() == pytest.approx(
            ssim(image, target).item(), abs=3e-7
        )
    equal = target.clone().requires_grad_()
    photometric_loss(equal, target).backward()
    assert torch.equal(equal.grad, torch.zeros_like(target))


@settings(max_examples=15)
@given(
    seed=st.integers(0, 1000),
    top=st.integers(0, 20),
    left=st.integers(0, 20),
    height=st.integers(1, 20),
    width=st.integers(1, 20),
)
def test_a_rectangular_mask_crops(seed, top, left, height, width):
    image, target = pair(seed, 40, 40, 3)
    window = (slice(top, top + height), slice(left, left + width))
    mask = torch.zeros(40, 40, dtype=torch.bool)
    mask[window] = True
    x, cropped = image.clone().requires_grad_(), image[window].clone().requires_grad_()
    value, expected = photometric_loss(x, target, mask=mask), photometric_loss(cropped, target[window])
    assert value.item() == pytest.approx(expected.item(), abs=1e-7)
    value.backward()
    expected.backward()
    assert torch.allclose(x.grad[window], cropped.grad, rtol=1e-5, atol=1e-9)
    assert not x.grad[~mask].any()


def test_values_under_the_mask_do_not_matter():
    image, target = pair(6, 2, 30, 40, 3)
    mask = torch.rand(2, 30, 40, generator=torch.Generator().manual_seed(3)) < 0.6
    results = []
    for filler in (0.3, float("nan"), float("inf")):
        x, y = image.clone(), target.clone()
        x[~mask], y[~mask] = filler, -filler
        x.requires_grad_(), y.requires_grad_()
        value = photometric_loss(x, y, mask=mask)
        value.backward()
        results.append((value.item(), x.grad, y.grad))
        assert np.isfinite(value.item())
        assert not x.grad[~mask].any()
    for value, gx, gy in results[1:]:
        assert value == results[0][0]
        assert torch.equal(gx, results[0][1])
        assert torch.equal(gy, results[0][2])


def test_a_batch_is_the_mean_of_its_images():
    image, target = pair(7, 3, 25, 31, 3)
    x = image.clone().requires_grad_()
    value = photometric_loss(x, target)
    value.backward()
    singles = [p.clone().requires_grad_() for p in image]
    values = [photometric_loss(p, t) for p, t in zip(singles, target, strict=True)]
    (sum(values) / 3).backward()
    assert value.item() == pytest.approx(sum(v.item() for v in values) / 3, abs=1e-7)
    assert torch.allclose(x.grad, torch.stack([p.grad for p in singles]), rtol=1e-5, atol=1e-9)
    # With masks, each pixel that counts weighs the same.
    mask = torch.zeros(3, 25, 31, dtype=torch.bool)
    mask[0, :5], mask[1, :20] = True, True
    parts = [l1(image[i], target[i], mask=mask[i]).item() for i in range(2)]
    assert l1(image, target, mask=mask).item() == pytest.approx((parts[0] + 4 * parts[1]) / 5, abs=1e-7)


def digest(threads: int | None) -> str:
    total = hashlib.sha256()
    for shape in ((2, 120, 110, 3), (1, 17, 19, 1)):
        image, target = pair(8, *shape)
        mask = torch.rand(shape[:3], generator=torch.Generator().manual_seed(4)) < 0.9
        for given_mask in (None, mask):
            x = image.clone().requires_grad_()
            value = photometric_loss(x, target, mask=given_mask, threads=threads)
            value.backward()
            total.update(value.detach().numpy().tobytes() + x.grad.numpy().tobytes())
    return total.hexdigest()


@pytest.mark.slow
def test_threads_and_variants_do_not_change_a_bit():
    from test_rendering_variants import in_another_process

    from meshsplats._core import library

    expected = digest(None)
    for threads in (1, 2, 7, 100):
        assert digest(threads) == expected
    code = "import test_losses; print(test_losses.digest(2))"
    for variant in library.available_variants()[1:]:
        assert in_another_process(code, MESHSPLATS_VARIANT=variant) == expected


def test_gradients_as_torch_needs_them():
    image, target = pair(9, 20, 20, 3)
    with torch.no_grad():
        assert not ssim(image.clone().requires_grad_(), target).requires_grad
    assert not ssim(image, target).requires_grad
    # Twice through one graph: gradients add up and what is kept is not changed.
    x = image.clone().requires_grad_()
    value = ssim(x, target)
    value.backward(retain_graph=True)
    once = x.grad.clone()
    x.grad *= 3
    value.backward()
    assert torch.allclose(x.grad, 4 * once)
    # An image that is a view with other strides, and part of a longer computation.
    wide = image.permute(2, 0, 1).contiguous().requires_grad_()
    (2 * ssim(wide.permute(1, 2, 0), target)).backward()
    assert torch.allclose(wide.grad.permute(1, 2, 0), 2 * once)
    x = image.clone().requires_grad_()
    with pytest.raises(RuntimeError, match="no second derivative"):
        torch.autograd.grad(ssim(x, target), x, create_graph=True)


def test_gradients_are_made_only_where_they_are_wanted(monkeypatch):
    made = []

    def spy(*arrays, gradient, **options):
        made.append(gradient)
        return compare_images(*arrays, gradient=gradient, **options)

    monkeypatch.setattr(losses, "compare_images", spy)
    image, target = pair(9, 20, 20, 3)
    x = image.clone().requires_grad_()
    with torch.no_grad():
        ssim(x, target)
    ssim(image, target)
    assert made == [False, False]
    ssim(x, target)
    assert made == [False, False, True]


def test_not_a_number_is_not_hidden():
    image, target = pair(10, 20, 20, 3)
    image[3, 4, 1] = float("nan")
    for loss in LOSSES.values():
        assert np.isnan(loss(image, target).item())


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES.keys())
def test_bad_arguments_are_refused(loss):
    good = torch.zeros(12, 12, 3)
    with pytest.raises(TypeError, match=r"image must be a torch tensor, got ndarray; use torch\.from_numpy"):
        loss(good.numpy(), good)
    with pytest.raises(TypeError, match=r"target must be float32 .* got torch\.float64"):
        loss(good, good.double())
    with pytest.raises(ValueError, match=r"same shape, got \(12, 12, 3\) and \(12, 12, 1\)"):
        loss(good, good[..., :1])
    for bad in (good[0], good[None, None], good[:0]):
        with pytest.raises(ValueError, match=r"\(h, w, c\) or \(b, h, w, c\) and a pixel, got"):
            loss(bad, bad)
    with pytest.raises(ValueError, match="channels last with at most 64"):
        loss(torch.zeros(3, 90, 70), torch.zeros(3, 90, 70))
    with pytest.raises(TypeError, match=r"boolean torch tensor, got torch\.float32"):
        loss(good, good, mask=torch.ones(12, 12))
    with pytest.raises(TypeError, match="boolean torch tensor, got ndarray"):
        loss(good, good, mask=np.ones((12, 12), bool))
    with pytest.raises(ValueError, match=r"mask must have shape \(12, 12\), got \(12, 11\)"):
        loss(good, good, mask=torch.ones(12, 11, dtype=torch.bool))
    with pytest.raises(ValueError, match="at least one pixel, got none of 144"):
        loss(good, good, mask=torch.zeros(12, 12, dtype=torch.bool))
    with pytest.raises(ValueError, match="threads must be at least 1"):
        loss(good, good, threads=0)
    with pytest.raises(ValueError, match="must be on the CPU, got meta"):
        loss(good.to("meta"), good.to("meta"))


def test_the_weight_is_checked():
    good = torch.zeros(12, 12, 3)
    for weight in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match=r"ssim_weight must lie in \[0, 1\]"):
            photometric_loss(good, good, ssim_weight=weight)
