"""simplify: moments by hand, laws of merging, the core's search and its greedy order against slow twins."""

from __future__ import annotations

import time
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from _local import shared_data
from hypothesis import given
from hypothesis import strategies as st

from meshsplats import GaussianCloud, convert, load_gaussians, orbit, psnr, render, render_splats, simplify
from meshsplats._core.neighbours import nearest
from meshsplats._core.structures import MergingStruct
from meshsplats.cameras.trajectories import look_at
from meshsplats.conversion import ConversionOptions, merging, merging_groups, merging_weights
from meshsplats.conversion.budget import within_limits
from meshsplats.conversion.footprint import CameraCoverage
from meshsplats.conversion.merging import (
    FEWEST_OF_BLOCK,
    MERGED_OPAQUE,
    opacity_of,
    optical_depth,
    simplify_in_blocks,
)
from meshsplats.conversion.merging_groups import Moments, clumps
from meshsplats.conversion.merging_weights import AROUND, ELSEWHERE, HIDDEN, pixels_of
from meshsplats.conversion.selection import disc_areas, mean_shadow
from meshsplats.demo_scene import make_scene
from meshsplats.demo_scene.room import MIDDLE, make_room


def random_cloud(n, seed=0, degree=0, kernel="3dgs"):
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(n, 4))
    return GaussianCloud(
        rng.normal(size=(n, 3)),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        np.exp(rng.normal(-2.5, 0.6, (n, 3))),
        rng.uniform(0.05, 0.6, n),
        rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.4,
        kernel=kernel,
    )


def masses(cloud, low_pass=0.0):
    widened = np.sqrt(cloud.scales.astype(np.float64) ** 2 + np.square(low_pass)[..., None])
    return optical_depth(cloud.opacities) * mean_shadow(disc_areas(widened))


def covariances(cloud):
    axes = cloud.rotations.astype(np.float64) * cloud.scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def moments(cloud, low_pass=0.0):
    """Mass, mean and covariance of a whole cloud."""
    m = masses(cloud, low_pass)
    mean = np.average(cloud.means.astype(np.float64), axis=0, weights=m)
    apart = cloud.means - mean
    spread = covariances(cloud) + apart[:, :, None] * apart[:, None, :]
    return m.sum(), mean, np.average(spread, axis=0, weights=m)


def pair(**changes):
    """Two round splats on the x axis."""
    fields = dict(
        means=[[0, 0, 0], [3, 0, 0]],
        quaternions=[[1, 0, 0, 0], [1, 0, 0, 0]],
        scales=[[1, 1, 1], [2, 2, 2]],
        opacities=[0.5, 0.125],
        sh=[[[1, 0, 0]], [[0, 1, 0]]],
    )
    return GaussianCloud(**(fields | changes))


