"""What merged splats cover: areas by hand and by a fine grid, and sheets that stay without holes."""

from __future__ import annotations

import numpy as np
import pytest

import meshsplats as ms
from meshsplats.conversion.merging import MERGED_OPAQUE, simplify
from meshsplats.conversion.merging_coverage import Parts, Wholes, covered_shares
from meshsplats.scene.camera import Camera


def parts_of(group, means, variances, opacities) -> Parts:
    covariances = np.array([np.diag(v) for v in np.broadcast_to(variances, (len(means), 3))], float)
    return Parts(np.array(group), np.array(means, float), covariances, np.array(opacities, float))


def wholes_of(means, sizes) -> Wholes:
    means = np.array(means, float)
    return Wholes(means, np.broadcast_to(np.eye(3), (len(means), 3, 3)), np.array(sizes, float))


class TestCoveredShares:
    def test_one_splat_covers_its_opacity(self):
        parts = parts_of([0, 1, 2], 3 * [(7, 8, 9)], [4, 9, 1], [0.2, 0.6, 0.95])
        found = covered_shares(parts, wholes_of(3 * [(7, 8, 9)], 3 * [(2, 3)]), 1)
        # Three standard deviations hold all but 1 - erf(3 / sqrt 2)^2, half a percent.
        np.testing.assert_allclose(found, [0.2, 0.6, 0.95], rtol=6e-3)

    def test_layers_do_not_count_twice(self):
        """Two of opacity o in one place: o + o - o^2 / 2, as the product of the profiles is half as wide."""
        parts = parts_of([0, 0], [(0, 0, -5), (0, 0, 5)], [1, 1, 1], [0.8, 0.8])
        (found,) = covered_shares(parts, wholes_of([(0, 0, 0)], [(1, 1)]), 1)
        assert found == pytest.approx(1.6 - 0.32, rel=0.02)

    def test_splats_far_apart_add_up(self):
        parts = parts_of([0, 0], [(-9, 0, 0), (9, 0, 0)], [4, 1, 1], [0.7, 0.4])
        (found,) = covered_shares(parts, wholes_of([(0, 0, 0)], [(6, 1)]), 1)
        assert found * 6 == pytest.approx(1.1 * 2, rel=0.01)

    def test_turned_groups_are_those_of_a_fine_grid(self):
        rng = np.random.default_rng(4)
        n = 60
        group = np.sort(rng.integers(0, 5, n))
        roots = rng.normal(size=(n, 3, 3)) * 0.5
        parts = Parts(group, rng.normal(size=(n, 3)), roots @ roots.swapaxes(1, 2), rng.uniform(0.05, 1, n))
        axes = np.linalg.qr(rng.normal(size=(5, 3, 3)))[0]
        wholes = Wholes(rng.normal(size=(5, 3)) * 0.1, axes, rng.uniform(0.8, 1.2, (5, 2)))
        found = covered_shares(parts, wholes, 1)
        steps = (np.arange(240) + 0.5) / 240 * 6 - 3
        for g in range(5):
            left = np.ones((240, 240))
            u, v = axes[g].T[:2]
            for i in np.flatnonzero(group == g):
                plane = np.stack([u, v])
                inverse = np.linalg.inv(plane @ parts.covariances[i] @ plane.T)
                middle = plane @ (parts.means[i] - wholes.means[g])
                grid = np.meshgrid(steps * wholes.sizes[g, 0], steps * wholes.sizes[g, 1], indexing="ij")
                apart = np.stack(grid, axis=-1) - middle
                exponents = np.einsum("xyi,ij,xyj->xy", apart, inverse, apart) / 2
                left *= 1 - min(parts.opacities[i], 1 - 1e-4) * np.exp(-exponents)
            assert found[g] == pytest.approx((1 - left).sum() * (6 / 240) ** 2 / (2 * np.pi), rel=0.03)

    def test_batches_change_rounding_and_threads_nothing(self, monkeypatch):
        rng = np.random.default_rng(1)
        group = np.sort(np.concatenate([np.arange(40), rng.integers(0, 40, 200)]))
        parts = parts_of(group, rng.normal(size=(240, 3)), [1, 1, 1], rng.uniform(0, 1, 240))
        wholes = wholes_of(rng.normal(size=(40, 3)), rng.uniform(1, 2, (40, 2)))
        whole = covered_shares(parts, wholes, 1)
        for rows in (1, 7, 100):
            monkeypatch.setattr("meshsplats.conversion.merging_coverage.AT_ONCE", rows)
            batches = covered_shares(parts, wholes, 2)
            np.testing.assert_allclose(batches, whole, rtol=1e-12)
            np.testing.assert_array_equal(batches, covered_shares(parts, wholes, 1))

    @pytest.mark.parametrize("size", [0.3, 1 / 3, 0.7, 1e-9])
    def test_needles_on_the_diagonal_are_finite(self, size):
        needle = size * np.array([[0.5, 0.5, 0], [0.5, 0.5, 0], [0, 0, 0]])
        parts = Parts(np.array([0]), np.zeros((1, 3)), needle[None], np.array([0.9]))
        (found,) = covered_shares(parts, wholes_of([(0, 0, 0)], [(1, 1)]), 1)
        assert 0 <= found <= 1


