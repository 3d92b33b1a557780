"""Image metrics: PSNR, and SSIM in three conventions. NumPy alone."""

from __future__ import annotations

from typing import Literal

import numpy as np

from meshsplats._common.arrays import check_units
from meshsplats._common.kinds import need_array, need_choice

SsimConvention = Literal["3dgs", "valid", "reflect"]

WINDOW = 11
"""Side of the SSIM window in pixels."""
SIGMA = 1.5
"""Standard deviation of the SSIM window in pixels."""
C1, C2 = 0.01**2, 0.03**2
"""The constants that keep SSIM's quotients stable, for images in [0, 1]."""


def psnr(a: np.ndarray, b: np.ndarray, *, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB, 10 log10(1 / mean squared difference); inf for equal images.

    Args:
        a, b: float images of one shape, (h, w) or (h, w, c), with 1 as the peak value. Values outside [0, 1]
            are not clipped: clip first to score an image as it will be saved.
        mask: (h, w) bool, True where pixels count; None: all pixels count.

    Raises:
        TypeError: images or masks of another type.
        ValueError: shapes that differ, values that are not finite or from 0 to 255, images or masks without
            a pixel.
    """
    a, b = checked_images(a, b)
    if mask is not None:
        mask = np.asarray(mask)
        if mask.dtype != bool:
            raise TypeError(f"mask must be boolean, got dtype {mask.dtype}")
        if mask.shape != a.shape[:2]:
            raise ValueError(f"mask must have shape {a.shape[:2]} like the images, got {mask.shape}")
        if not mask.any():
            raise ValueError("mask must mark at least one pixel, got none")
        a, b = a[mask], b[mask]
    error = float(np.mean(np.square(np.subtract(a, b, dtype=np.float64))))
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def ssim(a: np.ndarray, b: np.ndarray, *, convention: SsimConvention = "3dgs") -> float:
    """Mean structural similarity (Wang et al. 2004) over pixels and channels, in [-1, 1]; 1 for equal images.

    Local means, variances and covariance (of the population, no n - 1) are weighted by an 11 x 11 Gaussian
    window, sigma 1.5. Three conventions for the border are in use, whose values differ in the third decimal
    place:

    - ``'3dgs'``: zeros outside the image, one window per pixel; Gaussian splatting papers report this.
    - ``'valid'``: only the (h - 10) x (w - 10) windows inside the image; the value of
      ``skimage.metrics.structural_similarity`` with this window.
    - ``'reflect'``: the image mirrored at its border with the edge pixel repeated (c b a | a b c), one window
      per pixel; mode 'reflect' of ``scipy.ndimage``, 'symmetric' of ``numpy.pad``.

    Args:
        a, b: float images of one shape, (h, w) or (h, w, c), with 1 as the peak value. Values outside [0, 1]
            are not clipped.
        convention: treatment of the border.

    Raises:
        TypeError: images of another type.
        ValueError: shapes that differ, values that are not finite or from 0 to 255, an unknown convention,
            images smaller than the window with convention 'valid'.
    """
    a, b = checked_images(a, b)
    need_choice(SsimConvention, convention=convention)
    if convention == "valid" and min(a.shape[:2]) < WINDOW:
        raise ValueError(
            f"convention 'valid' needs images of at least {WINDOW} x {WINDOW} pixels, got {a.shape[0]} x"
            f" {a.shape[1]}; use '3dgs' or 'reflect'"
        )
    a, b = (_padded_channels(image, convention) for image in (a, b))
    height = a.shape[1] - WINDOW + 1
    total = 0.0
    # Strips bound the working set, so that it stays in the cache.
    for top in range(0, height, _STRIP):
        rows = slice(top, min(top + _STRIP, height) + WINDOW - 1)
        for strip_a, strip_b in zip(a[:, rows], b[:, rows], strict=True):
            total += _ssim_sum(strip_a.astype(np.float64), strip_b.astype(np.float64))
    return total / (a.shape[0] * height * (a.shape[2] - WINDOW + 1))


def checked_images(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two images of one shape as arrays; raises the errors of :func:`psnr`."""
    need_array(a=a, b=b)
    a, b = np.asarray(a), np.asarray(b)
    for image in (a, b):
        if image.dtype.kind != "f":
            raise TypeError(
                f"images must hold floats in [0, 1], got dtype {image.dtype}; divide bytes by 255"
            )
    if a.shape != b.shape:
        raise ValueError(f"images must have the same shape, got {a.shape} and {b.shape}")
    if a.ndim not in (2, 3) or a.size == 0:
        raise ValueError(f"images must have shape (h, w) or (h, w, c) and a pixel, got {a.shape}")
    for image in (a, b):
        if not np.isfinite(image).all():
            raise ValueError("images must be finite, got NaN or infinite values")
        check_units("images", image)
    return a, b


_STRIP = 32  # rows of windows computed together


def _half_window() -> np.ndarray:
    """Weights of the window along one axis, from its centre outwards."""
    weights = np.exp(-0.5 * (np.arange(WINDOW // 2 + 1) / SIGMA) ** 2)
    return weights / (weights[0] + 2 * weights[1:].sum())


_HALF_WINDOW = _half_window()


def _padded_channels(image: np.ndarray, convention: SsimConvention) -> np.ndarray:
    """(c, h, w): the channels, padded for ``convention``."""
    channels = image.reshape(*image.shape[:2], -1).transpose(2, 0, 1)
    margin = WINDOW // 2
    sides = ((0, 0), (margin, margin), (margin, margin))
    if convention == "3dgs":
        return np.pad(channels, sides)
    if convention == "reflect":
        return np.pad(channels, sides, mode="symmetric")
    return np.ascontiguousarray(channels)


def _filtered(x: np.ndarray) -> np.ndarray:
    """Weighted means over all windows inside ``x`` (h, w). The window is separable."""
    middle = WINDOW // 2
    for _ in range(2):
        count = len(x) - WINDOW + 1
        result = _HALF_WINDOW[0] * x[middle : middle + count]
        pair = np.empty_like(result)
        for k in range(1, middle + 1):
            np.add(x[middle - k : middle - k + count], x[middle + k : middle + k + count], out=pair)
            pair *= _HALF_WINDOW[k]
            result += pair
        x = result.T
    return x


def _ssim_sum(a: np.ndarray, b: np.ndarray) -> float:
    """Sum of SSIM over all windows inside ``a`` and ``b`` (h, w)."""
    mean_a, mean_b = _filtered(a), _filtered(b)
    # SSIM needs only the sum of the two variances.
    squares = mean_a**2 + mean_b**2
    product = mean_a * mean_b
    variances = _filtered(a**2 + b**2) - squares
    covariance = _filtered(a * b) - product
    similarity = (2 * product + C1) * (2 * covariance + C2) / ((squares + C1) * (variances + C2))
    return float(similarity.sum())
