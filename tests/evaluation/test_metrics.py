"""PSNR and SSIM against their definitions, hand-worked values and other libraries."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshsplats.evaluation.metrics import psnr, ssim

CONVENTIONS = ["3dgs", "valid", "reflect"]


def pair(seed: int, *shape: int) -> tuple[np.ndarray, np.ndarray]:
    """Two smooth images that are alike, with some noise."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.linspace(0, 3, shape[0]), np.linspace(0, 3, shape[1]), indexing="ij")
    base = 0.5 + 0.3 * np.sin(3 * x + y) * np.cos(2 * y)
    base = base.reshape(*shape[:2], *[1] * (len(shape) - 2)) * rng.uniform(0.5, 1, shape[2:])
    noisy = [np.clip(base + rng.normal(0, 0.08, shape), 0, 1) for _ in range(2)]
    return noisy[0], noisy[1]


def window() -> np.ndarray:
    """The 11 x 11 Gaussian written as a function of two variables."""
    weights = np.array(
        [[math.exp(-(i * i + j * j) / (2 * 1.5**2)) for i in range(-5, 6)] for j in range(-5, 6)]
    )
    return weights / weights.sum()


def ssim_by_definition(a: np.ndarray, b: np.ndarray, convention: str) -> float:
    """The formula of Wang et al. 2004, window by window."""
    if convention == "3dgs":
        a, b = (np.pad(p, ((5, 5), (5, 5), (0, 0))) for p in (a, b))
    elif convention == "reflect":
        a, b = (p[mirrored(len(p))][:, mirrored(p.shape[1])] for p in (a, b))
    weights = window()
    values = []
    for row in range(a.shape[0] - 10):
        for col in range(a.shape[1] - 10):
            for channel in range(a.shape[2]):
                x = a[row : row + 11, col : col + 11, channel]
                y = b[row : row + 11, col : col + 11, channel]
                mx, my = (weights * x).sum(), (weights * y).sum()
                vx, vy = (weights * (x - mx) ** 2).sum(), (weights * (y - my) ** 2).sum()
                cov = (weights * (x - mx) * (y - my)).sum()
                luminance = (2 * mx * my + 0.0001) / (mx * mx + my * my + 0.0001)
                values.append(luminance * (2 * cov + 0.0009) / (vx + vy + 0.0009))
    return float(np.mean(values))


def mirrored(n: int) -> list[int]:
    """Positions -5 to n + 4 in an image whose edge pixel is repeated: 2 1 0 | 0 1 2."""
    return [-1 - i if i < 0 else 2 * n - 1 - i if i >= n else i for i in range(-5, n + 5)]


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("shape", [(11, 11, 1), (13, 17, 2), (45, 12, 1), (12, 45, 1)])
def test_ssim_is_its_definition(convention, shape):
    a, b = pair(1, *shape)
    assert ssim(a, b, convention=convention) == pytest.approx(ssim_by_definition(a, b, convention), abs=1e-12)


def test_the_conventions_differ():
    a, b = pair(2, 40, 40, 3)
    values = [ssim(a, b, convention=c) for c in CONVENTIONS]
    assert min(abs(values[i] - values[j]) for i, j in ((0, 1), (1, 2), (0, 2))) > 1e-4


def test_ssim_against_scipy():
    ndimage = pytest.importorskip("scipy.ndimage")
    a, b = pair(3, 90, 71)

    def mean(x):
        return ndimage.gaussian_filter(x, 1.5, truncate=3.5, mode="reflect")

    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    expected = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    assert ssim(a, b, convention="reflect") == pytest.approx(expected.mean(), abs=1e-12)


