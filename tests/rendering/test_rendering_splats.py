"""The compiled renderer of splats: equal to the float64 reference, and the laws that need no reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _local import shared_data
from _rendering import (
    assert_close,
    assert_same_bits,
    assert_splats_are_exact,
    camera,
    seen_by,
    splats,
    turned,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from meshsplats import Camera, GaussianCloud, load_cameras, load_gaussians
from meshsplats.rendering import render_splats

KERNELS = ("3dgs", "antialiased", "2dgs")
seeds = st.integers(0, 10_000)
kernels = st.sampled_from(KERNELS)
FEW = settings(max_examples=15)

# Against the reference


@FEW
@given(seed=seeds, kernel=kernels, dilation=st.sampled_from([0, 0.05, 0.3]))
def test_random_splats(seed, kernel, dilation):
    cloud, view = splats(seed, kernel=kernel), turned(camera(), seed)
    cloud = replace(cloud, means=seen_by(view, cloud.means))
    assert_splats_are_exact(cloud, view, dilation=dilation)


@FEW
@given(seed=seeds, kernel=kernels)
def test_splats_near_behind_and_beside_the_image(seed, kernel):
    view = camera(near=0.05)
    assert_splats_are_exact(splats(seed, 60, kernel=kernel, spread=0.4, z=0.2), view)
    assert_splats_are_exact(splats(seed, 60, kernel=kernel, spread=6, sizes=(0.1, 3)), view)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("limit", [None, 0, 1, 2, 3])
def test_spherical_harmonics(kernel, degree, limit):
    view = turned(camera(), degree)
    cloud = splats(degree, 20, kernel=kernel, degree=degree)
    cloud = replace(cloud, means=seen_by(view, cloud.means), sh=cloud.sh * 3)
    image = assert_splats_are_exact(cloud, view, sh_degree=limit)
    if limit is not None and limit < degree:
        cut = replace(cloud, sh=cloud.sh[:, : (limit + 1) ** 2])
        assert_same_bits(image, render_splats(cut, view))
        assert np.abs(image.color - render_splats(cloud, view).color).max() > 0.01


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("samples", [1, 2, 3, 5, 16])
def test_samples_and_odd_images(kernel, samples):
    for size in [(13, 11), (1, 1), (17, 2)]:
        assert_splats_are_exact(splats(6, 15, kernel=kernel), camera(*size), samples=samples)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("opacity", [0, 0.0039, 0.00393, 0.5, 0.99, 1])
def test_opacities(kernel, opacity):
    image = assert_splats_are_exact(splats(7, 60, kernel=kernel, opacity=opacity), camera())
    assert opacity >= 1 / 255 or image.fragments == 0


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("dilation", [0, 0.3])
@pytest.mark.parametrize("flat", [(0,), (1,), (2,), (0, 1), (0, 1, 2)])
def test_scales_of_zero(kernel, dilation, flat):
    cloud = splats(8, kernel=kernel, sizes=(0.1, 1))
    scales = cloud.scales.copy()
    scales[:, flat] = 0
    view = camera()
    image = render_splats(replace(cloud, scales=scales), view, dilation=dilation)
    if kernel != "2dgs" and dilation == 0 and len(flat) > 1:
        assert image.fragments == 0  # lines and points cover nothing
    else:
        assert_splats_are_exact(replace(cloud, scales=scales), view, dilation=dilation, tolerance=2e-4)


@pytest.mark.parametrize("dilation", [0, 0.3])
@pytest.mark.parametrize("thickness", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("angle", [0.3, np.pi / 4, 1.2])
def test_needles(angle, thickness, dilation):
    # In front of the image, and across it with the centre far outside; up to 3e5 times as long as thick.
    view = Camera(np.eye(4), 200, 200, 32.5, 32.5, 65, 65, 0.1)
    quaternion = [[np.cos(angle / 2), 0, 0, np.sin(angle / 2)]]
    for kernel in KERNELS:
        for away, length in [(0, 1.0), (60, 30.0)]:
            center = [[away * np.cos(angle), away * np.sin(angle), 1]]
            cloud = GaussianCloud(
                center, quaternion, [[length, thickness, 0]], [0.9], np.zeros((1, 1, 3)), kernel
            )
            assert_splats_are_exact(cloud, view, dilation=dilation)


@pytest.mark.parametrize("kernel", KERNELS)
def test_one_splat_that_covers_all(kernel):
    cloud = GaussianCloud([(0, 0, 5)], [(1, 0, 0, 0)], [(1e4, 1e4, 0)], [0.7], np.ones((1, 1, 3)), kernel)
    image = assert_splats_are_exact(cloud, camera(100, 70))
    np.testing.assert_allclose(image.alpha, 0.7, atol=1e-6)
    for distance in (1e3, 1e6, 1e20):
        away = replace(cloud, means=[(distance, -distance, 5)], scales=[(100 * distance, 100 * distance, 0)])
        assert assert_splats_are_exact(away, camera()).alpha.min() > 0.69


@pytest.mark.parametrize("kernel", KERNELS)
def test_nothing_to_draw(kernel):
    cloud = splats(1, kernel=kernel)
    background = np.random.default_rng(0).random((29, 37, 3)).astype(np.float32)
    for nothing in (
        cloud.take(np.zeros(0, int)),
        replace(cloud, means=cloud.means * -1),
        replace(cloud, opacities=np.zeros(30)),
    ):
        image = render_splats(nothing, camera(near=8), background=background)
        assert (image.color == background).all()
        assert not image.alpha.any()
        assert image.fragments == 0


@pytest.mark.parametrize("kernel", KERNELS)
def test_centres_nearer_than_the_near_plane_are_left_out(kernel):
    cloud = replace(
        splats(2, 2, kernel=kernel, opacity=0.9), means=[(0, 0, 1), (0, 0, 2)], scales=np.full((2, 3), 0.2)
    )
    for near, drawn in [(0.999, [0, 1]), (1.0, [0, 1]), (1.001, [1]), (2.001, [])]:
        image = assert_splats_are_exact(cloud, camera(near=near))
        assert (image.fragments > 0) == (len(drawn) > 0)
        assert_same_bits(image, render_splats(cloud.take(np.array(drawn, int)), camera(near=near)))


@pytest.mark.parametrize("kernel", KERNELS)
def test_equal_depths_go_by_number(kernel):
    cloud = splats(3, 300, kernel=kernel, opacity=0.4, sizes=(0.2, 0.5))
    means = cloud.means.copy()
    means[:, 2] = np.random.default_rng(0).integers(2, 4, 300)
    assert_splats_are_exact(replace(cloud, means=means), camera())


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
def test_real_splats(kernel):
    cloud = load_gaussians(shared_data("splats/playbot_lod6_2k_sh2.ply"))
    view = load_cameras(shared_data("cameras/playbot_close.json"))[3].scaled(0.15)
    assert_splats_are_exact(replace(cloud, kernel=kernel), view)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
def test_a_part_of_a_real_image(kernel):
    cloud = load_gaussians(shared_data("splats/guitar_sh0.ply"))
    cloud = replace(cloud.take(np.arange(0, len(cloud), 23)), kernel=kernel)
    view = load_cameras(shared_data("cameras/guitar_close.json"))[0]
    view = replace(view, width=40, height=40, cx=view.cx - 180, cy=view.cy - 180)
    assert assert_splats_are_exact(cloud, view).alpha.max() > 0.5


# Laws


@FEW
@given(seed=seeds, kernel=kernels)
def test_order_does_not_matter(seed, kernel):
    cloud = splats(seed, 200, kernel=kernel)
    order = np.random.default_rng(seed).permutation(200)
    assert_same_bits(render_splats(cloud, camera()), render_splats(cloud.take(order), camera()))


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_part_of_an_image_is_the_image_of_the_part(kernel):
    # Alpha does not depend on the grid of tiles; EWA's limits outside the image do depend on its sides.
    cloud = splats(4, 80, kernel=kernel, spread=0.4)
    whole = render_splats(cloud, camera(64, 48, cx=32.0, cy=24.0))
    part = render_splats(cloud, camera(41, 31, cx=32.0 - 9, cy=24.0 - 7))
    np.testing.assert_allclose(part.color, whole.color[7 : 7 + 31, 9 : 9 + 41], atol=1e-5)


@FEW
@given(seed=seeds, kernel=kernels)
def test_everything_moved_far_away(seed, kernel):
    view = turned(camera(), seed)
    cloud = splats(seed, kernel=kernel)
    cloud = replace(cloud, means=np.round(seen_by(view, cloud.means) * 256) / 256)
    shift = np.array([1e4, -1e4, 1e4])
    matrix = view.world_to_camera.copy()
    matrix[:3, 3] -= matrix[:3, :3] @ shift
    moved = render_splats(
        replace(cloud, means=cloud.means + np.float32(shift)), replace(view, world_to_camera=matrix)
    )
    assert_close(moved, render_splats(cloud, view))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_size_of_the_scene_does_not_matter(kernel, factor):
    cloud = splats(9, kernel=kernel)
    scaled = replace(cloud, means=cloud.means * np.float32(factor), scales=cloud.scales * np.float32(factor))
    assert_close(render_splats(scaled, camera(near=0.5 * factor)), render_splats(cloud, camera()))


def test_background_is_affine():
    rng = np.random.default_rng(0)
    cloud, view = splats(2), camera()
    one, two = rng.random((2, 29, 37, 3)).astype(np.float32)
    assert_splats_are_exact(cloud, view, background=one)
    mixed = render_splats(cloud, view, background=0.25 * one + 0.75 * two).color
    parts = [
        share * render_splats(cloud, view, background=b).color for share, b in ((0.25, one), (0.75, two))
    ]
    np.testing.assert_allclose(mixed, sum(parts), atol=1e-6)


# In stages: clouds of which hundreds of thousands are in front of the camera


def crowd(seed: int, n: int, near: float, far: float, kernel: str) -> GaussianCloud:
    """Small faint splats before ``camera(64, 48)``, between two depths."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(near, far, n)
    x, y = (rng.random(n) - 0.47) * 64 / 31, (rng.random(n) - 0.55) * 48 / 27
    cloud = splats(seed, n, kernel=kernel, degree=0, sizes=(1e-3, 3e-3), opacity=0.02)
    return replace(cloud, means=np.column_stack([x * depth, y * depth, depth]))


