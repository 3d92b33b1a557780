"""convert: splats worked out by hand, counts, and what moving or renumbering the splats does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshsplats.conversion import convert
from meshsplats.conversion.fans import semi_axes
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import SH_C0, GaussianCloud
from meshsplats.scene.mesh import SplatMesh

HALF = 0.5**0.5


def one_splat(scales=(0.1, 0.2, 0.05), opacity=0.8, quaternion=(1, 0, 0, 0), kernel="3dgs") -> GaussianCloud:
    sh = (np.array([[[0.25, 0.5, 0.75]]]) - 0.5) / SH_C0
    return GaussianCloud([[1, 2, 3]], [quaternion], [scales], [opacity], sh, kernel)


def many(n: int, seed: int = 0, kernel: str = "3dgs") -> GaussianCloud:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return GaussianCloud(
        rng.normal(size=(n, 3)),
        quaternions,
        np.exp(rng.normal(size=(n, 3)) - 3),
        rng.uniform(0.02, 1, n),
        rng.normal(size=(n, 1, 3)),
        kernel,
    )


def corners_of(mesh: SplatMesh, splat: int) -> np.ndarray:
    """(k,) vertex numbers of one splat, ascending."""
    return np.unique(mesh.faces[mesh.face_splat == splat])


class TestPaper:
    def test_flat_fan_by_hand(self):
        mesh = convert(one_splat(), preset="paper")
        # The smallest scale is along z; 2.7 x (0.1, 0.2) = (0.27, 0.54), at 45 degrees each times cos 45.
        a, b = 0.27 * HALF, 0.54 * HALF
        expected = [
            (1, 2, 3),
            (0.73, 2, 3),
            (1 - a, 2 - b, 3),
            (1, 1.46, 3),
            (1 + a, 2 - b, 3),
            (1.27, 2, 3),
            (1 + a, 2 + b, 3),
            (1, 2.54, 3),
            (1 - a, 2 + b, 3),
        ]
        np.testing.assert_allclose(mesh.vertices, expected, atol=3e-7)
        fan = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5), (0, 5, 6), (0, 6, 7), (0, 7, 8), (0, 8, 1)]
        assert mesh.faces.tolist() == list(map(list, fan))
        np.testing.assert_allclose(mesh.colors[:, :3], np.tile([0.25, 0.5, 0.75], (9, 1)), atol=1e-6)
        np.testing.assert_allclose(mesh.colors[:, 3], [0.8] + [0.16] * 8, atol=1e-7)
        assert mesh.face_splat.tolist() == [0] * 8
        assert mesh.blending == "display"
        np.testing.assert_array_equal(mesh.up, [0, -1, 0])

    def test_three_ellipses_by_hand(self):
        mesh = convert(one_splat(), preset="paper", mode="3d", sides=4)
        # Four rim points an ellipse: the six points on the axes and the centre, nothing else.
        expected = [
            (1, 2, 3),
            (0.73, 2, 3),
            (1, 1.46, 3),
            (1.27, 2, 3),
            (1, 2.54, 3),
            (1, 2, 2.865),
            (1, 2, 3.135),
        ]
        np.testing.assert_allclose(mesh.vertices, expected, atol=3e-7)
        assert mesh.faces.tolist() == [
            [0, 1, 2],
            [0, 2, 3],
            [0, 3, 4],
            [0, 4, 1],
            [0, 2, 5],
            [0, 5, 4],
            [0, 4, 6],
            [0, 6, 2],
            [0, 1, 5],
            [0, 5, 3],
            [0, 3, 6],
            [0, 6, 1],
        ]

    def test_the_splat_is_turned(self):
        # A quarter turn about z: the splat's x axis points along the world's y.
        mesh = convert(one_splat(quaternion=(HALF, 0, 0, HALF)), preset="paper", sides=4)
        np.testing.assert_allclose(
            mesh.vertices - [1, 2, 3],
            [(0, 0, 0), (0, -0.27, 0), (0.54, 0, 0), (0, 0.27, 0), (-0.54, 0, 0)],
            atol=3e-7,
        )

    @pytest.mark.parametrize(
        ("scales", "kernel", "flat"),
        [
            ((0.1, 0.2, 0.05), "3dgs", 2),
            ((0.05, 0.2, 0.1), "3dgs", 0),
            ((0.1, 0.05, 0.2), "3dgs", 1),
            ((0.1, 0.2, 0.0), "2dgs", 2),
            ((0.01, 0.2, 0.05), "2dgs", 2),  # a 2DGS splat is flat along its third axis whatever is stored
        ],
    )
    def test_which_axis_is_dropped(self, scales, kernel, flat):
        mesh = convert(one_splat(scales, kernel=kernel), preset="paper")
        reach = np.abs(mesh.vertices - [1, 2, 3]).max(axis=0)
        expected = 2.7 * np.array(scales)
        expected[flat] = 0
        np.testing.assert_allclose(reach, expected, atol=3e-7)

    @pytest.mark.parametrize("sides", [3, 5, 8, 13])
    def test_counts_flat(self, sides):
        mesh = convert(many(7), preset="paper", sides=sides)
        assert (len(mesh.vertices), len(mesh.faces)) == (7 * (sides + 1), 7 * sides)

    @pytest.mark.parametrize("sides", [4, 8, 12, 20])
    def test_counts_3d(self, sides):
        mesh = convert(many(7), preset="paper", mode="3d", sides=sides)
        assert (len(mesh.vertices), len(mesh.faces)) == (7 * (3 * sides - 5), 7 * 3 * sides)
        for splat in range(7):
            assert len(np.unique(mesh.vertices[corners_of(mesh, splat)], axis=0)) == 3 * sides - 5

    def test_nothing_is_left_out(self):
        cloud = replace(many(3), opacities=[0, 0.001, 1], scales=[[0, 0, 0], [0, 0, 1], [1, 1, 1]])
        mesh = convert(cloud, preset="paper")
        assert len(mesh.vertices) == 27
        np.testing.assert_allclose(mesh.colors[::9, 3], [0, 0.001, 1])

    @pytest.mark.parametrize("mode", ["flat", "3d"])
    def test_cameras_change_nothing_but_up(self, mode):
        # Looks along -x from (5, 0, 0); the image's y axis, which points down, is the world's -z.
        camera = Camera([[0, 1, 0, 0], [0, 0, -1, 0], [-1, 0, 0, 5], [0, 0, 0, 1]], 64, 64, 32, 32, 64, 64)
        plain = convert(many(9), preset="paper", mode=mode)
        with_cameras = convert(many(9), preset="paper", mode=mode, cameras=[camera])
        np.testing.assert_array_equal(plain.vertices, with_cameras.vertices)
        np.testing.assert_array_equal(plain.colors, with_cameras.colors)
        np.testing.assert_allclose(with_cameras.up, [0, 0, 1], atol=1e-6)


class TestSemiAxes:
    # Multiples of the small numbers of axes, up to 6 times these counts, fit 8 or 16 bits, just do or do not.
    @pytest.mark.parametrize("count", [1, 14, 15, 21, 42, 43, 3_640, 3_641, 5_461, 8_192, 10_922, 10_923])
    def test_they_are_columns_of_the_rotation(self, count):
        cloud = many(count)
        order = np.random.default_rng(1).permuted(np.tile(np.arange(3, dtype=np.int8), (count, 1)), axis=1)
        sigma = np.take_along_axis(cloud.scales, order.astype(np.int64), axis=1)
        found = semi_axes(cloud.quaternions, order, sigma)
        for k in range(3):
            columns = cloud.rotations[np.arange(count), :, order[:, k]]
            np.testing.assert_allclose(found[k].T, columns * sigma[:, k, None], rtol=1e-5, atol=1e-6)


class TestEllipses:
    @given(
        seed=st.integers(0, 10**6),
        mode=st.sampled_from(["flat", "crossed", "3d"]),
        sides=st.sampled_from([4, 8, 12]),
        radius=st.floats(0.5, 4),
        rings=st.integers(1, 3),
    )
    def test_rim_lies_on_the_splat_ellipsoid(self, seed, mode, sides, radius, rings):
        cloud = many(20, seed)
        mesh = convert(
            cloud,
            mode=mode,
            sides=sides,
            rim_radius=radius,
            rings=rings,
            footprint="none",
            shrink_faint=False,
            min_opacity=0,
        )
        for splat in range(20):
            own = corners_of(mesh, splat)
            np.testing.assert_array_equal(own, np.arange(own[0], own[-1] + 1))
            offset = (mesh.vertices[own] - cloud.means[splat]).astype(np.float64)
            local = offset @ cloud.rotations[splat].astype(np.float64) / cloud.scales[splat]
            distance = np.linalg.norm(local, axis=1)
            assert distance[0] == 0
            rim = np.sort(distance)[-((len(own) - 1) // rings) :]
            np.testing.assert_allclose(rim, radius, rtol=2e-3)

    def test_winding_and_order(self):
        cloud = many(30, 3)
        for mode, per_ellipse in [("flat", 8), ("3d", 8), ("crossed", 4)]:
            mesh = convert(cloud, mode=mode, sides=per_ellipse, footprint="none")
            assert (np.diff(mesh.face_splat) >= 0).all()
            first = np.array([corners_of(mesh, splat)[0] for splat in np.unique(mesh.face_splat)])
            np.testing.assert_array_equal(np.unique(mesh.faces[:, 0]), first)  # one centre, listed first
            a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
            normal = np.cross(b - a, c - a)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            ellipses = normal.reshape(-1, per_ellipse, 3)
            np.testing.assert_allclose(np.einsum("ekx,ex->ek", ellipses, ellipses[:, 0]), 1, atol=1e-3)

    def test_flat_fan_faces_along_the_dropped_axis(self):
        cloud = many(30, 4)
        mesh = convert(cloud, preset="paper")
        a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        own = mesh.face_splat
        dropped = np.argmin(cloud.scales, axis=1)
        axis = cloud.rotations[own, :, dropped[own]]
        np.testing.assert_allclose(np.einsum("ij,ij->i", normal, axis), 1, atol=1e-3)

    def test_crossed_by_hand(self):
        mesh = convert(
            one_splat(), rim_radius=2, center_opacity=1, footprint="none", compensation=0, shrink_faint=False
        )
        # The longest axis is y, the next x: one ellipse in y-x, one in y-z; they meet in the points along y.
        expected = [
            (0, 0, 0),
            (0, -0.4, 0),
            (-0.2, 0, 0),
            (0, 0.4, 0),
            (0.2, 0, 0),
            (0, 0, -0.1),
            (0, 0, 0.1),
        ]
        np.testing.assert_allclose(mesh.vertices - [1, 2, 3], expected, atol=3e-7)
        fans = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1), (0, 1, 5), (0, 5, 3), (0, 3, 6), (0, 6, 1)]
        assert mesh.faces.tolist() == list(map(list, fans))
        np.testing.assert_allclose(mesh.colors[:, 3], [0.8] + [0] * 6, atol=1e-7)

    def test_a_very_flat_splat_gets_one_finer_ellipse(self):
        options = dict(mode="crossed", footprint="none", flat_below=0.3)
        # 0.05 / 0.1 is not flat enough, 0.02 / 0.1 is: the third scale against the second, not the first.
        assert len(convert(one_splat((0.1, 0.4, 0.05)), **options).vertices) == 7
        flat = convert(one_splat((0.1, 0.4, 0.02)), **options)
        assert (len(flat.vertices), len(flat.faces)) == (9, 8)
        np.testing.assert_allclose(flat.vertices[:, 2], 3)

    def test_rings_by_hand(self):
        mesh = convert(one_splat(), mode="flat", sides=3, rings=2, footprint="none")
        assert (len(mesh.vertices), len(mesh.faces)) == (7, 9)
        assert mesh.faces.tolist() == [
            [0, 1, 2],
            [0, 2, 3],
            [0, 3, 1],
            [1, 4, 5],
            [1, 5, 2],
            [2, 5, 6],
            [2, 6, 3],
            [3, 6, 4],
            [3, 4, 1],
        ]
        inner, outer = mesh.vertices[1:4] - mesh.vertices[0], mesh.vertices[4:] - mesh.vertices[0]
        ratio = np.linalg.norm(outer, axis=1) / np.linalg.norm(inner, axis=1)
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-5)
        assert ratio[0] > 1.2
        assert (mesh.colors[1:4, 3] > 0).all()
        assert (mesh.colors[4:, 3] == 0).all()

    def test_opacity_is_clamped(self):
        mesh = convert(one_splat(opacity=1), footprint="none", center_opacity=1.5, compensation=0)
        assert mesh.colors[:, 3].max() == 1


class TestInvariance:
    OPTIONS = (dict(preset="paper"), dict(preset="paper", mode="3d"), dict(footprint="none"), dict())

    @given(seed=st.integers(0, 10**6), which=st.integers(0, 3))
    def test_moving_the_cloud_moves_the_mesh(self, seed, which):
        rng = np.random.default_rng(seed)
        # The cameras of the framing are tied to the axes: state the distance instead.
        options = self.OPTIONS[which] if which < 3 else dict(viewing_distance=3.0)
        cloud = many(12, seed)
        w, x, y, z = turn = (q := rng.normal(size=4)) / np.linalg.norm(q)
        rotation = GaussianCloud(
            np.zeros((1, 3)), [turn], np.ones((1, 3)), [1], np.zeros((1, 1, 3))
        ).rotations[0]
        shift = rng.normal(size=3)
        a, b, c, d = cloud.quaternions.T.astype(np.float64)
        product = [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ]
        moved = replace(cloud, means=cloud.means @ rotation.T + shift, quaternions=np.stack(product, axis=1))
        before, after = convert(cloud, **options), convert(moved, **options)
        np.testing.assert_array_equal(before.faces, after.faces)
        np.testing.assert_allclose(before.vertices @ rotation.T + shift, after.vertices, atol=2e-5)
        np.testing.assert_allclose(before.colors, after.colors, atol=1e-6)

    @given(seed=st.integers(0, 10**6), which=st.integers(0, 3), power=st.integers(-8, 8))
    def test_scaling_the_cloud_scales_the_mesh(self, seed, which, power):
        cloud, factor = many(40, seed), np.float32(2.0**power)
        scaled = replace(cloud, means=cloud.means * factor, scales=cloud.scales * factor)
        before, after = convert(cloud, **self.OPTIONS[which]), convert(scaled, **self.OPTIONS[which])
        np.testing.assert_array_equal(before.faces, after.faces)
        np.testing.assert_allclose(before.vertices * factor, after.vertices, rtol=1e-5, atol=1e-5 * factor)
        np.testing.assert_allclose(before.colors, after.colors, atol=2e-6)

    @pytest.mark.slow
    @given(seed=st.integers(0, 10**6), which=st.integers(0, 3))
    def test_permuting_splats_permutes_fans(self, seed, which):
        cloud = many(40, seed)
        order = np.random.default_rng(seed).permutation(40)
        before, after = (
            convert(cloud, **self.OPTIONS[which]),
            convert(cloud.take(order), **self.OPTIONS[which]),
        )
        for place, splat in enumerate(order):
            old, new = corners_of(before, splat), corners_of(after, place)
            np.testing.assert_allclose(before.vertices[old], after.vertices[new], atol=1e-6)
            np.testing.assert_allclose(before.colors[old], after.colors[new], atol=1e-6)
            old_faces = before.faces[before.face_splat == splat] - old[0]
            np.testing.assert_array_equal(old_faces, after.faces[after.face_splat == place] - new[0])

    def test_chunks_do_not_show(self, monkeypatch):
        from meshsplats.conversion import fans

        cloud = many(50)
        whole = convert(cloud, footprint="none", flat_below=0.5)
        assert len({int((whole.face_splat == i).sum()) for i in range(50)}) == 1
        assert len({len(corners_of(whole, i)) for i in range(50)}) == 2  # both shapes, mixed
        monkeypatch.setattr(fans, "CHUNK", 7)
        parts = convert(cloud, footprint="none", flat_below=0.5)
        np.testing.assert_array_equal(whole.faces, parts.faces)
        np.testing.assert_allclose(whole.vertices, parts.vertices, atol=1e-6)
        np.testing.assert_array_equal(whole.colors, parts.colors)
