"""Reduced views: means over the pixels that each new one covers, and cameras that fit them."""

from __future__ import annotations

import numpy as np
import pytest
from _balls import ball_view, cameras_around

from meshsplats.datasets.reduced import opaque_views, reduced_image, reduced_views
from meshsplats.datasets.views import ImageCache, View, ViewImage


def image(**more) -> ViewImage:
    color = np.random.default_rng(0).integers(0, 256, (12, 20, 3)).astype(np.uint8)
    return ViewImage(color, **more)


def test_pixels_are_means_of_those_they_cover():
    alpha = np.random.default_rng(1).integers(0, 256, (12, 20)).astype(np.uint8)
    full = image(alpha=alpha)
    small = reduced_image(full, 5, 3)
    blocks = full.color.reshape(3, 4, 5, 4, 3).mean(axis=(1, 3)) / 255
    assert small.color == pytest.approx(blocks, abs=1e-3)
    assert small.alpha == pytest.approx(alpha.reshape(3, 4, 5, 4).mean(axis=(1, 3)) / 255, abs=1e-3)
    odd = reduced_image(full, 7, 5)  # sides that do not divide keep the mean of the image
    assert odd.color.mean() == pytest.approx(full.color.mean() / 255, abs=1e-3)
    assert small.color.flags.c_contiguous


def test_a_pixel_counts_if_all_that_it_covers_do():
    mask = np.ones((12, 20), bool)
    mask[0, 0] = False
    full = image(mask=mask)
    full.color[0, 0] = 255
    small = reduced_image(full, 5, 3)
    assert not small.mask[0, 0]
    assert small.mask.sum() == 14


def test_cameras_see_the_same_at_every_size():
    camera = cameras_around(3)[0]
    view = ball_view(camera)
    (small,) = reduced_views([view], 0.25, ImageCache(10**9))
    points = np.random.default_rng(0).normal(0, 0.3, (20, 3))
    assert small.camera.project(points)[0] * 4 == pytest.approx(camera.project(points)[0])
    assert small.load() is small.load()
    assert small.load().color.shape == (16, 16, 3)
    assert reduced_views([view], 1, ImageCache(0)) == (view,)


@pytest.mark.parametrize("kind", ["bare", "alpha", "mask"])
def test_the_memory_of_an_image_is_bounded_in_advance(kind):
    more = {
        "bare": {},
        "alpha": {"alpha": np.ones((64, 64), np.uint8)},
        "mask": {"alpha": np.ones((64, 64), np.uint8), "mask": np.ones((64, 64), bool)},
    }[kind]
    view = View(cameras_around(3)[0], ViewImage(np.zeros((64, 64, 3), np.uint8), **more))
    (opaque,) = opaque_views([view])
    (small,) = reduced_views([opaque], 0.5, ImageCache(0))
    for made in (opaque, small):
        assert made.load().nbytes <= made.source.nbytes <= 2 * made.load().nbytes


def test_photographs_without_alpha_become_opaque():
    camera = cameras_around(3)[0]
    for color, one in ((np.zeros((64, 64, 3), np.uint8), 255), (np.zeros((64, 64, 3), np.float32), 1)):
        (view,) = opaque_views([View(camera, ViewImage(color))])
        assert (view.load().alpha == one).all()
    masked = ball_view(camera)
    (view,) = opaque_views([masked])
    assert view.load() is masked.load()
