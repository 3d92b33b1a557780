"""Pixel sizes at the splats, the filter of that size, opacity of crossed ellipses, mean colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshsplats._common.geometry import spacing
from meshsplats.cameras.trajectories import look_at, orbit
from meshsplats.conversion import convert
from meshsplats.conversion import footprint as module
from meshsplats.conversion.footprint import CameraCoverage
from meshsplats.conversion.selection import disc_areas, mean_shadow
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import SH_C0, GaussianCloud
from meshsplats.scene.mesh import SplatMesh


def cloud_at(means, scale=0.1, opacity=0.5, kernel="3dgs", scales=None) -> GaussianCloud:
    n = len(means)
    scales = np.full((n, 3), scale) if scales is None else np.broadcast_to(scales, (n, 3))
    return GaussianCloud(means, [[1, 0, 0, 0]] * n, scales, [opacity] * n, np.zeros((n, 1, 3)), kernel)


def ahead(focal=100.0, z=0.0, size=64) -> Camera:
    """At (0, 0, z), looking along +z."""
    matrix = np.eye(4)
    matrix[2, 3] = -z
    return Camera(matrix, focal, focal, size / 2, size / 2, size, size)


def reach(mesh: SplatMesh) -> np.ndarray:
    return (mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)) / 2


def grid(side: int, size: float = 1.0) -> GaussianCloud:
    """``side`` x ``side`` small splats, ``size`` apart on a plane."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    return cloud_at(size * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), 1e-4 * size)


def reaches(mesh: SplatMesh, cloud: GaussianCloud) -> np.ndarray:
    """(n, 8) how far the rim of each flat fan is from its centre."""
    return np.linalg.norm(mesh.vertices.reshape(-1, 9, 3)[:, 1:] - cloud.means[:, None], axis=2)


FLAT = dict(mode="flat", rim_radius=1.0, center_opacity=1.0, compensation=0.0, shrink_faint=False)


class TestPixelSize:
    def test_one_camera(self):
        sizes = CameraCoverage(
            np.float32([[0, 0, 10], [3, 0, 4], [0, 0, 5]]), [ahead(size=200)]
        ).pixel_sizes()
        np.testing.assert_allclose(sizes, [0.1, 0.05, 0.05], rtol=1e-6)

    def test_unequal_focal_lengths(self):
        camera = Camera(np.eye(4), 50, 200, 32, 32, 64, 64)
        np.testing.assert_allclose(
            CameraCoverage(np.float32([[0, 0, 10]]), [camera]).pixel_sizes(), [0.1], rtol=1e-6
        )

    def test_near_views_count_for_more(self):
        # Distances 1 and 2: the mean of 1 and 1/4 is 5/8.
        cameras = [ahead(z=4), ahead(z=3)]
        sizes = CameraCoverage(np.float32([[0, 0, 5]]), cameras).pixel_sizes()
        np.testing.assert_allclose(sizes, [(8 / 5) ** 0.5 / 100], rtol=1e-6)

    @pytest.mark.parametrize(
        ("position", "seen"),
        [
            ((0, 0, 1), True),
            ((0, 0, -1), False),  # behind
            ((0, 0, 0.25), False),  # nearer than the near plane
            ((0.31, 0.31, 1), True),  # 31 pixels from the centre of 64
            ((0.33, 0, 1), False),
            ((-0.33, 0, 1), False),
            ((0, 0.33, 1), False),
            ((0, -0.33, 1), False),
        ],
    )
    def test_what_a_camera_sees(self, position, seen):
        assert (
            CameraCoverage(np.float32([position]), [replace(ahead(), near=0.3)]).pixel_sizes()[0] > 0
        ) == seen

    def test_principal_point(self):
        camera = Camera(np.eye(4), 100, 100, 0, 64, 64, 64)  # sees what is right of and above its axis
        sizes = CameraCoverage(
            np.float32([[0.5, -0.5, 1], [-0.1, -0.1, 1], [0.1, 0.1, 1]]), [camera]
        ).pixel_sizes()
        assert (sizes > 0).tolist() == [True, False, False]

    def test_unseen_splats_take_the_median(self):
        cloud = cloud_at([[0, 0, 1], [0, 0, 2], [0, 0, 4], [0, 0, -9]])
        mesh = convert(cloud, cameras=[ahead()], footprint_px2=100, **FLAT)
        wide = [
            reach(convert(cloud.take([i]), cameras=[ahead()], footprint_px2=100, **FLAT))[1] for i in range(3)
        ]
        assert len(mesh.vertices) == 36
        assert reach(mesh.take(mesh.face_splat == 3))[1] == pytest.approx(wide[1], rel=1e-5)

    def test_far_from_the_origin(self):
        near, far = np.float32([[0.2, 0.1, 5]]), np.array([1e4, -2e4, 3e4])
        matrix = np.eye(4)
        matrix[:3, 3] = -far
        camera = Camera(matrix, 100, 100, 32, 32, 64, 64)
        there = CameraCoverage((near + far).astype(np.float32), [camera]).pixel_sizes()
        np.testing.assert_allclose(there, CameraCoverage(near, [ahead()]).pixel_sizes(), rtol=1e-3)

    def test_many_cameras_are_thinned(self):
        cameras = [ahead(z=-i) for i in range(module.MAX_CAMERAS + 1)] * 3
        views = CameraCoverage(np.float32([[0, 0, 9]]), cameras)
        assert len(views.cameras) == module.MAX_CAMERAS
        assert views.cameras[0] is cameras[0]
        assert views.cameras[-1] is cameras[-1]

    def test_chunks_do_not_show(self, monkeypatch):
        means = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32) + np.float32([0, 0, 5])
        whole = CameraCoverage(means, [ahead(), ahead(z=1)]).pixel_sizes()
        monkeypatch.setattr(module, "_CHUNK", 7)
        np.testing.assert_allclose(
            CameraCoverage(means, [ahead(), ahead(z=1)]).pixel_sizes(), whole, rtol=1e-6
        )

    def test_no_splat_seen(self):
        with pytest.raises(ValueError, match="none of the 1 cameras sees any of the 2 splats"):
            convert(cloud_at([[0, 0, -1], [0, 0, -2]]), cameras=[ahead()])