def test_ssim_against_scikit_image():
    metrics = pytest.importorskip("skimage.metrics")
    a, b = pair(4, 50, 61, 3)
    expected = metrics.structural_similarity(
        a, b, data_range=1, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert ssim(a, b, convention="valid") == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("convention", ["valid", "reflect"])
def test_ssim_of_plain_images_by_hand(convention):
    # No variance: only the comparison of the means is left.
    a, b = np.full((12, 14, 3), 0.2), np.full((12, 14, 3), 0.6)
    expected = (2 * 0.2 * 0.6 + 0.0001) / (0.2**2 + 0.6**2 + 0.0001)
    assert ssim(a, b, convention=convention) == pytest.approx(expected, abs=1e-12)


def test_zero_padding_by_hand():
    # One pixel: under every convention the window's middle weight falls on it, outside are zeros.
    a, b = np.full((1, 1), 0.5), np.full((1, 1), 1.0)
    w = window()[5, 5]
    va, vb, cov = 0.25 * (w - w * w), w - w * w, 0.5 * (w - w * w)
    luminance = (2 * 0.5 * w * w + 1e-4) / (0.25 * w * w + w * w + 1e-4)
    expected = luminance * (2 * cov + 9e-4) / (va + vb + 9e-4)
    assert ssim(a, b, convention="3dgs") == pytest.approx(expected, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("convention", CONVENTIONS)
@given(seed=st.integers(0, 1000), height=st.integers(11, 40), width=st.integers(11, 40))
def test_ssim_laws(convention, seed, height, width):
    a, b = pair(seed, height, width, 3)
    value = ssim(a, b, convention=convention)
    assert ssim(a, a, convention=convention) == 1
    assert value == ssim(b, a, convention=convention)
    assert -1 <= value < 1
    assert ssim(a[::-1], b[::-1], convention=convention) == pytest.approx(value, abs=1e-12)
    turned = ssim(a.transpose(1, 0, 2), b.transpose(1, 0, 2), convention=convention)
    assert turned == pytest.approx(value, abs=1e-12)
    by_channel = [ssim(a[..., c], b[..., c], convention=convention) for c in range(3)]
    assert np.mean(by_channel) == pytest.approx(value, abs=1e-12)


def test_ssim_of_float32_images_is_accurate():
    a, b = (p.astype(np.float32) for p in pair(5, 64, 64, 3))
    a[:32] = b[:32] = 1  # a white part, where variances cancel
    b[10, 10] = 0.99
    assert ssim(a, b) == ssim(a.astype(np.float64), b.astype(np.float64))


def test_ssim_takes_small_images_except_valid():
    a, b = pair(6, 5, 7, 3)
    for convention in ("3dgs", "reflect"):
        assert ssim(a, b, convention=convention) < 1
    for shape in ((10, 30), (30, 10)):
        with pytest.raises(ValueError, match=r"11 x 11 pixels, got .*'3dgs' or 'reflect'"):
            ssim(np.zeros(shape), np.zeros(shape), convention="valid")


def test_psnr_by_hand():
    a = np.zeros((2, 3, 3), np.float32)
    assert psnr(a, a) == math.inf
    assert psnr(a, a + np.float32(0.1)) == pytest.approx(20, abs=1e-5)
    b = a.copy()
    b[0, 0, 1] = 0.5  # one of 18 values: mean square 0.25 / 18
    assert psnr(a, b) == pytest.approx(10 * math.log10(18 / 0.25), abs=1e-12)
    mask = np.array([[True, True, False], [False, False, False]])
    assert psnr(a, b, mask=mask) == pytest.approx(10 * math.log10(6 / 0.25), abs=1e-12)
    assert psnr(a, b, mask=~mask) == math.inf
    assert psnr(a[..., 1], b[..., 1]) == pytest.approx(10 * math.log10(6 / 0.25), abs=1e-12)
    assert psnr(a, a + 2) == pytest.approx(-10 * math.log10(4), abs=1e-12)  # not clipped


def test_psnr_adds_up_in_double_precision():
    a = np.zeros((2000, 2000), np.float32)
    assert psnr(a, a + np.float32(1e-4)) == pytest.approx(80, abs=1e-6)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_bad_images_are_refused(metric):
    good = np.zeros((12, 12, 3))
    with pytest.raises(TypeError, match="divide bytes by 255"):
        metric(good, np.zeros((12, 12, 3), np.uint8))
    with pytest.raises(
        ValueError, match="images must hold values from 0 to 1, got up to 128: divide bytes by"
    ):
        metric(good, good + 128)
    with pytest.raises(ValueError, match=r"same shape, got \(12, 12, 3\) and \(12, 12\)"):
        metric(good, good[..., 0])
    with pytest.raises(ValueError, match=r"\(h, w\) or \(h, w, c\)"):
        metric(good[0, 0], good[0, 0])
    with pytest.raises(ValueError, match="and a pixel"):
        metric(good[:0], good[:0])
    bad = good.copy()
    bad[3, 4, 1] = np.nan
    for a, b in ((good, bad), (bad, good)):
        with pytest.raises(ValueError, match="finite"):
            metric(a, b)


def test_bad_options_are_refused():
    a = np.zeros((12, 12, 3))
    with pytest.raises(ValueError, match="convention must be one of 3dgs, valid, reflect, got 'same'"):
        ssim(a, a, convention="same")
    with pytest.raises(TypeError, match="mask must be boolean"):
        psnr(a, a, mask=np.ones((12, 12)))
    with pytest.raises(ValueError, match=r"mask must have shape \(12, 12\)"):
        psnr(a, a, mask=np.ones((12, 11), bool))
    with pytest.raises(ValueError, match="at least one pixel"):
        psnr(a, a, mask=np.zeros((12, 12), bool))
