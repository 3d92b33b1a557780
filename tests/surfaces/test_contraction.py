"""Grids of places: even around the cameras, ever wider beyond."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_surfaces import ball

from meshsplats._core.surfaces import Grid, fuse_depth
from meshsplats.cameras.trajectories import look_at
from meshsplats.rendering.core_arguments import camera_struct
from meshsplats.scene.mesh import SplatMesh
from meshsplats.surfaces import fusion, make_surface
from meshsplats.surfaces.fusion import grid_of

LENS = {"width": 48, "height": 40, "fov": 80}
coordinates = st.floats(-1e3, 1e3, width=32)


def grid_with(radius: float, center=(0.5, -0.25, 0.125)) -> Grid:
    return Grid(np.array([-3.5, -4, -3.25]), 0.5, (15, 16, 14), center, radius)


@given(st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=1), st.floats(0.1, 100))
@settings(max_examples=60, deadline=None)
def test_contraction_keeps_directions_order_and_the_ball(points, radius):
    grid, scene = grid_with(radius), np.array(points, np.float64)
    contracted = grid.contracted(scene)
    before, after = (np.linalg.norm(p - grid.center, axis=1) for p in (scene, contracted))
    assert (after < 2 * radius).all()
    inside = before <= radius
    np.testing.assert_array_equal(contracted[inside], scene[inside])
    assert (after[~inside] >= radius * (1 - 1e-12)).all()
    order = np.argsort(before)
    assert (np.diff(after[order]) >= -1e-9 * radius).all()
    known = before < 200 * radius
    np.testing.assert_allclose(grid.in_scene(contracted)[known], scene[known], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("sides", "depth", "longest"),
    [
        ((40, 30, 8), 3, 512),  # a flat
        ((40, 30, 8), 5, 400),
        ((40, 30, 8), 20, 256),  # a field
        ((40, 40, 40), 1, 368),  # 512 would take 134 million points
        ((40, 30, 8), 0, 256),  # nothing is known
    ],
)
def test_voxels_of_a_place_follow_how_far_one_sees(sides, depth, longest):
    points = (np.random.default_rng(0).uniform(-0.5, 0.5, (20_000, 3))) * sides
    cameras = [look_at((x, 0, 0), (x, 1, 0), up=(0, 0, 1), **LENS) for x in (-18, 0, 18)]
    shape = grid_of(points, cameras, None, depth).shape
    assert max(shape) == pytest.approx(longest, rel=0.02)
    assert np.prod(shape) < 1.1 * 5e7
    assert max(grid_of(points, cameras, 64, depth).shape) == pytest.approx(64, abs=2)


def test_without_a_radius_points_stay():
    points = np.random.default_rng(0).normal(0, 100, (50, 3))
    assert grid_with(0).contracted(points) is points
    assert grid_with(0).in_scene(points) is points


@pytest.mark.parametrize("radius", [0.0, 2.0])
@pytest.mark.parametrize("behind", [1.0, 0.25])
def test_distances_on_the_grid(radius, behind):
    """Against a loop over the points, each where the grid puts it in the scene."""
    grid = grid_with(radius)
    camera = look_at((0.2, -3, 0.4), (0, 0, 0), up=(0, 0, 1), near=0.1, **LENS)
    depth = np.random.default_rng(1).uniform(1, 9, (camera.height, camera.width)).astype(np.float32)
    depth[:5] = np.inf
    total, weight = (np.zeros(grid.shape, np.float32) for _ in range(2))
    for _ in range(2):  # added to
        fuse_depth(total, weight, depth, camera_struct(camera), grid, truncation=1.5, behind=behind)
    own, share = np.zeros(grid.shape), np.zeros(grid.shape)
    for at in np.ndindex(grid.shape):
        point = grid.low + grid.voxel * np.array(at)
        if radius and np.linalg.norm(point - grid.center) >= 2 * radius:
            continue
        place = grid.in_scene(point[None])[0]
        right, down, away = camera.world_to_camera[:3, :3] @ place + camera.world_to_camera[:3, 3]
        if away <= 0.1:
            continue
        column = int(np.floor(camera.fx * right / away + camera.cx))
        row = int(np.floor(camera.fy * down / away + camera.cy))
        if not (0 <= column < camera.width and 0 <= row < camera.height):
            continue
        from_middle = np.linalg.norm(place - grid.center)
        truncation = 1.5 * (max(from_middle / radius, 1) ** 2 if radius else 1)
        distance = (depth[row, column] - away) / truncation
        if distance >= -1:
            share[at] = 2 * (behind if distance < 0 else 1)
            own[at] = share[at] * min(distance, 1)
    assert 0.02 < (share > 0).mean() < 0.9
    np.testing.assert_allclose(weight, share, atol=1e-6)
    np.testing.assert_allclose(total, own, atol=1e-5)


def test_a_grid_is_fine_where_the_cameras_are():
    """Three fifths of what is seen are a subject, the rest a background a hundred times as far."""
    rng = np.random.default_rng(2)
    around = rng.normal(size=(4000, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    points = around * np.repeat([1.0, 100.0], [2400, 1600])[:, None]
    cameras = [look_at(place, (0, 0, 0), **LENS) for place in 0.1 * around[:9]]
    grid = grid_of(points, cameras, 128)
    assert max(grid.shape) <= 130
    assert grid.voxel < 0.06
    low, high = grid.low, grid.low + grid.voxel * (np.array(grid.shape) - 1)
    contracted = grid.contracted(points)
    assert ((low <= contracted) & (contracted <= high)).all(axis=1).mean() > 0.98
    far = [look_at(place, (0, 0, 0), **LENS) for place in 20 * around[:9]]
    assert grid_of(points, far, 128).radius > 20, "as far around as cameras are"
    assert grid_of(points[:2400], cameras, 128).radius == 0, "without a background"


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("skimage", "fast_simplification")),
    reason="install meshsplats[base]",
)
def test_a_small_thing_in_a_large_place(monkeypatch):
    """A ball of radius 0.25 in another of 20: an even grid of 64 points has voxels of 0.6."""
    scene = SplatMesh.joined([ball(0.25), ball(20.0)])
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    lens = {"width": 96, "height": 96, "fov": 26}
    cameras = [look_at(1.2 * axis, (0, 0, 0), up=axis[[1, 2, 0]], **lens) for axis in axes]
    options = {"texture": 0, "rounds": 0, "faces": 4000, "resolution": 64, "shape": "open"}
    found = []
    for far in (fusion._FAR, np.inf):
        monkeypatch.setattr(fusion, "_FAR", far)
        base = make_surface(scene, cameras=cameras, **options)
        away = np.linalg.norm(base.vertices, axis=1)
        found.append(int((np.abs(away - 0.25) < 0.03).sum()))
        # At the border of the images it bends towards the cameras.
        assert np.quantile(away, 0.9) == pytest.approx(20, rel=0.1)
        assert away.max() < 30, "and there is nothing behind it"
    assert found[0] > 40
    assert found[1] == 0