class TestByHand:
    def test_two_splats(self):
        # Masses Li2(0.5) x 1 and Li2(0.125) x 4. Li2(1/2) = pi^2 / 12 - ln(2)^2 / 2.
        a = np.pi**2 / 12 - np.log(2) ** 2 / 2
        b = 4 * sum(0.125**k / k**2 for k in range(1, 30))
        share = b / (a + b)
        one = simplify(pair(), 1, low_pass=0)
        assert len(one) == 1
        np.testing.assert_allclose(one.means[0], [3 * share, 0, 0], rtol=1e-6)
        np.testing.assert_allclose(one.sh[0, 0], [1 - share, share, 0], rtol=1e-6)
        across = (1 - share) * 1 + share * 4
        along = across + share * (1 - share) * 9
        np.testing.assert_allclose(
            covariances(one)[0], np.diag([along, across, across]), rtol=1e-5, atol=1e-6
        )
        area = mean_shadow(disc_areas(np.sqrt([[along, across, across]])))[0]
        assert optical_depth(one.opacities)[0] * area == pytest.approx(a + b, rel=1e-4)

    def test_the_low_pass_counts_as_area(self):
        # 3DGS widens without dimming: what is drawn of the first is sqrt(1 + 3)^2 = 4 times as much.
        cloud = pair(scales=[[1, 1, 1], [1, 1, 1]], opacities=[0.25, 0.25])
        one = simplify(cloud, 1, low_pass=np.array([np.sqrt(3), 0]))
        np.testing.assert_allclose(one.means[0, 0], 3 / 5, rtol=1e-6)
        thin = replace(cloud, kernel="antialiased")  # that dims by as much
        np.testing.assert_allclose(simplify(thin, 1, low_pass=np.array([9.0, 0])).means[0, 0], 1.5, rtol=1e-6)

    def test_identical_splats_become_one(self):
        cloud = random_cloud(1).take(np.zeros(7, int))
        cloud = replace(cloud, opacities=np.full(7, 0.02))
        one = simplify(cloud, 1, low_pass=0.1)
        np.testing.assert_allclose(one.means, cloud.means[:1], rtol=1e-6)
        np.testing.assert_allclose(np.sort(one.scales[0]), np.sort(cloud.scales[0]), rtol=1e-5)
        np.testing.assert_allclose(covariances(one), covariances(cloud)[:1], rtol=1e-4, atol=1e-8)
        # Seven layers, one behind the other.
        assert one.opacities[0] == pytest.approx(opacity_of(7 * optical_depth(0.02)), rel=1e-5)
        assert one.opacities[0] == pytest.approx(1 - (1 - 0.02) ** 7, rel=0.05)

    def test_what_is_alike_goes_first(self):
        # Three pairs: as near and of one colour, as near and of two, farther and of one.
        cloud = GaussianCloud(
            [[0, 0, 0], [0.5, 0, 0], [20, 0, 0], [20.5, 0, 0], [40, 0, 0], [41, 0, 0]],
            [[1, 0, 0, 0]] * 6,
            [[1, 1, 1]] * 6,
            [0.5] * 6,
            np.array([[1, 1, 1], [1, 1, 1], [1, 1, 1], [-1, 0, 1], [1, 1, 1], [1, 1, 1]])[:, None],
        )
        left = [simplify(cloud, n, low_pass=0).means[:, 0].round(2).tolist() for n in (5, 4, 3)]
        assert left[0] == [0.25, 20, 20.5, 40, 41]
        assert left[1] == [0.25, 20, 20.5, 40.5]
        assert left[2] == [0.25, 20.25, 40.5]

    def test_many_opaque_layers_are_one(self):
        cloud = random_cloud(1).take(np.zeros(50, int))
        one = simplify(replace(cloud, opacities=np.ones(50)), 1, low_pass=0)
        assert one.opacities[0] == MERGED_OPAQUE
        np.testing.assert_allclose(one.means, cloud.means[:1], rtol=1e-6)

    def test_what_is_never_drawn_has_no_mass(self):
        cloud = pair(opacities=[0.5, 0.0039])
        one = simplify(cloud, 1, low_pass=0.2)
        np.testing.assert_allclose(one.means[0], 0, atol=1e-12)
        assert one.opacities[0] == pytest.approx(0.5, abs=1e-5)

    def test_surfels_stay_flat(self):
        cloud = random_cloud(60, kernel="2dgs")
        cloud = replace(cloud, scales=cloud.scales * np.array([1, 1, 0], np.float32))
        few = simplify(cloud, 9, low_pass=0)
        assert few.kernel == "2dgs"
        assert not few.scales[:, 2].any()
        assert (few.scales[:, 1] > 0).all()
        # Two side by side in one plane are a longer one in it.
        flat = pair(scales=[[1, 1, 0], [1, 1, 0]], opacities=[0.5, 0.5], kernel="2dgs")
        one = simplify(flat, 1, low_pass=0)
        np.testing.assert_allclose(one.scales[0], [np.sqrt(1 + 9 / 4), 1, 0], rtol=1e-6)
        np.testing.assert_allclose(np.abs(one.rotations[0, :, 2]), [0, 0, 1], atol=1e-6)


