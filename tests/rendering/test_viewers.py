"""Images as web viewers draw them: equal to the float64 reference, and what they must show by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _rendering import camera, fan, layers, soup, turned
from _zbuffer import zbuffer

from meshsplats import render
from meshsplats.rendering import reference
from meshsplats.rendering.viewers import viewer_images
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear

MODES = (None, 0.0, 0.3, 0.9)


def assert_like_reference(mesh, view, *, flips=2e-3, **options):
    """All but a few pixels within a level, by which a rounding may differ in each of four samples."""
    images = viewer_images(mesh, view, MODES, **options)
    expected = reference.viewer_images(mesh, view, MODES, **options)
    assert images.shape == expected.shape
    off = np.abs(images - expected).max(axis=-1)
    assert (off > 1.01 / 255).mean() <= flips, f"{(off > 1.01 / 255).sum()} pixels, up to {off.max():.3f}"
    return images


@pytest.mark.parametrize("multisample", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_random_triangles(seed, multisample):
    view = turned(camera(), seed)
    images = assert_like_reference(
        soup(seed, 40, view=view), view, multisample=multisample, background=(0.2, 0.5, 1)
    )
    assert len({image.tobytes() for image in images}) == len(MODES)


@pytest.mark.parametrize("near", [1.0, 0.05])
def test_triangles_across_the_near_plane(near):
    mesh = soup(3, 40, spread=(2, 2, 3), z=0.5)
    assert (mesh.vertices[:, 2] < near).sum() > 10
    assert_like_reference(mesh, camera(near=near))


@pytest.mark.slow
def test_small_triangles_on_a_large_image():
    # Many lie in one pixel; tall images are drawn in several bands of rows.
    mesh = soup(5, 600, spread=(1, 1, 0.5))
    points = mesh.vertices[mesh.faces]
    points = points.mean(axis=1, keepdims=True) + 0.02 * (points - points.mean(axis=1, keepdims=True))
    mesh = replace(
        mesh,
        vertices=points.reshape(-1, 3),
        faces=np.arange(3 * len(mesh.faces)).reshape(-1, 3),
        colors=mesh.colors[mesh.faces].reshape(-1, 4),
        attributes={},
    )
    view = camera(90, 150).scaled(1.5)
    one = viewer_images(mesh, view, MODES, threads=1)
    assert_like_reference(mesh, view)
    for threads in (2, 5):
        assert viewer_images(mesh, view, MODES, threads=threads).tobytes() == one.tobytes()


def test_blends_in_the_order_of_the_triangles():
    mesh = layers([3, 2], 0.6, [(1, 0, 0), (0, 0, 1)])
    near_last = viewer_images(mesh, camera(), background=(0, 0, 0))[0]
    # 8 bits: 0.6 * 255 = 153, and 0.4 * 153 rounds to 61.
    assert near_last == pytest.approx(np.broadcast_to(np.array([61, 0, 153]) / 255, near_last.shape))
    turned_over = replace(mesh, faces=mesh.faces[::-1].copy())
    near_first = viewer_images(turned_over, camera(), background=(0, 0, 0))[0]
    assert near_first == pytest.approx(np.broadcast_to(np.array([153, 0, 61]) / 255, near_last.shape))


def test_back_sides_are_blended_before_front_sides():
    mesh = layers([2, 3], 0.6, [(1, 0, 0), (0, 0, 1)])
    order = viewer_images(mesh, camera())[0]
    first_turned = replace(mesh, faces=np.stack([mesh.faces[0], mesh.faces[1, ::-1]]))
    second_turned = replace(mesh, faces=np.stack([mesh.faces[0, ::-1], mesh.faces[1]]))
    images = [viewer_images(m, camera())[0] for m in (first_turned, second_turned)]
    other_order = viewer_images(replace(mesh, faces=mesh.faces[::-1].copy()), camera())[0]
    assert order.tobytes() != other_order.tobytes()
    # Their corners turn clockwise, so these triangles show their backs until they are turned.
    assert images[0].tobytes() == order.tobytes()
    assert images[1].tobytes() == other_order.tobytes()


def test_mask_is_a_depth_buffer():
    view = camera(80, 80)
    mesh = soup(2, 50, spread=(0.8, 0.8, 0.1))
    image = viewer_images(mesh, view, [0.4], multisample=False)[0]
    truth = zbuffer(mesh, view, 0.4)[0]
    off = np.abs(image - truth).max(axis=-1)
    assert (off > 1 / 255).mean() < 2e-3
    assert np.abs(image - render(mesh, view, cutoff=0.4).color).max(axis=-1).max() > 0  # of 8 bits
    assert viewer_images(mesh, view, [0.4])[0] != pytest.approx(truth, abs=0.01)


def test_one_fan_is_sorted_whatever_its_order():
    view = camera(60, 60)
    mesh = fan(1, 7, 0.6)
    image = viewer_images(mesh, view, multisample=False)[0]
    assert np.abs(image - render(mesh, view).color).max() <= 1.01 / 255


def test_linear_colours_are_shown_as_display_values():
    mesh = soup(1, 20)
    linear = replace(
        mesh,
        colors=np.concatenate([srgb_to_linear(mesh.colors[:, :3]), mesh.colors[:, 3:]], axis=1),
        blending="linear",
    )
    images = [viewer_images(m, camera(), MODES) for m in (mesh, linear)]
    assert np.abs(images[0] - images[1]).max() <= 2 / 255
    assert np.abs(linear_to_srgb(linear.colors[:, :3]) - mesh.colors[:, :3]).max() < 1e-6


def test_bad_options():
    mesh = soup(1, 5)
    for options, problem in (
        ({"cutoffs": [1.5]}, "cutoff must be an opacity"),
        ({"background": np.ones((4, 4, 3))}, r"background must have shape \(3,\)"),
        ({"threads": 0}, "threads must be at least 1"),
    ):
        with pytest.raises(ValueError, match=problem):
            viewer_images(mesh, camera(), **options)
