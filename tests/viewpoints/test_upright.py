"""Which way is up in a place: heights at which floors and tables lie, and files that are read."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_finding_cameras import moved, room

from meshsplats.cameras.framing import guess_up
from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion.streaming import convert_blocks
from meshsplats.datasets.scene_files import SceneReading
from meshsplats.demo_scene import make_scene
from meshsplats.demo_scene.room import make_room
from meshsplats.errors import DataWarning
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.formats.streaming import stream_gaussians
from meshsplats.operations.inspection import describe
from meshsplats.tiles.building import build_tiles
from meshsplats.tiles.options import TileOptions
from meshsplats.tiles.tileset import Tileset
from meshsplats.viewpoints import finding, kind, standing
from meshsplats.viewpoints.finding import BY_FLOORS, BY_SURVEY, find_cameras, first_impression, unusual_up
from meshsplats.viewpoints.kind import surely_object
from meshsplats.viewpoints.search import FEW, find_places
from meshsplats.viewpoints.standing import thinned
from meshsplats.viewpoints.upright import LEVEL_GROUND, MEASURED, aligned, levelled

USUAL = np.array([0.0, -1, 0])


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def turn(axis: int, angle: float) -> np.ndarray:
    """(3, 3) rotation by ``angle`` degrees about a coordinate axis."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    x, y = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[[x, x, y, y], [x, y, x, y]] = c, -s, s, c
    return matrix