def sheet(opacity: float, side: int = 60) -> ms.GaussianCloud:
    """Flat splats in z = 0, two standard deviations apart."""
    x, y = np.meshgrid(np.arange(side) - side / 2, np.arange(side) - side / 2)
    means = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    n = len(means)
    return ms.GaussianCloud(
        means.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.tile(np.float32([0.5, 0.5, 0.01]), (n, 1)),
        np.full(n, opacity, np.float32),
        np.zeros((n, 1, 3), np.float32),
    )


def middle_alpha(cloud: ms.GaussianCloud) -> np.ndarray:
    """Alpha of the middle of the sheet, a third of its sides, from above."""
    pose = np.diag([1.0, -1, -1, 1])
    pose[2, 3] = 60
    return ms.render_splats(cloud, Camera(pose, 200, 200, 32, 32, 64, 64)).alpha


@pytest.mark.parametrize("opacity", [0.9, 0.99, 1])
@pytest.mark.parametrize("share", [4, 16])
def test_a_sheet_stays_without_holes(opacity, share):
    """Merged by mass and covariance alone, they would have a mean alpha of 0.69 and 0.56."""
    cloud = sheet(opacity)
    assert middle_alpha(cloud).min() > 0.85
    merged = middle_alpha(simplify(cloud, len(cloud) // share))
    assert np.quantile(merged, 0.05) > (0.82 if opacity > 0.95 else 0.62)
    assert merged.mean() > (0.89 if opacity > 0.95 else 0.76)


@pytest.mark.parametrize("opacity", [0.8, 0.9])
def test_merging_again_makes_no_solid_surface_of_others(opacity):
    """Chained, as levels of tiles are, merging does not widen splats more than at once."""
    cloud = sheet(opacity)
    chained = cloud
    for share in (4, 16, 64):
        chained, direct = simplify(chained, len(cloud) // share), simplify(cloud, len(cloud) // share)
        areas = [np.prod(np.sort(c.scales, axis=1)[:, 1:], axis=1).sum() for c in (chained, direct)]
        assert areas[0] == pytest.approx(areas[1], rel=0.3)


def test_a_file_tells_merged_splats_from_opaque_ones(tmp_path):
    merged = simplify(sheet(1), 100)
    assert (merged.opacities == MERGED_OPAQUE).mean() > 0.5
    ms.save_gaussians(merged, tmp_path / "merged.ply")
    np.testing.assert_array_equal(ms.load_gaussians(tmp_path / "merged.ply").opacities, merged.opacities)


def test_faint_splats_keep_covariance_and_mass():
    cloud = sheet(0.05, 12)
    merged = simplify(cloud, 1)
    spread = np.cov(cloud.means[:, :2].T, bias=True)[0, 0] + 0.25
    np.testing.assert_allclose(np.sort(merged.scales[0])[1:] ** 2, spread, rtol=0.05)
