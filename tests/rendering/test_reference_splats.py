"""The float64 reference for splats against values worked out by hand and the laws of splatting."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshsplats.rendering.reference_splats import render_splats, sh_basis, splat_colors
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import SH_C0, GaussianCloud

BLACK = (0, 0, 0)
seeds = st.integers(0, 10_000)
FEW = settings(max_examples=20)


def one_splat(mean=(0, 0, 2), scales=(0.1, 0.1, 0.1), opacity=0.8, **options) -> GaussianCloud:
    """One splat of RGB (1, 0.5, 0)."""
    sh = options.pop("sh", [[(0.5 / SH_C0, 0, -0.5 / SH_C0)]])
    quaternion = options.pop("quaternion", (1, 0, 0, 0))
    return GaussianCloud([mean], [quaternion], [scales], [opacity], sh, **options)


def random_splats(seed: int, n: int = 10, kernel: str = "3dgs") -> GaussianCloud:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    means = np.round(rng.normal((0, 0, 3), 1, (n, 3)) * 256) / 256
    sh = rng.normal(size=(n, 9, 3)) * 0.5
    return GaussianCloud(means, quaternions, rng.uniform(0.01, 0.5, (n, 3)), rng.random(n), sh, kernel)


def random_camera() -> Camera:
    return Camera(np.eye(4), 11, 12, 6.3, 4.9, 13, 11, near=0.5)


def same(a, b) -> None:
    np.testing.assert_allclose(a.color, b.color, rtol=0, atol=1e-12)
    np.testing.assert_allclose(a.alpha, b.alpha, rtol=0, atol=1e-12)


def splat_camera() -> Camera:
    """At z = 2, 0.1 in the scene is one pixel; the axis meets the middle of pixel (2, 2)."""
    return Camera(np.eye(4), 20, 20, 2.5, 2.5, 5, 5)


def test_one_splat_by_hand():
    result = render_splats(one_splat(), splat_camera(), background=(0, 0, 1))
    # Standard deviation 1 px, so the covariance is 1 + 0.3 px^2 both ways.
    for row, col, squared_distance in ((2, 2, 0), (2, 3, 1), (3, 4, 5), (0, 2, 4)):
        alpha = 0.8 * math.exp(-0.5 * squared_distance / 1.3)
        assert result.alpha[row, col] == pytest.approx(alpha, abs=1e-7)
        np.testing.assert_allclose(result.color[row, col], [alpha, 0.5 * alpha, 1 - alpha], atol=2e-7)
    assert result.fragments == 25
    wide = render_splats(one_splat(), splat_camera(), dilation=1)
    assert wide.alpha[2, 3] == pytest.approx(0.8 * math.exp(-0.5 / 2), abs=1e-7)


def test_a_turned_splat_by_hand():
    # Axes of 2 and 1 px turned by 30 degrees: variances 4 and 1 along (c, s) and (-s, c).
    c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
    half = math.pi / 12
    splat = one_splat(scales=(0.2, 0.1, 0.7), quaternion=(math.cos(half), 0, 0, math.sin(half)))
    along, across = 1 * c + 2 * s, -1 * s + 2 * c  # of the pixel one to the right and two down
    alpha = 0.8 * math.exp(-0.5 * (along**2 / 4.3 + across**2 / 1.3))
    assert render_splats(splat, splat_camera()).alpha[4, 3] == pytest.approx(alpha, abs=1e-7)


def test_a_splat_off_the_axis_by_hand():
    # At (0.2, 0, 2) the Jacobian is (10, 0, -1; 0, 10, 0): depth shows as a shift to the left.
    splat = one_splat(mean=(0.2, 0, 2), scales=(0.1, 0.1, 1))
    alpha = 0.8 * math.exp(-0.5 * 1 / (1 + 1 + 0.3))
    assert render_splats(splat, splat_camera()).alpha[2, 3] == pytest.approx(alpha, abs=1e-7)


def test_the_jacobian_of_a_splat_far_outside_is_limited():
    # tan x of the image: -0.2 to 0.8, half field of view 0.5, so limits -0.35 and 0.95.
    camera = Camera(np.eye(4), 10, 10, 2, 5, 10, 10)
    for tan, limit, pixel in ((2.0, 0.95, 9), (-1.5, -0.35, 0)):
        splat = one_splat(mean=(2 * tan, 0, 2), scales=(0.01, 0.01, 3))
        variance = (5 * 0.01) ** 2 + (5 * limit * 3) ** 2 + 0.3
        distance = pixel + 0.5 - (2 + 10 * tan)
        # Half a pixel down; there the covariance has no slant, as y / z is 0.
        power = distance**2 / variance + 0.25 / ((5 * 0.01) ** 2 + 0.3)
        alpha = 0.8 * math.exp(-0.5 * power)
        result = render_splats(splat, camera)
        assert result.alpha[5, pixel] == pytest.approx(alpha if alpha >= 1 / 255 else 0, rel=1e-5)
        turned = Camera(np.eye(4), 10, 10, 5, 2, 10, 10)
        upright = one_splat(mean=(0, 2 * tan, 2), scales=(0.01, 0.01, 3))
        np.testing.assert_allclose(render_splats(upright, turned).alpha, result.alpha.T, atol=1e-12)
    assert render_splats(one_splat(mean=(4, 0, 2), scales=(0.01, 0.01, 3)), camera).alpha[5, 9] > 0.1


@FEW
@given(seed=seeds)
def test_projected_covariance_follows_from_the_projection(seed):
    # The falloff read back from the image, against a Jacobian by differences and a rotation by quaternions.
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    q = np.float32(q / np.linalg.norm(q)).astype(float)
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, :3] *= np.linalg.det(pose[:3, :3])
    pose[:3, 3] = [0, 0, 3]
    mean, scales = rng.uniform(-0.3, 0.3, 3), rng.uniform(0.3, 0.6, 3)
    mean, scales = np.float32(mean).astype(float), np.float32(scales).astype(float)
    camera = Camera(pose, 9, 10, 4.2, 3.4, 8, 7)
    splat = GaussianCloud([mean], [q], [scales], [0.9], np.ones((1, 1, 3)))

    def project(p):
        x = pose[:3, :3] @ p + pose[:3, 3]
        return np.array([9 * x[0] / x[2] + 4.2, 10 * x[1] / x[2] + 3.4])

    def turn(v):
        return v + 2 * np.cross(q[1:], np.cross(q[1:], v) + q[0] * v)

    step = 1e-5
    axes = [turn(axis) * s for axis, s in zip(np.eye(3), scales, strict=True)]
    shifts = np.array([(project(mean + step * a) - project(mean - step * a)) / (2 * step) for a in axes]).T
    inverse = np.linalg.inv(shifts @ shifts.T + 0.3 * np.eye(2))
    result = render_splats(splat, camera)
    for row, col in np.ndindex(7, 8):
        d = np.array([col + 0.5, row + 0.5]) - project(mean)
        alpha = np.float32(0.9) * math.exp(-0.5 * d @ inverse @ d)
        if abs(alpha - 1 / 255) > 1e-6:
            assert result.alpha[row, col] == pytest.approx(alpha if alpha > 1 / 255 else 0, abs=1e-6)


def test_faint_and_opaque_limits():
    # The 1 / 255 limit is met at a distance of sqrt(2 * 1.3 * ln(0.8 * 255)) = 3.72 px.
    camera = Camera(np.eye(4), 20, 20, 2.5, 0.5, 12, 1)
    alpha = render_splats(one_splat(), camera).alpha[0]
    assert (alpha[:6] >= 1 / 255).all()
    assert alpha[5] == pytest.approx(0.8 * math.exp(-0.5 * 9 / 1.3), abs=1e-7)
    assert (alpha[6:] == 0).all()
    assert render_splats(one_splat(opacity=1), camera).alpha[0, 2] == pytest.approx(0.99, abs=1e-12)


def test_a_sample_stops_before_the_splat_that_would_darken_it():
    # T: 1, 0.02, 0.0004; the third would leave 0.000008 and ends the sample, even for the faint fourth.
    stack = GaussianCloud(
        [(0, 0, z) for z in (2, 3, 4, 5)],
        [(1, 0, 0, 0)] * 4,
        [(9, 9, 9)] * 4,
        [0.98, 0.98, 0.98, 0.1],
        np.zeros((4, 1, 3)),
    )
    camera = Camera(np.eye(4), 1, 1, 0.5, 0.5, 1, 1)
    result = render_splats(stack, camera)
    assert result.fragments == 2
    assert result.alpha[0, 0] == pytest.approx(1 - 0.0004, abs=1e-7)
    without = render_splats(stack.take(np.array([0, 1, 3])), camera)
    assert without.fragments == 3
    assert without.alpha[0, 0] == pytest.approx(1 - 0.00036, abs=1e-7)


def test_splats_go_by_the_depth_of_their_centres():
    rgb = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    sh = (np.array(rgb)[:, None] - 0.5) / SH_C0
    cloud = GaussianCloud(
        [(0, 0, 3), (0, 0, 2), (0, 0, 2)], [(1, 0, 0, 0)] * 3, [(9, 9, 9)] * 3, [0.5] * 3, sh
    )
    result = render_splats(cloud, splat_camera(), background=BLACK)
    np.testing.assert_allclose(result.color[2, 2], [0.125, 0.5, 0.25], atol=1e-7)
    for near, fragments in ((2, 75), (2.5, 25), (3.5, 0)):
        assert render_splats(cloud, replace(splat_camera(), near=near)).fragments == fragments


def test_antialiased_splats_by_hand():
    # The integral of the falloff is 2 pi sqrt(det): 1 before and 1.3 after the dilation.
    plain, kept = (one_splat(kernel=k) for k in ("3dgs", "antialiased"))
    factor = math.sqrt(1 / 1.3**2)
    alpha = render_splats(kept, splat_camera()).alpha
    assert alpha[2, 2] == pytest.approx(0.8 * factor, abs=1e-7)
    assert alpha[2, 3] == pytest.approx(0.8 * factor * math.exp(-0.5 / 1.3), abs=1e-7)
    sharp = (render_splats(s, splat_camera(), dilation=0).alpha for s in (plain, kept))
    np.testing.assert_allclose(*sharp, atol=1e-12)
    edge_on = one_splat(scales=(0, 0.1, 0.1), kernel="antialiased")
    assert render_splats(edge_on, splat_camera()).fragments == 0


def test_a_flat_splat_seen_edge_on_shows_by_its_dilation_only():
    edge_on = one_splat(scales=(0, 0.1, 0.1))
    alpha = render_splats(edge_on, splat_camera()).alpha
    assert alpha[3, 3] == pytest.approx(0.8 * math.exp(-0.5 * (1 / 0.3 + 1 / 1.3)), abs=1e-7)
    assert render_splats(edge_on, splat_camera(), dilation=0).fragments == 0


def test_flat_splats_by_hand():
    def alpha(**options):
        return render_splats(one_splat(kernel="2dgs", **options), splat_camera()).alpha

    # Facing the camera, of 1 px; the third scale has no part in it.
    facing = alpha(scales=(0.1, 0.2, 5))
    assert facing[2, 3] == pytest.approx(0.8 * math.exp(-0.5), abs=1e-7)
    assert facing[4, 2] == pytest.approx(0.8 * math.exp(-0.5 * 4 / 4), abs=1e-7)
    # Of 0.1 px the low-pass filter is left, sigma sqrt(1 / 2) px.
    for scales in ((0.01, 0.01, 0), (0, 0, 0), (0, 0.1, 0)):
        assert alpha(scales=scales)[2, 3] == pytest.approx(0.8 * math.exp(-0.5 * 2), abs=1e-7)
    assert alpha(scales=(0, 0.1, 0))[2, 2] == pytest.approx(0.8, abs=1e-7)


def test_a_slanted_flat_splat_is_met_by_the_ray():
    # Turned by 60 degrees about y: first axis (cos, 0, -sin), normal (sin, 0, cos), through (0, 0, 2).
    c, s = 0.5, math.sqrt(3) / 2
    splat = one_splat(scales=(1, 1, 0), quaternion=(math.cos(math.pi / 6), 0, math.sin(math.pi / 6), 0))
    splat = replace(splat, kernel="2dgs")
    result = render_splats(splat, Camera(np.eye(4), 4, 4, 4.5, 0.5, 9, 1))
    for col in range(9):
        tan = (col - 4) / 4
        z = 2 * c / (tan * s + c)  # where normal . z (tan, 0, 1) = normal . (0, 0, 2)
        u = z * tan * c - (z - 2) * s
        # On the far left the ray meets the plane behind the camera: the low-pass filter alone is left.
        rho = min(u * u, 2 * (col - 4) ** 2) if z > 0 else 2 * (col - 4) ** 2
        alpha = 0.8 * math.exp(-0.5 * rho)
        assert result.alpha[0, col] == pytest.approx(alpha if alpha >= 1 / 255 else 0, abs=1e-6)
    assert 2 * c / (-1 * s + c) < 0
    assert 0 < result.alpha[0, 3] != result.alpha[0, 5] > 0
    # An intersection nearer than the near plane does not count either: at column 8 it is at z = 0.73.
    near = render_splats(splat, Camera(np.eye(4), 4, 4, 4.5, 0.5, 9, 1, near=0.8))
    assert result.alpha[0, 8] > 0.1
    assert near.alpha[0, 8] == 0


def test_spherical_harmonics_are_the_standard_ones():
    special = pytest.importorskip("scipy.special")
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    phi = np.arctan2(directions[:, 1], directions[:, 0])
    basis = sh_basis(directions, 3)
    for degree in range(4):
        assert (sh_basis(directions, degree) == basis[:, : (degree + 1) ** 2]).all()
        for m in range(-degree, degree + 1):
            k = abs(m)
            norm = (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - k) / math.factorial(degree + k)
            # lpmv carries the Condon-Shortley sign.
            value = math.sqrt(norm) * special.lpmv(k, degree, directions[:, 2])
            if m:
                value = value * math.sqrt(2) * (np.cos(k * phi) if m > 0 else np.sin(k * phi))
            np.testing.assert_allclose(basis[:, degree * (degree + 1) + m], value, atol=1e-12)
    with pytest.raises(ValueError, match="degree must be 0, 1, 2 or 3, got 4"):
        sh_basis(directions, 4)


def test_colour_depends_on_the_direction_from_the_camera_to_the_splat():
    sh = np.zeros((1, 4, 3))
    sh[0, 2] = (0.2, 0, 0)  # along +z
    sh[0, 3] = (0, 0.3, 0)  # along -x
    sh[0, 0] = (0, 0, -9)
    c1 = math.sqrt(3 / (4 * math.pi))
    cloud = one_splat(mean=(3, 0, 4), sh=sh)
    pose = np.eye(4)
    np.testing.assert_allclose(
        splat_colors(cloud, Camera(pose, 1, 1, 0, 0, 1, 1), 3),
        [(0.5 + 0.2 * c1 * 0.8, 0.5 - 0.3 * c1 * 0.6, 0)],
        atol=1e-7,
    )
    pose = np.eye(4)
    pose[:3, 3] = (-3, 0, -8)  # the camera at (3, 0, 8) looks along +z; the splat is behind it, towards -z
    np.testing.assert_allclose(
        splat_colors(cloud, Camera(pose, 1, 1, 0, 0, 1, 1), 1), [(0.5 - 0.2 * c1, 0.5, 0)], atol=1e-7
    )
    np.testing.assert_allclose(
        splat_colors(cloud, Camera(pose, 1, 1, 0, 0, 1, 1), 0), [(0.5, 0.5, 0)], atol=1e-7
    )
    bright = render_splats(one_splat(sh=np.full((1, 1, 3), 9.0)), splat_camera(), background=BLACK)
    np.testing.assert_allclose(bright.color[2, 2], 0.8, rtol=1e-6)  # degree 0 alone: what a vertex can carry
    sh = np.zeros((1, 4, 3))
    sh[:, 0] = 9.0
    bright = render_splats(one_splat(sh=sh), splat_camera(), background=BLACK)
    np.testing.assert_allclose(bright.color[2, 2], 0.8 * (0.5 + 9 * SH_C0), rtol=1e-6)


@pytest.mark.parametrize("kernel", ["3dgs", "antialiased", "2dgs"])
@FEW
@given(seed=seeds)
def test_splat_laws(kernel, seed):
    cloud, camera = random_splats(seed, kernel=kernel), random_camera()
    rng = np.random.default_rng(seed)
    expected = render_splats(cloud, camera)
    if len(np.unique(cloud.means[:, 2])) == len(cloud):
        same(render_splats(cloud.take(rng.permutation(len(cloud))), camera), expected)
    on_black = render_splats(cloud, camera, background=BLACK)
    np.testing.assert_allclose(
        expected.color, on_black.color + (1 - on_black.alpha)[..., None], rtol=0, atol=1e-12
    )
    # The signs of a quaternion, and of an axis with its scale, are free.
    same(render_splats(replace(cloud, quaternions=-cloud.quaternions), camera), expected)
    move = rng.integers(-20, 20, 3)
    pose = np.eye(4)
    pose[:3, 3] = -move
    moved = replace(camera, world_to_camera=camera.world_to_camera @ pose)
    same(render_splats(replace(cloud, means=cloud.means + move), moved), expected)
    limited = render_splats(cloud, camera, sh_degree=1)
    same(limited, render_splats(replace(cloud, sh=cloud.sh[:, :4]), camera, sh_degree=3))


@FEW
@given(seed=seeds, samples=st.sampled_from([2, 3, 4]))
def test_samples_are_the_pixels_of_a_larger_image(seed, samples):
    cloud, camera = random_splats(seed), random_camera()
    names = ("fx", "fy", "cx", "cy", "width", "height")
    large = replace(camera, **{name: samples * getattr(camera, name) for name in names})
    result = render_splats(cloud, camera, samples=samples)
    # The dilation is in pixels of the image, whatever the samples.
    expected = render_splats(cloud, large, dilation=0.3 * samples**2)
    fine = expected.color.reshape(11, samples, 13, samples, 3)
    np.testing.assert_allclose(result.color, fine.mean(axis=(1, 3)), atol=1e-12)


def test_bad_options_are_refused():
    camera = random_camera()
    for background in (0.5, np.zeros(4), np.zeros((13, 11, 3))):
        with pytest.raises(ValueError, match=r"background must have shape \(3,\) or \(11, 13, 3\)"):
            render_splats(one_splat(), camera, background=background)
    with pytest.raises(ValueError, match="dilation must be >= 0"):
        render_splats(one_splat(), camera, dilation=-1)
    with pytest.raises(ValueError, match="sh_degree must be a whole number from 0 on"):
        render_splats(one_splat(), camera, sh_degree=-1)
    with pytest.raises(ValueError, match="samples must be a whole number from 1 on"):
        render_splats(one_splat(), camera, samples=0)


def test_no_splats():
    empty = one_splat().take(np.zeros(1, bool))
    image = np.random.default_rng(0).random((11, 13, 3))
    result = render_splats(empty, random_camera(), background=image, samples=2)
    np.testing.assert_allclose(result.color, image, atol=1e-15)
    assert (result.alpha == 0).all()
    assert result.fragments == 0