class TestFilter:
    def test_3dgs_adds_variances(self):
        # A pixel is 0.1 at distance 10 with a focal length of 100: 0.3^2 + 16 * 0.1^2 = 0.5^2.
        mesh = convert(cloud_at([[0, 0, 10]], 0.3), cameras=[ahead()], footprint_px2=16, **FLAT)
        np.testing.assert_allclose(np.sort(reach(mesh)), [0, 0.5, 0.5], rtol=1e-6)

    @pytest.mark.parametrize(("scale", "expected"), [(0.3, 0.4), (0.5, 0.5)])
    def test_2dgs_takes_the_larger(self, scale, expected):
        cloud = cloud_at([[0, 0, 10]], kernel="2dgs", scales=(scale, scale, 0))
        mesh = convert(cloud, cameras=[ahead()], footprint_px2=16, **FLAT)
        np.testing.assert_allclose(reach(mesh), [expected, expected, 0], rtol=1e-6)

    def test_distance(self):
        cloud = cloud_at([[0, 0, 10], [7, 8, 9]], 0.3)
        mesh = convert(cloud, viewing_distance=20, focal=200, footprint_px2=16, **FLAT)
        for splat in range(2):
            np.testing.assert_allclose(
                np.sort(reach(mesh.take(mesh.face_splat == splat))), [0, 0.5, 0.5], atol=1e-6
            )
        # A stated distance comes before the cameras.
        both = convert(
            cloud, viewing_distance=20, focal=200, footprint_px2=16, cameras=[ahead(focal=9)], **FLAT
        )
        np.testing.assert_array_equal(both.vertices, mesh.vertices)

    def test_none_and_zero(self):
        cloud = cloud_at([[0, 0, 10]], 0.3)
        for options in (dict(footprint="none"), dict(footprint_px2=0, cameras=[ahead()])):
            np.testing.assert_allclose(
                np.sort(reach(convert(cloud, **options, **FLAT))), [0, 0.3, 0.3], rtol=1e-6
            )

    def test_antialiased_keeps_the_integral(self):
        """Its opacity falls as the area grows: a disc of 0.3 that becomes one of 0.5 has 9/25 of it."""
        cloud = cloud_at([[0, 0, 10]], kernel="antialiased", scales=(0.3, 0.3, 0.3))
        mesh = convert(cloud, cameras=[ahead()], footprint_px2=16, **FLAT)
        assert mesh.colors[0, 3] == pytest.approx(0.5 * 9 / 25, rel=1e-5)
        smaller = convert(cloud, cameras=[ahead()], footprint_px2=16, **{**FLAT, "shrink_faint": True})
        assert smaller.colors[0, 3] == pytest.approx(0.5 * 9 / 25, rel=1e-5)
        plain = convert(cloud, footprint="none", **FLAT)
        assert plain.colors[0, 3] == pytest.approx(0.5)


