"""What splats look like to a viewer and over each pixel's area, and the samples a mesh needs for that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import meshsplats as ms
from meshsplats import GaussianCloud, SplatMesh, draw_splats, needed_samples
from meshsplats.cameras.trajectories import look_at
from meshsplats.demo_scene import make_scene
from meshsplats.rendering import reference_splats


@pytest.fixture(scope="module")
def cloud() -> GaussianCloud:
    return make_scene(1500)


def camera_of(cloud, side=48):
    return ms.orbit(cloud, 1, azimuth=20, elevation=20, width=side, height=side)[0]


@pytest.mark.parametrize("kernel", ["3dgs", "antialiased", "2dgs"])
def test_the_area_look_is_the_mean_of_an_image_four_times_as_large(cloud, kernel):
    cloud = replace(cloud, kernel=kernel)
    camera = camera_of(cloud)
    large = ms.render_splats(cloud, camera.scaled(4), background=(0.2, 0.5, 1))
    found = draw_splats(cloud, camera, background=(0.2, 0.5, 1))
    np.testing.assert_allclose(found.color, large.color.reshape(48, 4, 48, 4, 3).mean(axis=(1, 3)), atol=2e-5)
    np.testing.assert_allclose(found.alpha, large.alpha.reshape(48, 4, 48, 4).mean(axis=(1, 3)), atol=2e-5)


def test_the_viewers_look_is_the_3dgs_image(cloud):
    camera = camera_of(cloud)
    found = draw_splats(cloud, camera, "splats", sh_degree=0, background=(0, 1, 0))
    want = ms.render_splats(cloud, camera, sh_degree=0, background=(0, 1, 0))
    np.testing.assert_array_equal(found.color, want.color)


def test_fewer_samples_are_close_to_the_mean_and_one_is_not(cloud):
    camera = camera_of(cloud, 100)
    exact, two, one = (draw_splats(cloud, camera, samples=n).color for n in (None, 2, 1))
    assert ms.psnr(two, exact) > 40 > ms.psnr(one, exact)


def test_a_look_that_does_not_exist(cloud):
    with pytest.raises(ValueError, match="look must be area or splats, got 'viewer'"):
        draw_splats(cloud, camera_of(cloud), "viewer")


@pytest.mark.parametrize("dilation", [0.02, 0.3, 1.2])
def test_the_low_pass_of_2dgs_follows_the_dilation(cloud, dilation):
    flat = replace(cloud.take(np.arange(0, 1500, 60)), kernel="2dgs")
    camera = camera_of(cloud, 24)
    want = reference_splats.render_splats(flat, camera, dilation=dilation)
    found = ms.render_splats(flat, camera, dilation=dilation)
    np.testing.assert_allclose(found.color, want.color, atol=2e-4)


def fan_of(side: float) -> SplatMesh:
    """A square of four triangles around the origin, ``side`` wide, across the z axis."""
    half = side / 2
    rim = [(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)]
    faces = [(0, i + 1, (i + 1) % 4 + 1) for i in range(4)]
    colors = np.full((5, 4), 0.5)
    return SplatMesh(np.array([(0, 0, 0), *rim]), np.array(faces), colors, face_splat=np.zeros(4, np.int32))


def seen_at(pixels: float):
    """A camera that shows a unit length at the origin ``pixels`` wide."""
    camera = look_at((0, 0, -4), (0, 0, 0), up=(0, -1, 0), width=64, height=64, fov=50)
    return replace(camera, fx=4 * pixels, fy=4 * pixels)


@pytest.mark.parametrize(("pixels", "samples"), [(20, 2), (4.1, 2), (2.7, 3), (1.6, 5), (1.0, 8), (0.2, 8)])
def test_eight_samples_along_the_side_of_a_small_fan(pixels, samples):
    assert needed_samples(fan_of(1), [seen_at(pixels)]) == samples
    # Only what shows on the image counts.
    assert needed_samples(fan_of(0.5), [seen_at(2 * pixels)]) == samples


def test_the_smallest_of_all_views_decides():
    assert needed_samples(fan_of(1), [seen_at(20), seen_at(1.6)]) == 5


def test_meshes_that_need_no_more():
    fan = fan_of(1)
    small = [seen_at(0.5)]
    assert needed_samples(replace(fan, face_splat=None), small) == 2
    assert needed_samples(replace(fan, filter_px2=0.3), small) == 1
    away = replace(fan, vertices=fan.vertices + np.float32([90, 0, 0]))
    assert needed_samples(away, small) == 2
    assert needed_samples(fan, []) == 2
    assert needed_samples(fan.take(np.zeros(4, bool)), small) == 2


def test_samples_needed_are_near_those_of_many(cloud):
    mesh = ms.convert(cloud)
    for side in (30, 60, 120):
        camera = camera_of(cloud, side)
        samples = needed_samples(mesh, [camera])
        many = ms.render(mesh, camera, samples=16).color
        assert ms.psnr(ms.render(mesh, camera, samples=samples).color, many) > 40
    assert needed_samples(mesh, [camera_of(cloud, 30)]) > samples
