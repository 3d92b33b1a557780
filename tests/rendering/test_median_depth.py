"""Median depths of images: where half of the light is stopped."""

from __future__ import annotations

import numpy as np
import pytest
from _rendering import assert_mesh_is_exact, camera, layers, soup

from meshsplats.rendering import reference, render


def test_median_depth_is_that_of_the_fragment_that_stops_half_of_the_light():
    view = camera()
    for depths, opacities, expected in (
        ([2.0, 6.0], [0.5, 1.0], 2),
        ([2.0, 6.0], [0.4, 1.0], 6),
        ([2.0, 4.0, 6.0], [0.3, 0.3, 0.9], 4),
        ([2.0, 4.0, 6.0], [0.2, 0.3, 0.9], 6),
        ([2.0], [0.49], np.inf),
    ):
        found = render(layers(depths, opacities), view, median_depth=True)
        np.testing.assert_allclose(found.median_depth, expected, rtol=1e-6)
        assert found.depth is None
    assert render(layers([2.0], 1.0), view, depth=True).median_depth is None


@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize("max_layers", [None, 2])
def test_median_depths_are_those_of_the_reference(samples, max_layers):
    mesh, view = soup(5, 9), camera()
    options = {"samples": samples, "max_layers": max_layers, "median_depth": True, "min_transmittance": 0.01}
    image = assert_mesh_is_exact(mesh, view, depth=True, **options)
    truth = reference.render(mesh, view, **options).median_depth
    same = np.isclose(image.median_depth, truth, rtol=1e-5)
    assert same.mean() > 0.995  # weights that add up to a half but for rounding
    assert 0.1 < np.isinf(truth).mean() < 0.9
    alone = render(mesh, view, **options)
    np.testing.assert_array_equal(alone.median_depth, image.median_depth)
    for threads in (1, 3):
        again = render(mesh, view, threads=threads, **options)
        np.testing.assert_array_equal(again.median_depth, image.median_depth)