class TestSpacing:
    @pytest.mark.parametrize("side", [0.01, 1.0, 30.0])
    def test_grid_on_a_plane(self, side):
        """Points a distance ``side`` apart on a plane: that distance, up to where cells cut the grid."""
        x, y = np.meshgrid(np.arange(64), np.arange(64))
        points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32) * np.float32(side)
        np.testing.assert_allclose(spacing(points) / side, 1, atol=0.35)

    def test_sparse_and_dense(self):
        rng = np.random.default_rng(1)
        dense, sparse = rng.random((4000, 3)), 10 * rng.random((4000, 3)) + [20, 0, 0]
        dense[:, 2] = sparse[:, 2] = 0
        found = spacing(np.concatenate([dense, sparse]).astype(np.float32))
        assert np.median(found[4000:]) / np.median(found[:4000]) == pytest.approx(10, rel=0.3)

    def test_degenerate(self):
        assert spacing(np.ones((1, 3), np.float32)).tolist() == [0]
        assert spacing(np.ones((5, 3), np.float32)).tolist() == [0] * 5
        few = spacing(np.float32([[0, 0, 0], [4, 0, 0], [4, 2, 0]]))
        np.testing.assert_allclose(few, 4 / 3**0.5, rtol=1e-6)
        many = np.concatenate([np.zeros((50, 3)), np.ones((50, 3))]).astype(np.float32)
        np.testing.assert_allclose(spacing(many), 2**-20 / 50**0.5, rtol=1e-6)

    @given(seed=st.integers(0, 10**6))
    def test_order_does_not_matter(self, seed):
        rng = np.random.default_rng(seed)
        points = rng.normal(size=(60, 3)).astype(np.float32)
        order = rng.permutation(60)
        np.testing.assert_array_equal(spacing(points)[order], spacing(points[order]))


class TestFraming:
    def test_pixel_of_an_image_that_holds_the_subject(self):
        """Sparse splats: as if given the cameras of such images."""
        cloud = grid(16)
        cameras = orbit(
            cloud, module.FRAMING_VIEWS, width=module.FRAMING_PIXELS, height=module.FRAMING_PIXELS
        )
        framed = reaches(convert(cloud, footprint_px2=1, **FLAT), cloud)
        given = reaches(convert(cloud, footprint_px2=1, cameras=cameras, **FLAT), cloud)
        np.testing.assert_allclose(framed, given, rtol=1e-5)
        # 16 units on 1000 pixels, and some room round them.
        assert 0.016 < np.median(framed) < 0.04

    @pytest.mark.parametrize("sample", [10**6, 5000])
    def test_dense_splats_need_finer_pixels(self, sample, monkeypatch):
        monkeypatch.setattr(module, "SAMPLE", sample)
        monkeypatch.setattr(module, "FRAMING_PIXELS", 50)
        cloud = grid(128)
        found = reaches(convert(cloud, footprint_px2=1, **FLAT), cloud)
        np.testing.assert_allclose(found, module.FRAMING_SPACING, rtol=0.3)

    def test_size_of_the_scene_does_not_matter(self):
        for size in (1e-6, 1.0, 1e6):
            cloud = grid(16, size)
            found = reaches(convert(cloud, footprint_px2=1, **FLAT), cloud) / size
            assert 0.016 < np.median(found) < 0.04, size

    def test_splats_in_one_spot(self):
        cloud = cloud_at([[1, 2, 3]] * 20, 0.1)
        assert np.isfinite(convert(cloud).vertices).all()
        with_nothing = replace(cloud, scales=np.zeros((20, 3)), opacities=np.full(20, 1.0))
        assert np.isfinite(convert(with_nothing).vertices).all()


