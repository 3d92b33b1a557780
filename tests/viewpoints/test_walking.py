"""A round through views: smooth, level, and through all of them."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from meshsplats.cameras.trajectories import look_at
from meshsplats.cli.images import ViewOptions
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.viewpoints import finding, showing
from meshsplats.viewpoints.walking import keys_of, short_round, walk

UP = np.array([0.0, -1.0, 0.0])


def views(count: int = 8, seed: int = 0):
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        place = rng.uniform(-2, 2, 3)
        gaze = rng.normal(size=3) * [1, 0.3, 1]
        fov, near = rng.uniform(40, 80), rng.uniform(0.02, 0.1)
        found.append(look_at(place, place + gaze, up=UP, width=60, height=40, fov=fov, near=near))
    return found


def pose(camera) -> np.ndarray:
    return np.concatenate([camera.center, camera.world_to_camera[2, :3], [np.log(camera.fx)]])


def test_it_passes_every_view_and_begins_at_the_first():
    keys, frames = views(), walk(views(), 800, UP)
    path = np.array([pose(frame) for frame in frames])
    for key in keys:
        assert np.abs(path - pose(key)).max(axis=1).min() < 0.08
    assert np.allclose(path[0], pose(keys[0]))
    assert (frames[0].width, frames[0].height, frames[0].cx) == (60, 40, 30)
    assert np.isclose(frames[0].near, keys[0].near)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("seed", range(4))
def test_it_has_no_jump_and_no_corner_where_it_closes_neither(seed):
    def roughness(count: int, order: int) -> float:
        path = np.array([pose(frame) for frame in walk(views(seed=seed), count, UP)])
        closed = np.concatenate([path, path[:order]])
        return float(np.abs(np.diff(closed, order, axis=0)).max())

    # Steps shrink with their length, changes of steps with its square.
    assert roughness(400, 1) < 0.6 * roughness(200, 1)
    assert roughness(400, 2) < 0.35 * roughness(200, 2)


def test_it_is_level():
    frames = walk(views(), 50, UP)
    assert len(frames) == 50
    for frame in frames:
        assert abs(frame.world_to_camera[0, :3] @ UP) < 1e-9
        assert frame.up @ UP > 0


def test_views_of_a_turn_are_passed_in_order_of_their_direction():
    angles = np.radians(np.arange(0, 360, 45))
    turn = [look_at((0, 0, 0), (np.cos(a), 0, np.sin(a)), up=UP, near=0.1) for a in angles]
    frames = walk([turn[k] for k in (0, 3, 6, 1, 4, 7, 2, 5)], 16, UP)
    gaze = np.array([frame.world_to_camera[2, :3] for frame in frames])
    assert np.allclose(np.sum(gaze * np.roll(gaze, 1, axis=0), axis=1), np.cos(np.pi / 8), atol=1e-6)


def test_one_view_stays_and_two_are_gone_between():
    (only,) = views(1)
    still = walk([only], 5, UP)
    assert len(still) == 5
    assert all(np.allclose(pose(frame), pose(only)) for frame in still)
    there = np.array([pose(frame) for frame in walk(views(2), 10, UP)])
    assert np.allclose(there[0], pose(views(2)[0]))
    assert np.allclose(there[5], pose(views(2)[1]))


def test_the_round_is_short():
    points = np.random.default_rng(1).normal(size=(7, 2))
    lengths = np.linalg.norm(points[:, None] - points, axis=2)

    def length(tour) -> float:
        return sum(lengths[a, b] for a, b in zip(tour, np.roll(tour, -1), strict=True))

    best = min(length((0, *rest)) for rest in permutations(range(1, 7)))
    tour = short_round(lengths)
    assert tour[0] == 0
    assert sorted(tour) == list(range(7))
    assert length(tour) < 1.05 * best


def test_a_few_frames_are_views_of_their_own():
    """Stills, not the same place again and again."""
    assert [keys_of(count) for count in (1, 8, 12, 60, 600)] == [1, 8, 12, 12, 12]
    found = views(8)
    stills = walk(found, 8, UP)
    assert np.array_equal(pose(stills[0]), pose(found[0]))
    assert len({tuple(camera.center) for camera in stills}) == 8
    assert {tuple(camera.center) for camera in stills} == {tuple(camera.center) for camera in found}


@pytest.mark.parametrize(("count", "frames"), [(0, 3), (3, 0)])
def test_nothing_to_walk_through_is_refused(count, frames):
    with pytest.raises(ValueError, match="needs a camera and a frame"):
        walk(views(count), frames, UP)


@pytest.fixture
def place(monkeypatch) -> GaussianCloud:
    """Splats in which any number of views is found."""

    def found(cloud, count, **_):
        return finding.FoundCameras("place", 0.4, UP, 1.0, 0.0, 3.0, tuple(views(count)))

    monkeypatch.setattr(showing, "find_cameras", found)
    points = np.random.default_rng(2).normal(size=(30, 3))
    turns = np.tile([1.0, 0, 0, 0], (30, 1))
    return GaussianCloud(points, turns, np.full((30, 3), 0.01), np.full(30, 0.9), np.zeros((30, 1, 3)))


def places_of(cameras) -> np.ndarray:
    return np.array([camera.center for camera in cameras])


def test_an_orbit_in_a_place_is_a_round(place):
    frames = ViewOptions(orbit=18).make(place, Path("x.ply"), count=5, side=20)
    assert np.array_equal(places_of(frames), places_of(walk(views(12), 18, UP)))
    film = ViewOptions().make(place, Path("x.ply"), count=24, side=20, film=True)
    assert np.array_equal(places_of(film), places_of(walk(views(12), 24, UP)))


def test_views_that_are_no_film_are_those_found(place):
    frames = ViewOptions().make(place, Path("x.ply"), count=8, side=20)
    assert np.array_equal(places_of(frames), places_of(views(8)))


def test_an_orbit_that_says_where_it_is_stays_a_circle(place):
    frames = ViewOptions(orbit=18, elevation=15.0).make(place, Path("x.ply"), count=8, side=20)
    apart = np.linalg.norm(places_of(frames) - places_of(frames).mean(axis=0), axis=1)
    assert np.allclose(apart, apart[0], rtol=1e-6)