SIDE = 100
"""Places of a wall's splats along each of its sides."""


def wall(depth: float, bottom: float, kernel: str) -> GaussianCloud:
    """Opaque splats, four at each place, down to a share of the image's height: no light passes."""
    cloud = crowd(0, 4 * SIDE**2, depth, depth, kernel)
    x, y = np.meshgrid(np.linspace(-0.2, 1.2, SIDE), np.linspace(-0.2, bottom, SIDE))
    points = np.column_stack([(x.ravel() - 0.47) * 64 / 31, (y.ravel() - 0.55) * 48 / 27, np.ones(SIDE**2)])
    means = np.tile(points * depth, (4, 1))
    scales = np.full_like(cloud.scales, 0.01 * depth)
    return replace(cloud, means=means, scales=scales, opacities=np.ones_like(cloud.opacities))


@pytest.mark.parametrize("kernel", KERNELS)
def test_what_lies_behind_a_wall_changes_no_bit(kernel):
    view = camera(64, 48)
    front = GaussianCloud.joined([crowd(1, 90_000, 2, 3, kernel), wall(4, 1.2, kernel)])
    whole = GaussianCloud.joined([crowd(2, 400_000, 5, 9, kernel), front])
    assert_same_bits(render_splats(whole, view), render_splats(front, view))


# Not 'antialiased': the opacity of splats far outside depends on the sides of the image.
@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("kernel", ["3dgs", "2dgs"])
@pytest.mark.parametrize("samples", [1, 2])
def test_where_no_wall_is_the_rest_is_drawn(kernel, samples):
    view = camera(64, 48)
    cloud = GaussianCloud.joined(
        [
            *(crowd(seed, 60_000, 2, 9, kernel) for seed in range(7)),
            wall(3, 0.4, kernel),
        ]
    )
    whole = render_splats(cloud, view, samples=samples)
    columns = []
    for x in range(0, 64, 16):  # so few columns have too few splats for stages
        part = render_splats(cloud, replace(view, width=16, cx=view.cx - x), samples=samples)
        columns.append(part.color)
    assert whole.fragments > 1e5 * samples**2
    np.testing.assert_allclose(np.concatenate(columns, axis=1), whole.color, atol=2e-5)
