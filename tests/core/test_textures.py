"""Textured samples of the core: bilinear colours, their gradients, and the sums of texels."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats._core.surfaces import (
    Samples,
    coordinate_gradients,
    relax_texels,
    texel_sums,
    texture_samples,
)

EMPTY = np.array([0.25, 0.5, 0.75], np.float32)


def some(seed: int = 0) -> tuple[Samples, np.ndarray, np.ndarray]:
    """Samples of a texture of 7 x 5 texels, 2 x 2 to a pixel, and values of 3 x 4 pixels."""
    rng = np.random.default_rng(seed)
    uv = rng.random((6, 8, 2), np.float32)
    texels = rng.random((5, 7, 3), np.float32)
    return Samples(uv, rng.random((6, 8)) > 0.3, 2), texels, rng.random((3, 4, 4), np.float32)


def exact(samples: Samples, texels: np.ndarray, uv: np.ndarray | None = None) -> np.ndarray:
    """The colours in float64, by the definition."""
    height, width = texels.shape[:2]
    at = (samples.uv if uv is None else uv).astype(np.float64) % 1 * [width, height] - 0.5
    low = np.floor(at).astype(int)
    share = at - low
    total = np.zeros((*at.shape[:2], 3))
    for j in (0, 1):
        for i in (0, 1):
            weight = (share[..., 0] if i else 1 - share[..., 0]) * (share[..., 1] if j else 1 - share[..., 1])
            total += weight[..., None] * texels[(low[..., 1] + j) % height, (low[..., 0] + i) % width]
    return np.where(samples.covered[..., None], total, EMPTY)


def spread(values: np.ndarray) -> np.ndarray:
    return values.repeat(2, axis=0).repeat(2, axis=1)


def test_colours_are_bilinear_between_the_centres_of_texels():
    samples, texels, _ = some()
    np.testing.assert_allclose(texture_samples(samples, texels, EMPTY), exact(samples, texels), atol=1e-6)
    centers = np.stack(np.meshgrid((np.arange(7) + 0.5) / 7, (np.arange(5) + 0.5) / 5), -1).astype(np.float32)
    whole = Samples(centers, np.ones((5, 7), bool), 1)
    np.testing.assert_allclose(texture_samples(whole, texels, EMPTY), texels, atol=2e-6)


def test_sums_of_texels_are_the_gradient_of_the_colours():
    samples, texels, values = some(1)
    sums = texel_sums(samples, texels, values)

    def loss(texels: np.ndarray) -> float:
        return float((exact(samples, texels) * spread(values)[..., :3])[samples.covered].sum())

    for place in np.ndindex(texels.shape):
        moved = texels.astype(np.float64)
        moved[place] += 1  # linear in the texels
        assert sums[place] == pytest.approx(loss(moved) - loss(texels), abs=1e-5)
    assert sums[..., 3].sum() == pytest.approx(spread(values)[..., 3][samples.covered].sum(), rel=1e-5)


def test_gradients_of_coordinates_are_those_of_the_colours():
    samples, texels, values = some(2)
    gradient = coordinate_gradients(samples, texels, values)
    weights = spread(values)[..., :3]
    for axis in (0, 1):
        ends = []
        for step in (-1e-6, 1e-6):
            uv = samples.uv.astype(np.float64)
            uv[..., axis] += step
            ends.append((exact(samples, texels, uv) * weights).sum(axis=2))
        slope = np.where(samples.covered, (ends[1] - ends[0]) / 2e-6, 0)
        np.testing.assert_allclose(gradient[..., axis], slope, atol=2e-3)


def relaxed(
    samples: Samples, texels: np.ndarray, values: np.ndarray, threads: int | None = None
) -> np.ndarray:
    texels, sums = texels.copy(), np.full((*texels.shape[:2], 4), np.nan, np.float32)
    relax_texels(samples, texels, values, sums, share=0.5, doubt=0.25, threads=threads)
    return texels


def test_relaxed_texels_take_a_share_of_their_mean_off_within_the_range_of_colours():
    samples, texels, values = some(4)
    values[..., :3] = 3 * values[..., :3] - 1
    sums = texel_sums(samples, texels, values)
    expected = texels + sums[..., :3] * (np.float32(-0.5) / (sums[..., 3:] + np.float32(0.25)))
    assert expected.min() < 0
    assert expected.max() > 1
    np.testing.assert_array_equal(relaxed(samples, texels, values), np.clip(expected, 0, 1))


def test_threads_do_not_change_a_bit():
    samples, texels, values = some(3)
    for one, four in (
        [texture_samples(samples, texels, EMPTY, threads=n) for n in (1, 4)],
        [texel_sums(samples, texels, values, threads=n) for n in (1, 4)],
        [coordinate_gradients(samples, texels, values, threads=n) for n in (1, 4)],
        [relaxed(samples, texels, values, n) for n in (1, 4)],
    ):
        np.testing.assert_array_equal(one, four)


def test_coordinates_that_are_no_numbers_stay_in_the_texture():
    texels = np.full((3, 3, 3), 0.5, np.float32)
    uv = np.array([[[np.nan, 0.5], [np.inf, -np.inf], [1e30, -1e30], [-0.25, 7.5]]], np.float32)
    samples = Samples(uv, np.ones((1, 4), bool), 1)
    assert np.isfinite(texture_samples(samples, texels, EMPTY)[:, 3]).all()
    texel_sums(samples, texels, np.ones((1, 4, 4), np.float32))
