"""Stars: ellipses in evenly spread planes that look like a thick splat, and alike from everywhere."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats import GaussianCloud, convert, draw_splats, psnr, render
from meshsplats.cameras.trajectories import look_at
from meshsplats.conversion.detail import FIRST_STAR, TRIANGLES
from meshsplats.conversion.fans import build
from meshsplats.conversion.stars import CENTERS, OPACITIES, STARS, _axes

SIDE = np.linspace(-3.6, 3.6, 49)
PIXELS = np.stack(np.meshgrid(SIDE, SIDE), axis=2).reshape(-1, 2)
GAUSSIAN = np.exp(-np.square(PIXELS).sum(axis=1) / 2)


def directions(count):
    found = np.random.default_rng(7).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def reach(axes, direction):
    """(pixels, planes) distance from the centre at which each pixel's ray, along ``direction``, meets the
    planes across ``axes``; in units of a ball's standard deviation."""
    right = np.cross(direction, [1.0, 0, 0])
    right /= np.linalg.norm(right)
    places = PIXELS[:, :1] * right + PIXELS[:, 1:] * np.cross(direction, right)
    along = -(places @ axes.T) / (axes @ direction)
    return np.sqrt(np.square(PIXELS).sum(axis=1)[:, None] + along**2)


@pytest.mark.parametrize("index", range(len(STARS)))
def test_evenly_spread_ellipses(index):
    """As many triangles as the level has; each ellipse is a regular polygon with the area of the circle of
    2.6 standard deviations in a plane through the centre; the planes have one angle to their neighbours."""
    pattern, profile = STARS[index].pattern, STARS[index].profile
    assert len(pattern.faces) == TRIANGLES[FIRST_STAR + index]
    a, b, c = (pattern.directions[pattern.faces[:, i]] for i in range(3))
    assert (a == 0).all()
    cross = np.cross(b, c).reshape(pattern.ellipses, -1, 3)
    normals = cross[:, 0] / np.linalg.norm(cross[:, 0], axis=1, keepdims=True)
    units = cross / np.linalg.norm(cross, axis=2, keepdims=True)
    np.testing.assert_allclose(units, np.broadcast_to(normals[:, None], units.shape), atol=1e-12)
    area = profile.level_radii[1] ** 2 * np.linalg.norm(cross, axis=2).sum(axis=1) / 2
    np.testing.assert_allclose(area, np.pi * 2.6**2)
    cosines = np.abs(normals @ normals.T) - np.eye(len(normals))
    nearest = {6: 1 / np.sqrt(5), 10: np.sqrt(5) / 3}[pattern.ellipses]
    np.testing.assert_allclose(cosines.max(axis=1), nearest)


@pytest.mark.parametrize("ellipses", CENTERS)
@pytest.mark.parametrize("row", range(1, len(OPACITIES)))
def test_opacities_are_a_minimum(ellipses, row):
    """A tenth more or less at the centre is further from the splat, seen from all sides."""
    opacity, center = OPACITIES[row], CENTERS[ellipses][row]
    axes = _axes(ellipses)
    falls = [np.clip(1 - reach(axes, d) / 2.6, 0, None) for d in directions(12)]

    def error(center):
        drawn = np.array([1 - np.prod(1 - center * fall, axis=1) for fall in falls])
        return np.sqrt(np.square(drawn - opacity * GAUSSIAN).mean() / np.square(opacity * GAUSSIAN).mean())

    assert error(center) < min(error(0.9 * center), error(1.1 * center))
    assert error(center) < 0.19


def test_a_faint_star_looks_alike_from_everywhere():
    """Its integrated opacity hardly depends on the direction, where that of one ellipse falls to 0."""
    for shape in STARS:
        vertices, faces, colors = build(
            [shape],
            np.zeros(1, int),
            np.zeros((1, 3), np.float32),
            np.array([[1, 0, 0, 0]], np.float32),
            np.array([[0, 1, 2]], np.int8),
            np.ones((1, 3), np.float32),
            np.ones((1, 3), np.float32),
            np.array([0.02], np.float32),
        )
        a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
        areas = np.abs(np.cross(b - a, c - a) @ directions(200).T) / 2
        seen = colors[faces, 3].mean(axis=1) @ areas
        assert seen.mean() == pytest.approx(0.02 * 2 * np.pi, rel=0.15)
        assert seen.min() > 0.9 * seen.mean()
        assert seen.max() < 1.1 * seen.mean()


def thick_and_flat() -> tuple[GaussianCloud, list]:
    """A ball, a sheet of 4 times its area and some small balls far from both, seen from a few sides."""
    n = 12
    rng = np.random.default_rng(7)
    means = np.concatenate([[[0, 0, 0], [6, 0, 0]], 12 + rng.normal(size=(n - 2, 3))])
    scales = np.full((n, 3), 0.02)
    scales[:2] = [[1, 0.9, 0.8], [2, 2, 0.1]]
    cloud = GaussianCloud(
        means, np.tile([1.0, 0, 0, 0], (n, 1)), scales, np.full(n, 0.9), rng.normal(size=(n, 1, 3))
    )
    views = [
        look_at((15 * np.sin(a), 4, -15 * np.cos(a)), (2, 0, 0), up=(0, -1, 0), width=96, height=64, fov=50)
        for a in np.linspace(0, 5, 8)
    ]
    return cloud, views


def test_thick_splats_of_many_triangles_become_stars():
    cloud, views = thick_and_flat()

    def ranks(**options):
        """For each splat, how many dimensions its vertices span."""
        mesh = convert(cloud, cameras=views, detail="cameras", sides=20, footprint="none", **options)
        found = []
        for splat in range(len(cloud)):
            own = mesh.vertices[np.unique(mesh.faces[mesh.face_splat == splat])].astype(np.float64)
            sizes = np.linalg.svd(own - own[0], compute_uv=False)
            found.append(int((sizes > 1e-4 * sizes[0]).sum()))
        return found

    assert ranks() == [3] + [2] * 11
    assert ranks(flat_below=1) == [2] * 12
    assert ranks(flat_below=0.01) == [3, 3] + [2] * 10
    assert ranks(preset="paper") == [2] * 12


def test_a_ball_looks_alike_from_everywhere():
    """The star of a ball is nearer to its images than a fan is, from the worst side above all."""
    cloud, views = thick_and_flat()
    cloud = cloud.take(np.delete(np.arange(len(cloud)), 1))
    decibels = []
    for flat_below in (0.25, 1.0):
        options = dict(detail="cameras", sides=20, footprint="none", flat_below=flat_below)
        mesh = convert(cloud, cameras=views, **options)
        pairs = [(render(mesh, v, samples=2).color, draw_splats(cloud, v, "area").color) for v in views]
        decibels.append([psnr(np.clip(a, 0, 1), b) for a, b in pairs])
    stars, fans = np.array(decibels)
    assert stars.min() > 30
    assert stars.min() > fans.min() + 5