class TestLaws:
    @given(st.integers(2, 60), st.integers(0, 10_000), st.floats(0, 0.5), st.integers(0, 3))
    def test_mass_mean_covariance_and_colour_are_kept(self, n, seed, low_pass, degree):
        cloud = random_cloud(n, seed, degree)
        cloud = replace(cloud, opacities=cloud.opacities * np.float32(0.1) + np.float32(0.004))
        count = 1 + seed % n
        few = simplify(cloud, count, low_pass=low_pass)
        assert len(few) == min(count, n)
        assert few.sh_degree == degree
        assert few.opacities.max() < 0.99  # nothing is lost in one that is opaque
        for a, b in zip(moments(cloud, low_pass), moments(few, low_pass), strict=True):
            np.testing.assert_allclose(b, a, rtol=2e-4, atol=2e-5)
        before = np.average(cloud.sh.reshape(n, -1), axis=0, weights=masses(cloud, low_pass))
        after = np.average(few.sh.reshape(len(few), -1), axis=0, weights=masses(few, low_pass))
        np.testing.assert_allclose(after, before, rtol=2e-4, atol=2e-5)

    @given(st.integers(0, 10_000))
    def test_moved_turned_and_scaled_splats_give_moved_turned_and_scaled_results(self, seed):

        rng = np.random.default_rng(seed)
        cloud = random_cloud(40, seed)
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        size, shift = float(np.exp(rng.normal())), rng.normal(size=3)
        moved = cloud.transformed(turn)
        moved = replace(moved, means=moved.means * size + shift, scales=moved.scales * size)
        few = simplify(cloud, 12, low_pass=0.05)
        same = simplify(moved, 12, low_pass=0.05 * size)
        np.testing.assert_allclose(same.means, few.means @ turn.T * size + shift, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(same.opacities, few.opacities, rtol=1e-3)
        expected = size**2 * (turn @ covariances(few) @ turn.T)
        np.testing.assert_allclose(covariances(same), expected, rtol=1e-3, atol=1e-5 * expected.max())

    @given(st.integers(0, 10_000))
    def test_the_order_of_splats_does_not_matter(self, seed):
        cloud = random_cloud(50, seed)
        shuffled = np.random.default_rng(seed).permutation(50)
        a, b = simplify(cloud, 15, low_pass=0.1), simplify(cloud.take(shuffled), 15, low_pass=0.1)
        a, b = (c.take(np.lexsort(c.means.T)) for c in (a, b))
        np.testing.assert_allclose(a.means, b.means, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(a.opacities, b.opacities, rtol=1e-5)

    def test_the_same_bits_with_any_number_of_threads(self):
        cloud = make_scene(6000)
        one, more = (simplify(cloud, 1500, threads=n) for n in (1, 5))
        for name in ("means", "quaternions", "scales", "opacities", "sh"):
            np.testing.assert_array_equal(getattr(one, name), getattr(more, name))

    def test_what_was_not_merged_keeps_its_bits_and_the_order(self):
        cloud = random_cloud(200, degree=1)
        few = simplify(cloud, 150, low_pass=0.02)
        rows = [np.flatnonzero((cloud.means == m).all(axis=1)) for m in few.means]
        kept = np.array([i for i, found in enumerate(rows) if len(found)])
        assert len(kept) >= 100
        numbers = np.concatenate([rows[i] for i in kept])
        assert (np.diff(numbers) > 0).all()
        for name in ("quaternions", "scales", "opacities", "sh"):
            np.testing.assert_array_equal(getattr(few, name)[kept], getattr(cloud, name)[numbers])

    def test_as_many_as_there_are(self):
        cloud = random_cloud(5)
        assert simplify(cloud, 5) is cloud
        assert simplify(cloud, 99) is cloud

    @pytest.mark.parametrize("count", [1, 2, 3, 31])
    def test_parts_that_are_no_neighbours_of_each_other(self, count):
        clusters = [
            replace(random_cloud(30, seed), means=random_cloud(30, seed).means + 1e4 * seed)
            for seed in range(4)
        ]
        cloud = GaussianCloud(
            *(
                np.concatenate([getattr(c, n) for c in clusters])
                for n in ("means", "quaternions", "scales", "opacities", "sh")
            )
        )
        assert len(simplify(cloud, count, low_pass=0.01)) == count


class TestTwins:
    @given(st.integers(2, 80), st.integers(1, 12), st.integers(0, 10_000), st.booleans())
    def test_nearest(self, n, count, seed, on_a_grid):
        rng = np.random.default_rng(seed)
        points = rng.normal(size=(n, 3)) * [1, 1e-3, 100]
        if on_a_grid:  # many are as near, and some the same
            points = rng.integers(0, 3, (n, 3)).astype(float)
        count = min(count, n - 1)
        order, found = nearest(points, count)
        assert sorted(order) == list(range(n))
        placed = points[order]
        apart = ((placed[:, None] - placed[None]) ** 2).sum(axis=2)
        np.fill_diagonal(apart, np.inf)
        np.testing.assert_array_equal(found, np.argsort(apart, axis=1, kind="stable")[:, :count])

    def test_nearest_of_equal_points(self):
        """Which once took a time that grew with the square of their number."""
        points = np.repeat([[0.0, 1, 2], [0, 1, 3]], 20_000, axis=0)
        start = time.process_time()
        order, found = nearest(points, 3, threads=1)
        assert time.process_time() - start < 2
        np.testing.assert_array_equal(points[order], points)
        assert (found[[0, 1, 2, 9, 19_999]] == [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2], [0, 1, 2]]).all()
        assert (found[20_003:] == [20_000, 20_001, 20_002]).all()

    def test_nearest_of_many(self):
        points = make_scene(20_000).means.astype(np.float64)
        order, found = nearest(points, 8)
        placed = points[order]
        for row in range(0, len(points), 997):
            apart = ((placed - placed[row]) ** 2).sum(axis=1)
            apart[row] = np.inf
            np.testing.assert_array_equal(apart[found[row]], np.sort(apart)[:8])

    @pytest.mark.parametrize("seed", range(8))
    def test_always_the_cheapest_pair(self, seed):
        """Of nine splats, all are neighbours: the core against a search through all pairs."""
        rng = np.random.default_rng(seed)
        n = 9
        half = rng.normal(size=(n, 3, 3)) * 0.3
        means, spread = rng.normal(size=(n, 3)), half @ half.transpose(0, 2, 1) + 0.1 * np.eye(3)
        mass, colors = rng.uniform(0.1, 2, n), rng.uniform(0, 1, (n, 3))
        upper = spread[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        for wanted in (6, 3, 1):
            group, left = merging_groups._merge_neighbours(Moments(means, upper, mass, colors), wanted, 1)
            assert left == wanted
            members = {frozenset(np.flatnonzero(group == g)) for g in range(left)}
            assert members == greedy(means, spread, mass, colors, wanted)

    def test_neighbours_are_checked(self):
        points = np.zeros((4, 3))
        wrong = np.full((4, 2), 9, np.int32)
        found = np.empty(4, np.int32)
        zeros = np.zeros((4, 6))
        with pytest.raises(ValueError, match="neighbour 9 of 0 is not another of 4"):
            merging_groups.run(
                "ms_merge_pairs",
                MergingStruct(
                    count=4,
                    wanted=1,
                    neighbours=2,
                    threads=1,
                    means=merging_groups.pointer(points),
                    covariances=merging_groups.pointer(zeros),
                    masses=merging_groups.pointer(zeros),
                    colors=merging_groups.pointer(points),
                    nearest=merging_groups.pointer(wrong),
                    color_weight=1.0,
                    group=merging_groups.pointer(found),
                ),
            )


def greedy(means, spread, mass, colors, wanted):
    """Sets of members after merging the pair of least cost, again and again."""
    parts = [
        (frozenset([i]), m, s, w, c)
        for i, (m, s, w, c) in enumerate(zip(means, spread, mass, colors, strict=True))
    ]

    def together(a, b):
        share = b[3] / (a[3] + b[3])
        apart = b[1] - a[1]
        s = (1 - share) * a[2] + share * b[2] + share * (1 - share) * np.outer(apart, apart)
        return (a[0] | b[0], a[1] + share * apart, s, a[3] + b[3], (1 - share) * a[4] + share * b[4])

    def log_area(s):
        return 0.5 * np.log((np.trace(s) ** 2 - np.trace(s @ s)) / 2)

    def cost(a, b):
        c = together(a, b)
        spent = c[3] * log_area(c[2]) - a[3] * log_area(a[2]) - b[3] * log_area(b[2])
        return spent + a[3] * b[3] / c[3] * np.sum((a[4] - b[4]) ** 2)

    while len(parts) > wanted:
        pairs = [(cost(a, b), i, j) for i, a in enumerate(parts) for j, b in enumerate(parts[:i])]
        _, i, j = min(pairs)
        parts = [p for k, p in enumerate(parts) if k not in (i, j)] + [together(parts[i], parts[j])]
    return {p[0] for p in parts}


class TestHostile:
    @given(st.integers(0, 10_000))
    def test_any_valid_cloud(self, seed):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 40))
        cloud = random_cloud(n, seed)
        some = rng.random((4, n)) < 0.3
        cloud = replace(
            cloud,
            scales=np.where(some[0][:, None], 0, cloud.scales) * np.where(some[1][:, None], [1, 1, 0], 1),
            opacities=np.where(some[2], rng.integers(0, 2, n), cloud.opacities),
            means=np.where(some[3][:, None], cloud.means[:1], cloud.means),
        )
        for low_pass in (None, 0, 0.1):
            assert len(simplify(cloud, 1 + n // 3, low_pass=low_pass)) == 1 + n // 3

    @pytest.mark.parametrize("size", [1e-12, 1e12])
    @pytest.mark.parametrize("low_pass", [None, 0])
    def test_tiny_and_huge_scenes(self, size, low_pass):
        cloud = random_cloud(30)
        other = replace(cloud, means=cloud.means * size, scales=cloud.scales * size)
        few, same = (simplify(c, 7, low_pass=low_pass) for c in (cloud, other))
        np.testing.assert_allclose(same.means / np.float32(size), few.means, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(same.opacities, few.opacities, rtol=1e-3)

    def test_points_of_no_size(self):
        cloud = replace(random_cloud(30), scales=np.zeros((30, 3)))
        few = simplify(cloud, 4, low_pass=0)
        assert len(few) == 4

    @pytest.mark.parametrize("count", [0, -3, 2.5, True, "9"])
    def test_count(self, count):
        with pytest.raises(ValueError, match="count must be a whole number of splats"):
            simplify(random_cloud(3), count)

    @pytest.mark.parametrize("low_pass", [-1.0, np.nan, np.zeros(2), np.array([0.1, np.inf, 0])])
    def test_low_pass(self, low_pass):
        with pytest.raises(ValueError, match="low_pass must be one number >= 0, or one for each of the 3"):
            simplify(random_cloud(3), 2, low_pass=low_pass)


def test_dilogarithm():
    """Special values, Euler's reflection, and the way back."""
    assert optical_depth(0.0) == 0
    assert optical_depth(1.0) == pytest.approx(np.pi**2 / 6, rel=1e-15)
    golden = (np.sqrt(5) - 1) / 2
    assert optical_depth(golden) == pytest.approx(np.pi**2 / 10 - np.log(golden) ** 2, rel=1e-14)
    o = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(opacity_of(optical_depth(o)), o, atol=1e-5)
    assert opacity_of(99.0) == 1
    # The integral that it stands for: of -log(1 - o exp(-r^2 / 2)) r dr.
    r = np.linspace(0, 9, 400_001)
    for opacity in (0.1, 0.7, 0.99):
        values = -np.log1p(-opacity * np.exp(-(r**2) / 2)) * r
        integral = np.sum((values[1:] + values[:-1]) * np.diff(r)) / 2
        assert optical_depth(opacity) == pytest.approx(integral, rel=1e-6)


class TestPictures:
    def test_far_better_than_dropping(self):
        cloud = make_scene(8000)
        cloud = replace(cloud, sh=cloud.sh[:, :1])
        cameras = orbit(cloud, 3, width=200, height=200)
        count = len(cloud) // 4
        importance = cloud.opacities * mean_shadow(disc_areas(cloud.scales))
        dropped = cloud.take(np.argsort(-importance)[:count])
        merged = simplify(cloud, count, cameras=cameras)
        assert likeness(merged, cloud, cameras) > likeness(dropped, cloud, cameras) + 5

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("name", "least"),
        [("guitar_sh0.ply", 37.5), ("playbot_lod3_31k_sh2.ply", 26), ("monkey_0001.sog", 28)],
    )
    def test_real_files_at_a_quarter(self, name, least):
        cloud = load_gaussians(shared_data(f"splats/{name}"))
        cameras = orbit(cloud, 2, width=300, height=300)
        few = simplify(cloud, len(cloud) // 4, cameras=cameras)
        assert len(few) == len(cloud) // 4
        assert likeness(few, cloud, cameras) > least


def likeness(some, cloud, cameras):
    return np.mean([psnr(render_splats(some, c).color, render_splats(cloud, c).color) for c in cameras])


class TestLimits:
    """Limits of convert that merge."""

    cloud = replace(make_scene(3000), sh=make_scene(3000).sh[:, :1])
    cameras = orbit(cloud, 3, width=200, height=200)

    def test_max_splats_is_what_simplify_makes(self):
        mesh = convert(self.cloud, max_splats=500, footprint="none", min_opacity=0)
        same = convert(simplify(self.cloud, 500), footprint="none", min_opacity=0)
        np.testing.assert_array_equal(mesh.vertices, same.vertices)
        np.testing.assert_array_equal(mesh.colors, same.colors)
        np.testing.assert_array_equal(mesh.face_splat, same.face_splat)
        assert mesh.splat_count <= 500

    @pytest.mark.parametrize("detail", ["even", "cameras"])
    @pytest.mark.parametrize("most", [8, 1000, 8000, 20_000])
    def test_max_triangles_is_kept(self, most, detail):
        mesh = convert(self.cloud, cameras=self.cameras, max_triangles=most, detail=detail)
        assert 0.85 * most <= len(mesh.faces) <= most
        assert mesh.face_splat[-1] < len(self.cloud)

    def test_no_limit_is_felt(self):
        free, wide = convert(self.cloud), convert(self.cloud, max_triangles=8 * len(self.cloud))
        np.testing.assert_array_equal(free.vertices, wide.vertices)

    def test_merged_is_far_better_than_dropped(self):
        for limit in (dict(max_splats=600), dict(max_triangles=4800)):
            merged, dropped = (
                convert(self.cloud, cameras=self.cameras, budget=budget, **limit)
                for budget in ("merge", "drop")
            )
            assert mesh_likeness(merged, self) > mesh_likeness(dropped, self) + 2

    def test_what_was_asked_for_stays(self):
        mesh = convert(self.cloud, max_triangles=700, mode="crossed", sides=6)
        assert len(mesh.faces) == 700 // 12 * 12
        assert len(convert(self.cloud, max_triangles=700, preset="paper").faces) == 700 // 8 * 8
        with pytest.raises(ValueError, match="max_triangles must be at least 12, one splat's, got 11"):
            convert(self.cloud, max_triangles=11, sides=6, mode="crossed")

    @pytest.mark.parametrize(
        ("most", "each", "count"),
        [(100, 4, 25), (800, 4, 200), (2400, 4, 600), (4000, 6, 666), (6000, 8, 750), (8000, 8, 1000)],
    )
    def test_triangles_of_a_flat_splat(self, most, each, count):
        given = ConversionOptions(mode="flat", max_triangles=most)
        chosen, found = within_limits(given, given.resolved("default", has_cameras=False), 1000)
        assert (chosen.sides, found) == (each, count)

    @pytest.mark.parametrize("kernel", ["3dgs", "antialiased", "2dgs"])
    def test_kernels(self, kernel):
        cloud = replace(self.cloud, kernel=kernel)
        mesh = convert(cloud, max_splats=700, cameras=self.cameras)
        truth = [render_splats(cloud, c).color for c in self.cameras]
        found = [render(mesh, c).color for c in self.cameras]
        assert np.mean([psnr(a, b) for a, b in zip(found, truth, strict=True)]) > 20


def mesh_likeness(mesh, scene):
    truth = [render_splats(scene.cloud, c).color for c in scene.cameras]
    return np.mean([psnr(render(mesh, c).color, t) for c, t in zip(scene.cameras, truth, strict=True)])


# ---- In blocks


def test_blocks_leave_as_many_splats_and_as_good_an_image():
    cloud = make_scene(6000)
    camera = orbit(cloud, 1, width=120, height=120, elevation=20)[0]
    image = render_splats(cloud, camera).color
    at_once, blocks = simplify(cloud, 1500), merging.simplify_in_blocks(cloud, 1500, block=500)
    assert len(blocks) == 1500
    one, other = (psnr(render_splats(each, camera).color, image) for each in (at_once, blocks))
    assert other > one - 0.5
    assert one < 50  # the comparison is not one of a cloud with itself
    assert not np.array_equal(np.sort(blocks.means[:, 0]), np.sort(at_once.means[:, 0]))


def test_blocks_have_the_same_bits_with_any_number_of_threads():
    cloud = make_scene(6000)
    one, three = (merging.simplify_in_blocks(cloud, 1500, block=500, threads=n) for n in (1, 3))
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))


def test_blocks_are_joined_to_merge_to_few_splats_around_the_same_centre():
    cloud = random_cloud(1000)
    blocks = merging.simplify_in_blocks(cloud, 10, block=100)  # fewer than each block keeps at first
    assert len(blocks) == 10
    assert blocks.kernel == cloud.kernel
    low_pass = merging._usual_low_pass(cloud, None)
    mean = np.average(cloud.means, axis=0, weights=masses(cloud, low_pass))
    found = np.average(blocks.means, axis=0, weights=masses(blocks, float(np.median(low_pass))))
    assert np.allclose(found, mean, atol=0.15)


def test_masses_are_the_same_in_chunks():
    cloud = random_cloud(250)
    width = np.linspace(0, 0.1, 250)
    whole = merging._masses(cloud, width)
    with patch.object(merging, "CHUNK", 100):
        np.testing.assert_array_equal(merging._masses(cloud, width), whole)


def test_a_cloud_of_one_block_is_simplified_as_a_whole():
    cloud = random_cloud(300)
    for block in (300, 1000):
        assert np.array_equal(
            merging.simplify_in_blocks(cloud, 40, block=block).means, simplify(cloud, 40).means
        )
    assert merging.simplify_in_blocks(cloud, 300, block=10) is cloud


def test_blocks_hold_every_row_once_and_lie_apart():
    means = np.random.default_rng(1).normal(size=(1000, 3)) * [1, 5, 1]
    blocks = merging._blocks(means, np.arange(1000), 130)
    assert max(map(len, blocks)) <= 130
    assert np.array_equal(np.sort(np.concatenate(blocks)), np.arange(1000))
    ranges = sorted((means[rows, 1].min(), means[rows, 1].max()) for rows in blocks)
    assert np.mean([high - low for low, high in ranges]) < 0.5 * np.ptp(means[:, 1])


def test_invisible_splats_earn_a_block_no_share():
    cloud = random_cloud(1000)
    cloud = replace(cloud, means=cloud.means * np.float32([9, 1, 1]))
    left = cloud.means[:, 0] < np.median(cloud.means[:, 0])
    faint = replace(cloud, opacities=np.where(left, 0.001, cloud.opacities).astype(np.float32))
    kept = merging.simplify_in_blocks(faint, 200, block=500)
    assert (kept.opacities >= 1 / 255).mean() > 0.95


class TestCameras:
    """With cameras, splats count by the pixels that show them."""

    def test_what_is_near_stays_fine(self):
        # Two pairs, equal but for their places. That at the camera is nearer together: alone, it goes first.
        cloud = GaussianCloud(
            [[0, 0, 2], [0.02, 0, 2], [0, 0, 40], [0.03, 0, 40]],
            [[1, 0, 0, 0]] * 4,
            [[0.02] * 3] * 4,
            [0.9] * 4,
            np.zeros((4, 1, 3)),
        )
        camera = look_at([0, 0, 0], [0, 0, 1], width=64, height=64, fov=60)
        alone, seen = simplify(cloud, 3, low_pass=0), simplify(cloud, 3, low_pass=0, cameras=[camera])
        assert sorted(alone.means[:, 2].round().tolist()) == [2, 40, 40]
        assert sorted(seen.means[:, 2].round().tolist()) == [2, 2, 40]

    def test_what_is_hidden_becomes_coarse(self):
        # An opaque, motley wall, and the same pairs before and behind it.
        points = np.stack(np.meshgrid(np.linspace(-1.7, 1.7, 41), np.linspace(-1.7, 1.7, 41), [4.0]), axis=-1)
        wall = GaussianCloud(
            points.reshape(-1, 3),
            np.tile([1, 0, 0, 0], (1681, 1)),
            np.tile([0.09, 0.09, 0.001], (1681, 1)),
            np.full(1681, 0.99),
            np.random.default_rng(0).uniform(-1.5, 1.5, (1681, 1, 3)),
        )
        pairs = GaussianCloud(
            [[x, y, z] for z in (3, 5) for y in np.linspace(-0.5, 0.5, 6) for x in (-0.02, 0.02)],
            np.tile([1, 0, 0, 0], (24, 1)),
            np.full((24, 3), 0.05),
            np.full(24, 0.9),
            np.zeros((24, 1, 3)),
        )
        cloud = GaussianCloud.joined([pairs, wall])
        camera = look_at([0, 0, 0], [0, 0, 1], width=128, height=128, fov=50)
        counted = pixels_of(cloud, masses(cloud), CameraCoverage(cloud.means, [camera]))
        own, count, thin = masses(cloud), len(cloud) - 6, np.zeros(len(cloud))
        blind, seen = (merging._merge(cloud, count, thin, own, c, None).group for c in (own, counted))
        together = [[i for i in range(0, 24, 2) if group[i] == group[i + 1]] for group in (blind, seen)]
        assert min(together[0]) < 12
        assert together[1] == [12, 14, 16, 18, 20, 22]

    def test_neighbours_of_what_is_seen_count_as_seen(self):
        rng = np.random.default_rng(1)
        points, values = rng.normal(size=(40, 3)), rng.uniform(size=40)
        apart = np.linalg.norm(points[:, None] - points[None], axis=2)
        own = [values[np.argsort(row)[: 1 + AROUND]].max() for row in apart]
        np.testing.assert_array_equal(merging_weights._greatest_around(points, values, None), own)
        np.testing.assert_array_equal(
            merging_weights._greatest_around(points[:1], values[:1], None), values[:1]
        )

    def test_pixels_by_hand(self):
        # One splat before the camera, one behind it, one beside the image, one that is hidden.
        cloud = GaussianCloud(
            [[0, 0, 2], [0, 0, -2], [4, 0, 2], [0, 0, 4]],
            [[1, 0, 0, 0]] * 4,
            [[0.3, 0.3, 0.01]] * 3 + [[0.05, 0.05, 0.01]],
            [0.999, 0.5, 0.5, 0.9],
            np.zeros((4, 1, 3)),
        )
        camera = look_at([0, 0, 0], [0, 0, 1], width=200, height=200, fov=90)
        mass = np.array([1.0, 2, 3, 4])
        with patch.object(merging_weights, "AROUND", 0):
            pixels = pixels_of(cloud, mass, CameraCoverage(cloud.means, [camera]))
        focal, distance = 100.0, np.array([4.0, 4, 20, 16])
        elsewhere = ELSEWHERE * focal**2 / distance * mass
        np.testing.assert_allclose(pixels[1:3], elsewhere[1:3], rtol=1e-5)
        assert pixels[3] == pytest.approx(elsewhere[3] + HIDDEN * focal**2 / 16 * 4, rel=0.05)
        # The image of the first is about as large as an opaque disc of twice its standard deviation.
        shown = pixels[0] - elsewhere[0] - HIDDEN * focal**2 / 4
        assert 0.3 < shown / (np.pi * (focal * 0.6 / 2) ** 2) < 2
        # Of too many splats no images are rendered.
        with patch.object(merging_weights, "MOST", 3):
            many = pixels_of(cloud, mass, CameraCoverage(cloud.means, [camera]))
        covered = np.where([True, False, False, True], focal**2 / distance, 0) * mass
        np.testing.assert_allclose(many, elsewhere + covered, rtol=1e-5)

    def test_each_camera_looks_at_the_splats_once(self):
        cloud = random_cloud(300)
        camera = look_at([0, 0, -9], [0, 0, 0], width=100, height=100, fov=60, near=0.1)
        with patch.object(CameraCoverage, "_each", autospec=True, side_effect=CameraCoverage._each) as each:
            simplify(cloud, 100, cameras=[camera])
        assert each.call_count == 1

    @pytest.mark.parametrize("simplified", [simplify, simplify_in_blocks])
    def test_a_room_from_within(self, simplified):
        cloud = make_room(6000).of_degree(0)
        how = {} if simplified is simplify else {"block": 1000}
        cameras = [
            look_at(MIDDLE + 0.2 * toward, MIDDLE + toward, width=120, height=120, fov=70, near=0.05)
            for toward in np.random.default_rng(0).normal(size=(20, 3)) * [1, 1, 0.3]
        ]
        blind = simplified(cloud, 1500, **how)
        seen = simplified(cloud, 1500, cameras=cameras[4:], **how)
        assert len(seen) == len(blind) == 1500

        def likeness(few):
            views = cameras[:4]
            return np.mean([psnr(render_splats(few, c).color, render_splats(cloud, c).color) for c in views])

        assert likeness(seen) > likeness(blind) + 1.5

    def test_more_threads_same_bits(self):
        cloud = random_cloud(300)
        cameras = orbit(cloud, 4, width=50, height=50)
        one, many = (simplify(cloud, 90, cameras=cameras, threads=n) for n in (1, 3))
        for name in ("means", "scales", "quaternions", "opacities", "sh"):
            np.testing.assert_array_equal(getattr(one, name), getattr(many, name))


class TestShares:
    """How many splats blocks keep."""

    def test_by_hand(self):
        shares = merging._shares(np.array([1.0, 3.0]), np.array([1000, 300]), 800)
        assert shares.tolist() == [500, 300]  # the second has no more
        shares = merging._shares(np.array([1.0, 99.0, 0.0]), np.array([1000, 1000, 0]), 1000)
        assert shares.tolist() == [FEWEST_OF_BLOCK, 990, 0]  # of the first some stay

    def test_of_many_splats_where_numbers_have_32_bits(self):
        """By default, those of NumPy 1 on Windows, sums among them."""

        class Counts(np.ndarray):
            def sum(self):
                return super().sum(dtype=self.dtype)

        counts = np.full(20, 250_000, np.int32).view(Counts)
        assert merging._shares(counts, counts, 2_500_000).tolist() == 20 * [125_000]

    @given(st.lists(st.integers(0, 5000), min_size=1, max_size=12), st.integers(0, 100), st.data())
    def test_laws(self, visible, seed, data):
        wanted = np.random.default_rng(seed).exponential(size=len(visible)) * (np.array(visible) > 0)
        total = data.draw(st.integers(1, max(sum(visible), 1)))
        shares = merging._shares(wanted, np.array(visible), total)
        assert (shares <= np.array(visible) + 1).all()
        assert shares.sum() >= min(total, sum(visible)) - len(visible)
        assert shares.sum() <= total + FEWEST_OF_BLOCK * len(visible) + len(visible)
        even = merging._shares(np.array(visible), np.array(visible), total)
        assert abs(even - np.array(visible) * total / max(sum(visible), 1)).max() <= FEWEST_OF_BLOCK + 1


class TestClumps:
    """Cells of an octree that are put together before pairs are merged."""

    def test_by_hand(self):
        """Two corners of a cube: three points in one cell, of which two share a finer one."""
        points = np.array([[9.0, 9, 9], [0, 0, 0], [0.1, 0, 0], [3, 3, 3], [10, 10, 10]])
        masses = np.array([1.0, 1, 1, 1, 1])
        assert clumps(points, masses, 5.0).tolist() == [0, 0, 0, 0, 0]
        assert clumps(points, masses, 3.0).tolist() == [0, 1, 1, 1, 0]
        assert clumps(points, masses, 2.0).tolist() == [0, 1, 1, 2, 0]
        assert clumps(points, masses, 0.5).tolist() == [0, 1, 2, 3, 4]

    @given(n=st.integers(1, 400), seed=st.integers(0, 99), share=st.floats(0.001, 1))
    def test_laws(self, n, seed, share):
        """No group counts more than it may, but those of one splat; and none lies inside another's cell."""
        rng = np.random.default_rng(seed)
        points, masses = rng.normal(size=(n, 3)), rng.exponential(size=n)
        most = share * masses.sum() * (1 + 1e-9)
        group = clumps(points, masses, most)
        first = np.unique(group, return_index=True)[1]
        assert (np.diff(first) > 0).all()
        assert len(first) == group.max() + 1
        sums, sizes = np.bincount(group, masses), np.bincount(group)
        assert (sums[sizes > 1] <= most * (1 + 1e-9)).all()
        if share == 1:
            assert len(sums) == 1

    def test_far_fewer_splats_are_as_good(self, monkeypatch):
        """Of every 40 splats one is left: as good as pair by pair, and what counts much stays alone."""
        cloud = make_room(20_000)
        views = look_around(cloud)
        made = simplify(cloud, 500, cameras=views)
        monkeypatch.setattr(merging_groups, "CLUMPED", 10**9)
        pairs = simplify(cloud, 500, cameras=views)
        assert len(made) == len(pairs) == 500
        assert not np.array_equal(made.means, pairs.means)

        def likeness(few):
            return np.mean([psnr(shown(few, view), shown(cloud, view)) for view in views])

        assert likeness(made) > likeness(pairs) - 0.3


def look_around(cloud):
    ahead = [np.array([np.cos(a), np.sin(a), 0]) for a in range(6)]
    return [look_at(MIDDLE, MIDDLE + a, width=120, height=90) for a in ahead]


def shown(cloud, view):
    return render_splats(cloud, view, background=(0, 0, 0)).color.clip(0, 1)


@pytest.mark.parametrize(("visible", "count"), [(0, 5), (3, 100), (1, 1)])
def test_as_many_are_left_as_are_wanted_where_few_count(visible, count):
    cloud = random_cloud(1873)
    opacities = np.where(np.arange(len(cloud)) < visible, 0.5, 1e-4)
    assert len(simplify(replace(cloud, opacities=opacities), count)) == count
    scales = np.where(np.arange(len(cloud))[:, None] < visible, 1e3, cloud.scales)
    assert len(simplify(replace(cloud, scales=scales), count)) == count
    assert len(np.unique(convert(replace(cloud, scales=scales), max_splats=count).face_splat)) == count


@pytest.mark.parametrize("threads", [0, -1, 1.5])
def test_threads_are_checked_before_the_work(threads):
    cloud = random_cloud(20)
    for work in (lambda: simplify(cloud, 5, threads=threads), lambda: convert(cloud, threads=threads)):
        with pytest.raises(ValueError, match="threads must be at least 1"):
            work()