class TestCompensation:
    @given(a=st.floats(0.01, 1), b=st.floats(0.01, 1), c=st.floats(0.01, 1))
    def test_mean_shadow(self, a, b, c):
        """Against the mean over directions of the exact projection, from the covariance itself."""
        i = np.arange(4000) + 0.5
        z, turn = 1 - 2 * i / 4000, np.pi * (1 + 5**0.5) * i
        v = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
        covariance = np.diag([a * a, b * b, c * c])
        # The determinant of the covariance projected along v is v^T adj(covariance) v.
        adjugate = np.linalg.det(covariance) * np.linalg.inv(covariance)
        exact = np.sqrt(np.einsum("ni,ij,nj->n", v, adjugate, v)).mean()
        found = mean_shadow(disc_areas(np.array([[a, b, c]])))[0]
        assert found == pytest.approx(exact, rel=0.012)

    @pytest.mark.parametrize(
        ("mode", "scales", "factor"),
        [
            ("3d", (1, 1, 1), 1 / 1.5),  # three discs show 1.5 times a ball's shadow
            ("crossed", (1, 1, 1), 1.0),  # two discs exactly as much
            ("flat", (1, 1, 1), 2.0),  # one disc half of it
            ("flat", (1, 1, 0), 1.0),
            ("3d", (1, 1, 0), 1.0),
        ],
    )
    def test_factors(self, mode, scales, factor):
        cloud = cloud_at([[0, 0, 0]], opacity=0.2, scales=scales)
        options = dict(mode=mode, footprint="none", center_opacity=1, rim_radius=2, sides=8)
        mesh = convert(cloud, **options)
        assert mesh.colors[0, 3] == pytest.approx(0.2 * factor, rel=0.015)
        half = convert(cloud, **options, compensation=0.5)
        assert half.colors[0, 3] == pytest.approx(0.2 * factor**0.5, rel=0.01)
        off = convert(cloud, **options, compensation=0)
        assert off.colors[0, 3] == pytest.approx(0.2)


class TestColors:
    def sh_cloud(self) -> GaussianCloud:
        sh = np.zeros((1, 4, 3))
        sh[0, 2, 0] = 0.5  # red grows with z
        sh[0, 3, 1] = -0.5  # green grows with x
        sh[0, 0, 2] = 0.5
        return replace(cloud_at([[0, 0, 0]]), sh=sh)

    def test_one_camera_by_hand(self):
        camera = look_at((0, 0, -5), (0, 0, 0))  # looks along +z
        c1 = (3 / (4 * np.pi)) ** 0.5
        mesh = convert(self.sh_cloud(), cameras=[camera], colors="mean")
        np.testing.assert_allclose(
            mesh.colors[:, :3],
            np.tile([0.5 + 0.5 * c1, 0.5, 0.5 + 0.5 * SH_C0], (len(mesh.vertices), 1)),
            atol=1e-6,
        )
        plain = convert(self.sh_cloud(), cameras=[camera])
        np.testing.assert_allclose(plain.colors[0, :3], [0.5, 0.5, 0.5 + 0.5 * SH_C0], atol=1e-6)

    def test_near_views_count_for_more(self):
        # From -z at distance 1 (weight 1) and from -x at distance 2 (weight 1/4).
        cameras = [look_at((0, 0, -1), (0, 0, 0)), look_at((-2, 0, 0), (0, 0, 0))]
        c1 = (3 / (4 * np.pi)) ** 0.5
        mesh = convert(self.sh_cloud(), cameras=cameras, colors="mean")
        expected = [0.5 + 0.8 * 0.5 * c1, 0.5 + 0.2 * 0.5 * c1, 0.5 + 0.5 * SH_C0]
        np.testing.assert_allclose(mesh.colors[0, :3], expected, atol=1e-6)

    def test_unseen_splats_keep_degree_0(self):
        cloud = GaussianCloud(
            [[0, 0, 0], [0, 0, -10]],
            [[1, 0, 0, 0]] * 2,
            np.full((2, 3), 0.1),
            [0.5] * 2,
            np.repeat(self.sh_cloud().sh, 2, axis=0),
        )
        mesh = convert(cloud, cameras=[look_at((0, 0, -5), (0, 0, 0))], colors="mean")
        np.testing.assert_allclose(mesh.colors[-1, :3], [0.5, 0.5, 0.5 + 0.5 * SH_C0], atol=1e-6)
        assert mesh.colors[0, 0] > 0.7

    def test_clipped_after_the_mean(self):
        cloud = self.sh_cloud()
        strong = replace(cloud, sh=cloud.sh * np.float32(4))  # red from one side 1.48, from the other -0.48
        cameras = [look_at((0, 0, -1), (0, 0, 0)), look_at((0, 0, 1), (0, 0, 0))]
        mesh = convert(strong, cameras=cameras, colors="mean")
        np.testing.assert_allclose(mesh.colors[0, :3], [0.5, 0.5, 1.0], atol=1e-6)
        one = convert(strong, cameras=cameras[:1], colors="mean")
        assert one.colors[0, 0] == 1
