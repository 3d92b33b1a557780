"""Stereo: truths on planes at known depth, the twin in NumPy, invariances, hostile inputs."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _balls import ball_view, cameras_around
from _stereo_twin import (
    camera_at,
    cameras_on_a_grid,
    consistency,
    grey,
    halved,
    inverse_of_plane,
    pattern,
    rays,
    slanted_scores,
    swept,
    view_of,
)

from meshsplats._core import library
from meshsplats._core import stereo as core_stereo
from meshsplats._core.library import available_variants
from meshsplats._core.stereo import (
    Layout,
    Pairs,
    Planes,
    SurfaceArrays,
    count_consistent,
    fuse_points,
    match_photos,
)
from meshsplats.datasets.views import View, ViewImage
from meshsplats.rendering.core_arguments import camera_struct
from meshsplats.training import stereo
from meshsplats.training.initial import ranges_of_cameras
from meshsplats.training.patches import fused
from meshsplats.training.stereo import Depths, between, confirmed, find_depths, suited_views

FLAT, SLANTED = ((0, 0, 1), 3.0), ((0.6, -0.2, 0.8), 2.4)


def depths_of(views: list[View], near: float = 1.5, far: float = 12.0, threads: int | None = 1) -> Depths:
    points = np.array([[x, y, 3.0] for x in (-0.5, 0, 0.5) for y in (-0.5, 0, 0.5)])
    n = len(views)
    return find_depths(views, np.full(n, near), np.full(n, far), points, threads)


def layout_of(views: list[View]) -> Layout:
    return Layout([camera_struct(replace(view.camera, near=1.0)) for view in views])


def raw_planes(views: list[View], rounds: int, planes: int = 32) -> tuple[np.ndarray, Planes, np.ndarray]:
    """The first view matched with the others: its colours, its planes and the depths that were swept."""
    layout = layout_of(views)
    color = np.concatenate([np.round(255 * view.image).astype(np.uint8).reshape(-1, 3) for view in views])
    others = np.arange(1, len(views), dtype=np.int32)[None]
    pairs = Pairs(np.zeros(1, np.int32), others, np.array([[1 / 12, 1 / 1.5]], np.float32))
    found = match_photos(layout, color, layout_of(views[:1]), pairs, planes=planes, rounds=rounds, threads=1)
    return color, found, np.linspace(1 / 12, 1 / 1.5, planes)


# ---- Truths


@pytest.mark.slow
@pytest.mark.parametrize("plane", [FLAT, SLANTED], ids=["flat", "slanted"])
def test_a_plane_is_found_where_it_is(plane):
    cameras = cameras_on_a_grid(side=(96, 72))
    depths = depths_of([view_of(camera, *plane) for camera in cameras])
    errors, slopes, share = [], [], []
    for i, camera in enumerate(cameras):
        truth, found = inverse_of_plane(camera, *plane), depths.layout.image(depths.sure, i)
        known = found > 0
        share.append(known.mean())
        errors.append(np.abs(found - truth)[known] / truth[known])
        across = np.diff(truth, axis=1).mean()
        slopes.append(np.abs(depths.layout.image(depths.planes.along_x, i) - across)[known] / truth[known])
    assert np.mean(share) > 0.85
    assert np.median(np.concatenate(errors)) < 0.005  # 0.05 pixels
    assert np.quantile(np.concatenate(errors), 0.95) < 0.025
    assert np.median(np.concatenate(slopes)) < 0.002  # the slanted plane has 0.007


def test_points_and_normals_lie_on_the_plane():
    cameras = cameras_on_a_grid(side=(96, 72))
    depths = depths_of([view_of(camera, *SLANTED) for camera in cameras])
    origin = np.array([0.3, -1.0, 2.0])
    surface = depths.surface(origin)
    normal = np.array(SLANTED[0]) / np.linalg.norm(SLANTED[0])
    away = (surface.points + origin) @ normal - SLANTED[1] / np.linalg.norm(SLANTED[0])
    assert np.quantile(np.abs(away), 0.9) < 0.05
    sure = surface.sure == 1
    turn = surface.normals @ normal
    assert np.median(np.abs(turn[sure])) > 0.99
    assert (turn[sure] > 0).mean() > 0.99  # of one sign, so that their mean is a normal
    patches = fused(surface, origin, depths, 200)
    assert len(patches.points) > 100
    away = patches.points @ normal - SLANTED[1] / np.linalg.norm(SLANTED[0])
    assert np.median(np.abs(away)) < 0.01
    assert np.quantile(np.abs(away), 0.9) < 0.04
    assert np.median(np.abs(patches.axes[:, 2] @ normal)) > 0.99


@pytest.mark.slow
def test_outlines_are_not_widened():
    """A square in front of a wall: what is confirmed lies on one of them, and the wall right beside the
    square hardly takes its depth."""

    def view(camera):
        back = view_of(camera, (0, 0, 1), 4.0).image
        front = view_of(camera, (0, 0, 1), 2.0, lambda p: pattern(p[..., [1, 2, 0]] + 3)).image
        places = camera.center + 2 * rays(camera)
        inside = np.abs(places[..., :2]).max(axis=-1) < 0.45
        return View(camera, ViewImage(np.where(inside[..., None], front, back), None)), inside

    cameras = cameras_on_a_grid(step=0.2, side=(120, 90))
    views, insides = zip(*map(view, cameras), strict=True)
    depths = depths_of(list(views))
    found, inside = depths.layout.image(depths.sure, 4), insides[4]
    near, far = np.abs(found * 2 - 1) < 0.05, np.abs(found * 4 - 1) < 0.05
    assert (near | far)[found > 0].mean() > 0.97
    assert near[inside].mean() > 0.6
    assert (near & ~inside).sum() < 0.02 * inside.sum()


def given_depths(maps: list[np.ndarray]) -> tuple[Layout, Planes, np.ndarray, np.ndarray]:
    """What ``confirmed`` takes, for nine views of which each checks all others."""
    layout = layout_of([view_of(camera, *FLAT) for camera in cameras_on_a_grid(step=0.1)])
    inverse = np.concatenate([values.astype(np.float32).ravel() for values in maps])
    neighbors = np.array([[j for j in range(9) if j != i] for i in range(9)], np.int32)
    return layout, Planes(inverse, inverse, inverse, inverse), np.ones(layout.pixels, bool), neighbors


def test_depths_that_other_views_do_not_have_are_dropped():
    """A third of those of one view are too near, a third too far."""
    maps = [inverse_of_plane(camera, *FLAT) for camera in cameras_on_a_grid(step=0.1)]
    factor = np.random.default_rng(0).choice([1.0, 1.3, 0.75], maps[4].shape)
    maps[4] = maps[4] * factor
    layout, planes, fits, neighbors = given_depths(maps)
    kept = layout.image(confirmed(layout, planes, fits, neighbors), 4) > 0
    assert not kept[factor != 1].any()
    lone = np.where(factor == 1, maps[4], 0)  # beside nothing else, as those are dropped for outlines
    layout, planes, fits, neighbors = given_depths([*maps[:4], lone, *maps[5:]])
    kept = layout.image(confirmed(layout, planes, fits, neighbors), 4) > 0
    assert kept[factor == 1].all()
    fits[:] = False
    assert not confirmed(layout, planes, fits, neighbors).any()


def test_rims_of_what_is_in_front_are_dropped():
    """Windows widen a square in front of a wall by a pixel in every view, so that they confirm each other."""
    maps, insides = [], []
    for camera in cameras_on_a_grid(step=0.1):
        reach = np.abs((camera.center + 2 * rays(camera))[..., :2]).max(axis=-1)
        insides.append(reach < 0.4)
        widened = reach < 0.4 + 2 / camera.fx
        maps.append(np.where(widened, 1 / 2, 1 / 4))
    layout, planes, fits, neighbors = given_depths(maps)
    sure = confirmed(layout, planes, fits, neighbors)
    for i, inside in enumerate(insides):
        near = layout.image(sure, i) > 0.4
        assert not near[~inside].any()
        assert near.sum() > 0.5 * inside.sum()


def test_a_plain_wall_is_filled_from_its_frame():
    """The middle of the wall has no texture; its depth is that of the plane around it."""

    def framed(points):
        plain = (np.abs(points[..., :2]) < 0.4).all(axis=-1)
        return np.where(plain[..., None], 0.5, pattern(points))

    cameras = cameras_on_a_grid(step=0.2, side=(96, 72))
    depths = depths_of([view_of(camera, *SLANTED, framed) for camera in cameras])
    truth = inverse_of_plane(cameras[4], *SLANTED)
    filled = depths.layout.image(depths.filled, 4)
    assert (filled > 0).sum() > 100
    error = np.abs(filled - truth)[filled > 0] / truth[filled > 0]
    assert np.median(error) < 0.03
    assert not ((filled > 0) & (depths.layout.image(depths.sure, 4) > 0)).any()


def test_what_one_view_alone_shows_continues_its_surroundings():
    """One column of a wall is known in the left of two views, nothing in the right one: what that has in its
    image, too, should have been matched."""
    left, right = camera_at((0, 0, 0)), camera_at((0.8, 0, 0))
    layout = layout_of([view_of(camera, *FLAT) for camera in (left, right)])
    truth = inverse_of_plane(left, *FLAT)
    inverse, slopes = (np.zeros(layout.pixels, np.float32) for _ in range(2))
    layout.image(inverse, 0)[:, 20:24] = truth[:, 20:24]
    color, counted = np.full((layout.pixels, 3), 128, np.uint8), np.ones(layout.pixels, bool)
    neighbors = np.array([[1], [0]], np.int32)
    filled = between(layout, color, Planes(inverse, slopes, slopes, slopes), counted, neighbors)
    shared = right.in_image(right.project((left.center + 3 * rays(left)).reshape(-1, 3))[0])
    lone = ~shared.reshape(truth.shape)
    lone[:, 20:24] = False
    assert 0.1 < lone.mean() < 0.9
    np.testing.assert_array_equal(layout.image(filled, 0), np.where(lone, truth, 0).astype(np.float32))


def test_patches_are_small_where_there_is_texture():
    rng = np.random.default_rng(0)
    across = rng.uniform(-1, 1, (40000, 2)).astype(np.float32)
    points = np.column_stack([across, np.zeros(len(across), np.float32)])
    textured = across[:, 0] > 0
    checks = (np.floor(across * 12).sum(axis=1) % 2).astype(np.uint8) * 200
    colors = np.where(textured, checks, 90).astype(np.uint8)[:, None].repeat(3, axis=1)
    normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    pixels, sure = np.full(len(points), 0.01, np.float32), np.ones(len(points), np.uint8)
    found = fuse_points(SurfaceArrays(points, normals, pixels, np.ascontiguousarray(colors), sure), 600, 50.0)
    assert len(found.points) == 600
    right = found.points[:, 0] > 0
    assert right.mean() > 0.9
    assert np.median(found.deviations[~right, 0]) > 3 * np.median(found.deviations[right, 0])
    assert found.counts.sum() == len(points)
    error = np.square(found.colors[right] - np.round(found.colors[right] * 255 / 200) * 200 / 255).mean()
    assert error < 0.04  # most patches have one of the two colours; 0.15 by chance


# ---- The twin


def test_the_sweep_is_its_twin():
    views = [view_of(camera, *SLANTED) for camera in cameras_on_a_grid(side=(50, 39))[:4]]
    color, found, inverse = raw_planes(views, rounds=-1)
    greys = [halved(grey(part.reshape(39, 50, 3))) for part in color.reshape(len(views), -1, 3)]
    half = [
        replace(
            v.camera,
            fx=v.camera.fx / 2,
            fy=v.camera.fy / 2,
            cx=v.camera.cx / 2,
            cy=v.camera.cy / 2,
            width=25,
            height=20,
        )
        for v in views
    ]
    best, score = swept(greys[0], half[0], greys[1:], half[1:], inverse)
    score = np.maximum(score, -1)
    # Where pixels of both sizes have their middle in common but for the slopes, which are 0.25 pixels.
    ours = found.score.reshape(39, 50)[::2, ::2]
    assert np.abs(ours - score).max() < 1e-3
    mean = np.stack([found.inverse.reshape(39, 50)[i::2, j::2][:19] for i in (0, 1) for j in (0, 1)]).mean(
        axis=0
    )
    near = (np.abs(mean - best[:19]) < 1e-4)[score[:19] > 0]
    assert len(near) > 200
    assert near.mean() > 0.98  # others have two planes that fit equally


def test_scores_of_slanted_windows_are_those_of_the_twin():
    views = [view_of(camera, *SLANTED) for camera in cameras_on_a_grid(side=(50, 39))[:4]]
    color, found, _ = raw_planes(views, rounds=1)
    greys = [grey(part.reshape(39, 50, 3)) for part in color.reshape(len(views), -1, 3)]
    planes = [values.reshape(39, 50).astype(np.float64) for values in found[:3]]
    cameras = [view.camera for view in views]
    expected = slanted_scores(greys[0], cameras[0], greys[1:], cameras[1:], planes)
    ours = found.score.reshape(39, 50)
    assert np.quantile(np.abs(ours - expected), 0.99) < 2e-3
    before = raw_planes(views, rounds=-1)[1].score
    assert (ours > 0.9).mean() > 0.7
    assert np.mean(ours) > np.mean(before)  # the rounds make them better


def test_witnesses_are_those_of_the_twin():
    cameras = cameras_on_a_grid(side=(24, 18))[:4]
    rng = np.random.default_rng(1)
    maps = []
    for camera in cameras:
        truth = inverse_of_plane(camera, *FLAT) * rng.choice([1, 1, 1.004, 1.05, 0.8], (18, 24))
        maps.append(np.where(rng.random((18, 24)) < 0.8, truth, 0).astype(np.float32))
    layout = layout_of([view_of(camera, *FLAT) for camera in cameras])
    values = np.concatenate([m.ravel() for m in maps])
    neighbors = np.array([[1, 2, 3], [0, -1, 2], [-1, -1, -1], [0, 1, 2]], np.int32)
    found = count_consistent(layout, values, values, neighbors, (0.01, 0.03), 2)
    for i in range(4):
        chosen = [j for j in neighbors[i] if j >= 0]
        agree, past = consistency(
            maps[i], cameras[i], [maps[j] for j in chosen], [cameras[j] for j in chosen], (0.01, 0.03)
        )
        assert np.abs(layout.image(found.agree, i) - agree).sum() <= 2  # rounding at a pixel's border
        assert np.abs(layout.image(found.past, i) - past).sum() <= 2
        assert agree.sum() + past.sum() > 20 or i == 2


def test_counts_of_views_are_those_of_numpy():
    cameras = cameras_on_a_grid(side=(24, 18))
    depths = depths_of([view_of(camera, *FLAT) for camera in cameras])
    points = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 5], (300, 3))
    agree, past = depths.counts(points)
    expected = np.zeros((2, 300), int)
    for i, camera in enumerate(cameras):
        at, z = camera.project(points)
        rows = np.flatnonzero(camera.in_image(at))
        u, v = at[rows].astype(int).T
        known = depths.layout.image(depths.sure, i)[v, u]
        ratio = z[rows] * known
        expected[0, rows] += (known > 0) & (np.abs(ratio - 1) < 2 * stereo.AGREEMENT)
        expected[1, rows] += (known > 0) & (ratio < 1 - 2 * stereo.PAST)
    assert np.array_equal([agree, past], expected)
    assert agree.max() > 3
    assert past[points[:, 2] < 2.5].max() > 3


# ---- Invariances


def digest(depths: Depths) -> str:
    arrays = (*depths.planes, depths.sure, depths.filled)
    return hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest()


def test_threads_do_not_matter():
    views = [view_of(camera, *SLANTED) for camera in cameras_on_a_grid()]
    one, three = depths_of(views, threads=1), depths_of(views, threads=3)
    assert digest(one) == digest(three)
    surface = one.surface(np.zeros(3))
    for a, b in zip(fuse_points(surface, 300, 8.0, 1), fuse_points(surface, 300, 8.0, 3), strict=True):
        assert np.array_equal(a, b)


def test_the_order_of_the_views_does_not_matter():
    rng = np.random.default_rng(3)  # no two suit another equally
    places = rng.uniform([-0.4, -0.4, -0.1], [0.4, 0.4, 0.1], (9, 3))
    views = [view_of(camera_at(place), *SLANTED) for place in places]
    order = np.random.default_rng(2).permutation(len(views))
    one, other = depths_of(views), depths_of([views[i] for i in order])
    same = []
    for place, i in enumerate(order):
        a, b = one.layout.image(one.sure, i), other.layout.image(other.sure, place)
        same.append((a == b).mean())
    assert min(same) == 1


CODE = """
import sys
sys.path[:0] = [{here!r}, {above!r}]
from test_stereo import SLANTED, cameras_on_a_grid, depths_of, digest, view_of
from meshsplats._core.library import load_core
depths = depths_of([view_of(camera, *SLANTED) for camera in cameras_on_a_grid()])
print(load_core().ms_variant().decode(), digest(depths))
"""


@pytest.mark.slow
@pytest.mark.parametrize("variant", available_variants())
def test_every_instruction_set_gives_the_same_bits(variant):
    here = Path(__file__).resolve().parent
    code = CODE.format(here=str(here), above=str(here.parent))
    environment = {**os.environ, "MESHSPLATS_VARIANT": variant}
    result = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    expected = digest(depths_of([view_of(camera, *SLANTED) for camera in cameras_on_a_grid()]))
    assert result.stdout.split() == [variant, expected]


def test_depths_have_the_scale_of_the_scene():
    near = [view_of(camera, *SLANTED) for camera in cameras_on_a_grid()]
    far = [View(camera_at(50 * view.camera.center, name=view.name), view.source) for view in near]
    small = depths_of(near)
    points = 50 * np.array([[x, y, 3.0] for x in (-0.5, 0, 0.5) for y in (-0.5, 0, 0.5)])
    large = find_depths(far, np.full(9, 75.0), np.full(9, 600.0), points, 1)
    both = (small.sure > 0) & (large.sure > 0)
    assert both.mean() > 0.95 * (small.sure > 0).mean()
    assert np.median(np.abs(50 * large.sure[both] / small.sure[both] - 1)) < 1e-4


# ---- Views that suit each other


def test_views_at_good_angles_are_matched():
    cameras = [camera_at((x, 0, 0)) for x in (0.0, 0.01, 0.4, 0.45, 2.9)]
    points = np.array([[0.0, 0, 3], [0.1, 0, 3]])
    order, suited = suited_views(cameras, points, [0])[0]
    assert order[0] in (2, 3)
    assert suited[0] == 0
    assert suited[2] > 5 * suited[1]  # hardly any parallax
    away = camera_at((0.3, 0, 0)).world_to_camera.copy()
    away[[0, 2], :3] *= -1
    turned = replace(cameras[2], world_to_camera=away)
    assert suited_views([cameras[0], turned], points, [0])[0] == ([], pytest.approx([0, 0]))


def test_only_photographs_that_take_part_are_read(monkeypatch):
    """So that thousands of them need no more memory."""
    monkeypatch.setattr(stereo, "REFERENCES", 2)
    monkeypatch.setattr(stereo, "SOURCES", 2)
    read = []
    original = stereo._read
    monkeypatch.setattr(stereo, "_read", lambda view, *rest: (read.append(view), original(view, *rest)))
    views = [view_of(camera, *FLAT) for camera in cameras_on_a_grid()]
    depths = depths_of(views)
    assert len(depths.cameras) == 2
    assert len(read) <= 6
    assert stereo.matching_bytes(views[:2]) < stereo.matching_bytes(views)
    assert stereo.matching_bytes(views[:8]) == stereo.matching_bytes(100 * views[:8])


# ---- Hostile inputs


def plain(camera, value: float = 0.5) -> View:
    return View(camera, ViewImage(np.full((camera.height, camera.width, 3), value, np.float32), None))


@pytest.mark.parametrize(
    "views",
    [
        [plain(camera) for camera in cameras_on_a_grid()],
        [view_of(camera_at((0, 0, 0)), *FLAT) for _ in range(4)],
        [plain(camera, v) for v, camera in zip((0.1, 0.9, 0.4), cameras_on_a_grid(), strict=False)],
    ],
    ids=["no texture", "one place", "flashes"],
)
def test_nothing_is_confirmed_where_nothing_can_be_known(views):
    depths = depths_of(list(views))
    assert (depths.sure > 0).mean() < 0.01
    assert len(depths.surface(np.zeros(3)).points) == np.count_nonzero(depths.sure) + np.count_nonzero(
        depths.filled
    )


def test_noise_is_hardly_confirmed():
    rng = np.random.default_rng(0)
    views = [
        View(c, ViewImage(rng.random((c.height, c.width, 3)).astype(np.float32), None))
        for c in cameras_on_a_grid()
    ]
    assert (depths_of(views).sure > 0).mean() < 0.1


@pytest.mark.parametrize("side", [(1, 1), (2, 1), (1, 7), (3, 3)])
def test_tiny_photographs(side):
    depths = depths_of([plain(camera) for camera in cameras_on_a_grid(side=side)])
    assert depths.sure.shape == (9 * side[0] * side[1],)
    assert np.isfinite(depths.planes.inverse).all()


def test_photographs_of_different_sizes():
    cameras = [camera_at((0.3 * i, 0, 0), (60 + 7 * i, 40 + 5 * i)) for i in range(5)]
    depths = depths_of([view_of(camera, *FLAT) for camera in cameras])
    found = depths.sure[depths.sure > 0]
    assert len(found) > 0.5 * len(depths.sure)
    assert np.median(np.abs(found * 3 - 1)) < 0.01


def test_one_depth_and_cameras_far_away():
    views = [view_of(camera, *FLAT) for camera in cameras_on_a_grid()]
    depths = depths_of(views, near=3.0, far=3.0)
    assert np.abs(depths.planes.inverse[depths.sure > 0] * 3 - 1).max() < 1e-3
    moved = [View(camera_at((1e9 * (i % 2), 0, 0)), view.source) for i, view in enumerate(views)]
    assert np.isfinite(depths_of(moved).planes.inverse).all()


def test_masked_pixels_have_no_depth():
    views = []
    for camera in cameras_on_a_grid():
        view = view_of(camera, *FLAT)
        mask = np.ones(view.image.shape[:2], bool)
        mask[10:30, 20:40] = False
        views.append(replace(view, source=ViewImage(view.image, None, mask)))
    depths = depths_of(views)
    for i in range(len(views)):
        for values in (depths.sure, depths.filled):
            assert not depths.layout.image(values, i)[10:30, 20:40].any()
    assert (depths.sure > 0).mean() > 0.5


def test_the_core_refuses_photographs_that_are_not_there():
    views = [view_of(camera, *FLAT) for camera in cameras_on_a_grid()[:2]]
    layout = layout_of(views)
    color = np.zeros((layout.pixels, 3), np.uint8)
    limits = np.ones((1, 2), np.float32)
    for photo, source in ((0, 2), (2, 1), (-1, 1)):
        pairs = Pairs(np.array([photo], np.int32), np.array([[source]], np.int32), limits)
        with pytest.raises(ValueError, match=r"photograph -?[0-9]+ of 2"):
            match_photos(layout, color, layout_of(views[:1]), pairs, planes=4, rounds=1, threads=1)
    planes = Planes(*np.zeros((4, layout.pixels), np.float32))
    neighbors = np.array([[5], [0]], np.int32)
    with pytest.raises(ValueError, match="view 5 of 2"):
        confirmed(layout, planes, np.ones(layout.pixels, bool), neighbors, 1)


def test_fusion_of_few_points(monkeypatch):
    def surface(n):
        points = np.zeros((n, 3), np.float32)
        return SurfaceArrays(
            points, points, np.ones(n, np.float32), np.zeros((n, 3), np.uint8), np.ones(n, np.uint8)
        )

    counts = []

    def runs(name, struct):
        library.run(name, struct)
        counts.append(struct.found)

    monkeypatch.setattr(core_stereo, "run", runs)
    assert len(fuse_points(surface(0), 5, 8.0).points) == 0
    assert len(fuse_points(surface(100), 0, 8.0).points) == 0  # nor is anything written
    assert counts == [0, 0]
    for n in (1, 2, 100):  # points in one place have no plane
        found = fuse_points(surface(n), 5, 8.0)
        assert found.counts.sum() == n
        assert np.allclose(found.axes @ found.axes.transpose(0, 2, 1), np.eye(3), atol=1e-5)


@pytest.mark.nightly
def test_matched_photographs_show_a_ball_without_known_points():
    room = [ball_view(camera, backdrop=True) for camera in cameras_around(48, side=96)]
    near, far, targets = ranges_of_cameras(room)
    depths = find_depths(room, near, far, targets)
    points = depths.surface(np.zeros(3)).points
    radius = np.linalg.norm(points, axis=1)
    ball = radius < 3
    assert ball.sum() > 2000
    assert np.median(np.abs(radius[ball] - 1)) < 0.03
    outside = np.random.default_rng(0).normal(size=(100, 3))
    outside *= 1.5 / np.linalg.norm(outside, axis=1, keepdims=True)
    assert (depths.counts(outside)[1] > 0).mean() > 0.8  # what views see past
    assert (depths.counts(0.6 * outside / 1.5)[1] > 3).mean() < 0.1