def storeys(count: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """Points on a floor, a table and a ceiling, 1 % thick, z up; and a third of points all around."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (count, 3))
    level = np.arange(count) % 3 < 2
    heights = rng.choice([-0.5, -0.2, 0.6], count, p=[0.6, 0.1, 0.3])
    points[level, 2] = (heights + rng.normal(size=count) * 0.005)[level]
    return points, rng.uniform(0.5, 1, count)


@given(st.floats(-8, 8), st.floats(-8, 8), st.floats(-180, 180))
def test_heights_tell_up_exactly(first, second, around):
    points, weights = storeys()
    moved_by = turn(1, around) @ turn(0, around) @ turn(2, 30)
    up = moved_by[:, 2]
    start = moved_by @ (turn(0, first) @ turn(1, second))[:, 2]
    found, gathered = levelled(points @ moved_by.T + [5, -3, 2], weights, start, 1.0)
    assert degrees(found, up) < 0.4
    assert gathered > LEVEL_GROUND


def test_of_a_cloud_no_direction_is_level():
    rng = np.random.default_rng(2)
    _, gathered = levelled(rng.normal(size=(3000, 3)), np.ones(3000), USUAL, 1.0)
    assert gathered < 1.2
    assert levelled(np.empty((0, 3)), np.empty(0), USUAL, 1.0) == (USUAL, 0.0)


def test_an_axis_that_is_close_was_meant():
    assert aligned((turn(0, 2.5))[:, 2]).tolist() == [0, 0, 1]
    assert aligned((turn(0, 2.5))[:, 1] * -1).tolist() == [0, -1, 0]
    off = turn(0, 4)[:, 2]
    assert aligned(off) is off


@pytest.fixture(scope="module")
def furnished():
    return make_room(12_000)


@pytest.mark.slow
def test_a_room_that_leans_is_put_upright(furnished):
    lean = turn(2, 9) @ turn(0, -7)
    found = unusual_up(moved(furnished, 1, lean, np.zeros(3)))
    assert found is not None
    assert found.reason == BY_FLOORS
    assert degrees(found.up, lean @ USUAL) < 0.7


def test_a_room_that_was_turned_before_stands_exactly(furnished):
    z_up = moved(furnished, 1, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3))
    found = unusual_up(z_up)
    assert found is not None
    assert found.up.tolist() == [0, 0, 1]


@pytest.mark.slow
def test_a_first_impression_is_upright(furnished):
    scene = first_impression(moved(furnished, 1, turn(0, 90), np.zeros(3)))
    assert scene is not None
    assert scene.up == pytest.approx(turn(0, 90) @ USUAL, abs=1e-12)
    assert scene.up_confidence >= 0.8


@pytest.mark.slow
def test_the_usual_way_up_is_nothing_to_tell(furnished):
    assert unusual_up(furnished) is None
    assert unusual_up(room(9000, 3000)) is None


def test_a_glance_tells_objects(furnished, monkeypatch):
    """At some of the splats, each as much wider, and at all of them."""
    ball = make_scene(12_000)
    for some in (80_000, 4000):
        monkeypatch.setattr(kind, "FEW_SPLATS", some)
        assert surely_object(ball, USUAL)
        assert not surely_object(furnished, USUAL)
    field = replace(ball, means=ball.means * np.float32([30, 0.1, 30]))
    monkeypatch.setattr(kind, "LANDSCAPE", 10_000)
    assert not surely_object(field, USUAL)


def test_that_ground_slopes_does_not_turn_a_landscape(monkeypatch):
    still = make_scene(12_000)
    field = replace(still, means=still.means * np.float32([30, 0.1, 30]))
    monkeypatch.setattr(kind, "LANDSCAPE", 10_000)
    monkeypatch.setattr("meshsplats.viewpoints.finding.find_places", None)
    slope = moved(field, 1, turn(2, 6), np.zeros(3))
    assert kind.kind_from_outside(slope, USUAL)[0] == "aerial"
    assert unusual_up(slope) is None


def test_in_few_splats_no_floor_is_looked_for(furnished, monkeypatch):
    monkeypatch.setattr("meshsplats.viewpoints.finding.find_places", None)
    few = furnished.take(np.arange(0, len(furnished), 2))
    assert unusual_up(moved(few, 1, turn(2, 9), np.zeros(3))) is None


@pytest.mark.slow
def test_all_that_reads_a_file_agrees(furnished, tmp_path, monkeypatch):
    lean = turn(2, 9)
    save_gaussians(moved(furnished, 1, lean, np.zeros(3)), tmp_path / "room.ply")

    class Telling(SceneReading):
        def tell(self, text: str) -> None:
            said.append(text)

    said: list[str] = []
    cloud, stream = Telling().load(tmp_path / "room.ply"), Telling().stream(tmp_path / "room.ply")
    assert degrees(cloud.up.astype(float), lean @ USUAL) < 0.7
    assert np.array_equal(cloud.up, stream.up.astype(np.float32))
    assert [part.up.tolist() for part in convert_blocks(stream)] == [cloud.up.tolist()]
    assert len(said) == 2
    assert said[0] == said[1]
    assert "as floors or ground are level (likely); if that is wrong" in said[0]
    # Up is told by now, and any views will do.
    monkeypatch.setattr(finding, "find_places", partial(find_places, rounds=FEW))
    upright = find_cameras(cloud, 4)
    assert upright.up_confidence == 1
    right = np.array([camera.world_to_camera[0, :3] for camera in upright.cameras])
    assert np.abs(right @ upright.up).max() < 1e-6


def test_what_stands_for_others_is_wider(monkeypatch):
    cloud = room(3000, 100)
    monkeypatch.setattr(standing, "MOST", 1000)
    few = thinned([cloud])
    assert len(few) == -(-len(cloud) // 4)
    assert few.scales == pytest.approx(2 * cloud.scales[::4])


UTM = np.array([500_000.0, 4_500_000.0, 100.0])


@pytest.mark.parametrize(
    ("at", "up"),
    [
        (UTM, [0, 0, 1]),
        (UTM[[0, 2, 1]] * [1, -1, 1], USUAL),  # turned to y up, and read as such
        ([3000, 2000, 100], USUAL),
        ([6_378_000, 0, 0.5], [0, 0, 1]),  # a survey, or on the globe and its equator
        ([12_756_000, 0, 400_000], USUAL),
    ],
)
def test_a_survey_has_z_up(at, up):
    far = replace(make_scene(500), up=None, origin=np.array(at, float))
    assert guess_up(far).tolist() == list(up)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # of what float32 loses there
        assert guess_up(far.relative_to(np.zeros(3))).tolist() == list(up)
    assert guess_up(replace(far, up=np.array(USUAL))).tolist() == list(USUAL)


def test_cameras_of_a_survey_lean_and_others_win():
    far = replace(make_scene(500), up=None, origin=UTM)
    leaning = orbit(far, 1, elevation=30, up=(0, 0, 1))
    assert guess_up(far, leaning).tolist() == [0, 0, 1]
    assert guess_up(far, orbit(far, 4, up=USUAL)) == pytest.approx(USUAL)


@pytest.mark.slow
def test_what_a_survey_shows_wins(furnished):
    z_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    leaning = replace(moved(furnished, 1, turn(0, 9) @ z_up, np.zeros(3)), origin=UTM)
    found = unusual_up(leaning)
    assert found is not None
    assert (found.up.tolist(), found.reason) == ([0, 0, 1], BY_SURVEY)
    found = unusual_up(replace(furnished, origin=UTM))
    assert found is not None
    assert (found.up.tolist(), found.reason) == (USUAL.tolist(), BY_FLOORS)


def test_all_that_is_made_of_a_survey_stands_alike(tmp_path):
    still = moved(make_scene(3000), 1, turn(0, -90), np.zeros(3))
    save_gaussians(replace(still, up=None, origin=UTM), tmp_path / "still.ply")

    class Telling(SceneReading):
        def tell(self, text: str) -> None:
            said.append(text)

    said: list[str] = []
    cloud = Telling().load(tmp_path / "still.ply")
    streams = [Telling().stream(tmp_path / "still.ply", origin) for origin in (None, (0.0, 0, 0))]
    assert [scene.up.tolist() for scene in (cloud, *streams)] == [[0, 0, 1]] * 3
    assert len(set(said)) == 1
    assert said[0].startswith("up: z, as in coordinates of surveys, which these look like; if that is wrong")
    blocks = stream_gaussians(tmp_path / "still.ply", block=1000)
    assert unusual_up(thinned(blocks)).up.tolist() == [0, 0, 1]
    options = TileOptions(alpha="blend", max_triangles=100_000)
    build_tiles(blocks, tmp_path / "tiles", options)
    assert Tileset(tmp_path / "tiles").up.tolist() == [0, 0, 1]
    assert [part.up.tolist() for part in convert_blocks(blocks)] == [[0, 0, 1]]
    seen = find_cameras(cloud.take(slice(None)), 1)
    assert seen.up.tolist() == [0, 0, 1]
    assert describe(tmp_path / "still.ply")["up_found"] == [0, 0, 1]
    assert describe(tmp_path / "still.ply")["up_confidence"] == MEASURED
