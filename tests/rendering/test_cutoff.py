"""Meshes drawn with a cutoff: every fragment is opaque or not there."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from _rendering import (
    EXTRAS,
    FLIPS,
    assert_close,
    assert_mesh_is_exact,
    assert_same_bits,
    camera,
    layers,
    soup,
    turned,
)
from _zbuffer import zbuffer
from hypothesis import given, settings
from hypothesis import strategies as st

from meshsplats import Camera, SplatMesh
from meshsplats.rendering import reference, render

BOTH = pytest.mark.parametrize("renderer", [render, reference.render])
FEW = settings(max_examples=12)
seeds = st.integers(0, 10_000)
cutoffs = st.sampled_from([0.0, 0.01, 0.2, 0.5, 0.9, 1.0])

RED, GREEN, BLUE = (1, 0, 0), (0, 1, 0), (0, 0, 1)


def ramp(depth: float = 1.0, color=RED) -> SplatMesh:
    """Opacity x / 8 at column x of ``flat(8, 4)``, in one triangle beyond the image."""
    corners = np.array([(0, -4, 1), (8, -4, 1), (0, 20, 1)]) * depth
    colors = np.array([(*color, 0.0), (*color, 1.0), (*color, 0.0)])
    return SplatMesh(corners, [(0, 1, 2)], colors)


def flat(width: int, height: int) -> Camera:
    """Sees the point (X, Y, Z) at (X / Z, Y / Z) pixels."""
    return Camera(np.eye(4), 1, 1, 0, 0, width, height, 0.01)


# Worked out by hand


@BOTH
@pytest.mark.parametrize("cutoff", [0.25, 0.3])
def test_a_ramp_is_cut_where_its_opacity_crosses_the_cutoff(renderer, cutoff):
    # Opacity is x / 8; pixel centres lie at 0.5, 1.5, ...: from 2.5 on it is at least 0.3125.
    image = renderer(ramp(), flat(5, 4), cutoff=cutoff, background=BLUE)
    assert np.array_equal(image.alpha, np.tile([0, 0, 1, 1, 1], (4, 1)))
    assert np.allclose(image.color, np.where(image.alpha[..., None] > 0, RED, BLUE), atol=1e-6)


@BOTH
def test_samples_give_the_covered_share_of_a_pixel(renderer):
    # The cutoff is crossed at x = 2.4: of the pixel from 2 to 3, the samples at 2.625 and 2.875 are covered.
    image = renderer(ramp(), flat(5, 4), cutoff=0.3, samples=4, background=BLUE)
    assert np.allclose(image.alpha, np.tile([0, 0, 0.5, 1, 1], (4, 1)))
    assert np.allclose(image.color[:, 2], (0.5, 0, 0.5), atol=1e-6)


@BOTH
def test_the_nearest_opaque_layer_hides_all_others(renderer):
    mesh = layers([2, 3, 4, 5], [0.3, 0.6, 0.2, 0.9], [RED, GREEN, BLUE, (1, 1, 1)])
    view = camera(6, 5)
    for cutoff, color, depth in ((0.1, RED, 2), (0.3, RED, 2), (0.31, GREEN, 3), (0.61, (1, 1, 1), 5)):
        image = renderer(mesh, view, cutoff=cutoff, background=(0, 0, 0), depth=True)
        assert np.allclose(image.color, color, atol=1e-6)
        assert np.allclose(image.depth, depth, atol=1e-5)
        assert (image.alpha == 1).all()
        assert image.fragments == 30
    assert renderer(mesh, view, cutoff=0.95).fragments == 0


@BOTH
def test_an_opacity_equal_to_the_cutoff_is_drawn(renderer):
    for opacity in (0.0, 0.1, 0.3, 1.0):
        image = renderer(layers([2], opacity), camera(5, 4), cutoff=opacity)
        assert (image.alpha == 1).all()


# Laws


@pytest.mark.slow
@FEW
@given(seed=seeds, cutoff=cutoffs, samples=st.sampled_from([1, 2, 3]))
def test_the_core_agrees_with_the_reference(seed, cutoff, samples):
    view = turned(camera(), seed)
    # A sample within rounding of the level set, too, may be on either side.
    assert_mesh_is_exact(
        soup(seed, view=view), view, cutoff=cutoff, samples=samples, flips=3 * FLIPS, **EXTRAS
    )


@FEW
@given(seed=seeds, cutoff=cutoffs)
def test_triangles_across_the_near_plane(seed, cutoff):
    mesh = soup(seed, spread=(2, 2, 3), z=0.5)
    assert_mesh_is_exact(mesh, camera(), cutoff=cutoff, tolerance=5e-5, flips=3 * FLIPS, **EXTRAS)


@FEW
@given(seed=seeds, cutoff=cutoffs, samples=st.sampled_from([1, 2]))
def test_a_z_buffer_draws_the_same(seed, cutoff, samples):
    view = camera()
    mesh = soup(seed, spread=(1.0, 1.0, 0.5), z=3)
    mesh = replace(mesh, vertices=np.maximum(mesh.vertices, (-np.inf, -np.inf, 1)))
    image = render(mesh, view, cutoff=cutoff, samples=samples, depth=True)
    color, alpha, depth = zbuffer(mesh, view, np.float32(cutoff), samples=samples)
    wrong = np.abs(image.color - color).max(axis=2) > 1e-4
    wrong |= np.abs(image.alpha - alpha) > 1e-6
    wrong |= np.abs(image.depth - depth) > 1e-4
    assert wrong.mean() <= 5 * FLIPS


@FEW
@given(seed=seeds, cutoff=cutoffs)
def test_the_order_of_triangles_does_not_matter(seed, cutoff):
    mesh = soup(seed)
    shuffled = replace(mesh, faces=np.random.default_rng(seed).permutation(mesh.faces))
    one, two = (render(m, camera(), cutoff=cutoff, **EXTRAS) for m in (mesh, shuffled))
    assert_close(one, two)


@FEW
@given(seed=seeds)
def test_opaque_triangles_look_the_same_with_any_cutoff(seed):
    mesh = soup(seed)
    colors = mesh.colors.copy()
    colors[:, 3] = 1
    mesh = replace(mesh, colors=colors)
    exact = render(mesh, camera(), samples=2, **EXTRAS)
    for cutoff in (0, 0.5, 1):
        assert_same_bits(render(mesh, camera(), samples=2, cutoff=cutoff, **EXTRAS), exact)


@FEW
@given(seed=seeds)
def test_a_higher_cutoff_covers_less(seed):
    mesh = soup(seed)
    alphas = [render(mesh, camera(), samples=2, cutoff=c).alpha for c in (0, 0.1, 0.4, 0.8, 1)]
    for more, less in pairwise(alphas):
        assert (less <= more).all()


def test_a_cutoff_of_zero_draws_transparent_triangles():
    assert (render(layers([2], 0), camera(), cutoff=0).alpha == 1).all()


def test_no_depth_order_or_thread_count_changes_a_bit():
    mesh = soup(3, 200)
    image = render(mesh, camera(), cutoff=0.4, samples=3, threads=1, **EXTRAS)
    assert_same_bits(render(mesh, camera(), cutoff=0.4, samples=3, threads=4, **EXTRAS), image)
    # Without a limit on the transmittance, what lies behind is drawn with a weight of 0.
    assert_same_bits(render(mesh, camera(), cutoff=0.4, samples=3, min_transmittance=0, **EXTRAS), image)


def test_a_filter_moves_triangles_before_the_cut():
    mesh = soup(5, spread=(1, 1, 0.3), z=4)
    mesh = replace(mesh, face_splat=np.zeros(60, int), filter_px2=0.5)
    view = camera()
    image = assert_mesh_is_exact(mesh, view, cutoff=0.3, flips=5 * FLIPS)
    assert (image.color != render(mesh, view, cutoff=0.3, filter_px2=0).color).any()


@pytest.mark.parametrize("cutoff", [-0.1, 1.1, np.nan, np.inf])
@BOTH
def test_a_cutoff_is_an_opacity(renderer, cutoff):
    with pytest.raises(ValueError, match="cutoff must be an opacity from 0 to 1"):
        renderer(layers([2], 0.5), camera(), cutoff=cutoff)
