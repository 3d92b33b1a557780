"""Cameras: projection, placement around a scene, and camera files."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from _local import shared_data
from hypothesis import given
from hypothesis import strategies as st

from meshsplats import bind, convert
from meshsplats.cameras.files import load_cameras, save_cameras
from meshsplats.cameras.framing import front_axes, guess_up, scene_bounds, weighted_quantile
from meshsplats.cameras.placing import inside_cameras, outside_cameras
from meshsplats.cameras.trajectories import distance_of, dome, look_around, look_at, orbit
from meshsplats.errors import FileFormatError
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

OURS = {
    "name": "a",
    "width": 4,
    "height": 2,
    "fx": 3.0,
    "fy": 3.5,
    "cx": 1.75,
    "cy": 1.25,
    "world_to_camera": [[1, 0, 0, 0.5], [0, 0, -1, 0.25], [0, 1, 0, 3], [0, 0, 0, 1]],
}
INRIA = {
    "id": 0,
    "img_name": "b",
    "width": 4,
    "height": 2,
    "position": [1.0, 2.0, 3.0],
    # Columns: the camera's x axis is the world's y, its y axis the world's -x, its z axis the world's z.
    "rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "fx": 3.0,
    "fy": 3.5,
}


def make_cloud(means: np.ndarray, opacities: np.ndarray | None = None) -> GaussianCloud:
    n = len(means)
    return GaussianCloud(
        means,
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), 0.01),
        np.full(n, 0.9) if opacities is None else opacities,
        np.zeros((n, 1, 3)),
    )


def ball(n: int = 2000, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * rng.uniform(0, 1, (n, 1)) ** (1 / 3)


def test_look_at_by_hand():
    """y points down: from -z, looking along +z, the world's x is to the right and its -y up."""
    camera = look_at([0, 0, -5], [0, 0, 0], width=200, height=100, fov=90)
    assert camera.fx == pytest.approx(50)  # the shorter side spans 90 degrees: 50 px at 45 degrees
    pixels, depth = camera.project(np.array([[0, 0, 0], [1, 0, 0], [0, -1, 0], [1, -1, 5]]))
    np.testing.assert_allclose(pixels, [[100, 50], [110, 50], [100, 40], [105, 45]], atol=1e-9)
    np.testing.assert_allclose(depth, [5, 5, 5, 10])
    np.testing.assert_allclose(camera.center, [0, 0, -5], atol=1e-12)
    np.testing.assert_allclose(camera.up, [0, -1, 0], atol=1e-12)


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0), (-1, 0, 0)])
def test_straight_down_is_still_a_camera(up):
    up = np.array(up, float)
    camera = look_at(3 * up, [0, 0, 0], up=up)
    np.testing.assert_allclose(camera.world_to_camera[2, :3], -up, atol=1e-12)
    # The limit of coming up from the front: what lies behind the subject is at the upper edge.
    np.testing.assert_allclose(camera.up, front_axes(up)[2], atol=1e-12)


@pytest.mark.parametrize(
    ("up", "forward"), [((0, -1, 0), (0, 0, 1)), ((0, 1, 0), (0, 0, -1)), ((0, 0, 1), (0, 1, 0))]
)
def test_front_of_the_three_usual_frames(up, forward):
    np.testing.assert_allclose(front_axes(np.array(up, float)), [(1, 0, 0), up, forward], atol=1e-15)


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_front_axes_are_a_right_handed_frame(up):
    up = np.array(up) / np.linalg.norm(up)
    right, upward, forward = axes = front_axes(up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(np.cross(upward, right), forward, atol=1e-9)
    np.testing.assert_allclose(upward, up)


def test_orbit_by_hand():
    """Four cameras at the height of the subject: in front, at the right-hand side, behind, at the left."""
    cameras = orbit(ball(), 4, elevation=0)
    target = np.mean([c.center for c in cameras], axis=0)
    np.testing.assert_allclose(target, 0, atol=0.05)
    directions = [(c.center - target) / np.linalg.norm(c.center - target) for c in cameras]
    np.testing.assert_allclose(directions, [(0, 0, -1), (1, 0, 0), (0, 0, 1), (-1, 0, 0)], atol=1e-9)
    above = orbit(ball(), 1, elevation=30, azimuth=0)[0].world_to_camera[2, :3]
    np.testing.assert_allclose(above, (0, 0.5, 0.75**0.5), atol=1e-9)


def test_orbit_frames_a_ball():
    """A unit ball is seen whole, and fills the image: its outline lies at 1 / sin of the half angle."""
    camera = orbit(ball(20000), 1, elevation=0, fov=60, width=400, height=300)[0]
    pixels, depth = camera.project(ball(20000, seed=1))
    assert depth.min() > camera.near
    assert ((pixels > 0) & (pixels < [400, 300])).all(axis=1).mean() > 0.98
    assert np.ptp(pixels[:, 1]) > 0.85 * 300
    assert 1.6 < np.linalg.norm(camera.center) < 2.1


@given(st.integers(0, 3), st.floats(-2, 2), st.floats(0.01, 100), st.integers(0, 2))
def test_framing_follows_the_scene(seed, shift, scale, up_axis):
    """Moving and scaling the scene moves and scales the cameras, whatever the axis that points up."""
    up = np.zeros(3)
    up[up_axis] = 1
    points = ball(300, seed) * [1, 2, 0.5]
    plain = orbit(points, 3, up=up)
    moved = orbit(points * scale + shift, 3, up=up)
    for a, b in zip(plain, moved, strict=True):
        np.testing.assert_allclose(b.center, a.center * scale + shift, rtol=1e-6, atol=1e-6 * scale)
        np.testing.assert_allclose(b.world_to_camera[:3, :3], a.world_to_camera[:3, :3], atol=1e-6)
        assert b.near == pytest.approx(a.near * scale)


def test_strays_and_surroundings_do_not_move_the_frame():
    subject = ball(2000)
    rng = np.random.default_rng(1)
    strays = rng.normal(size=(40, 3)) * 1e4
    faint = rng.normal(size=(3000, 3)) * 10
    cloud = make_cloud(subject)
    noisy = make_cloud(
        np.concatenate([subject, strays, faint]),
        np.concatenate([np.full(2040, 0.9), np.full(3000, 1e-3)]),
    )
    a, b = orbit(cloud, 1)[0], orbit(noisy, 1)[0]
    assert np.linalg.norm(a.center - b.center) < 0.15 * np.linalg.norm(a.center)


def test_the_subject_is_in_the_middle_of_the_images():
    """A plate seen from above is nearer at its lower edge, which then takes more of the image."""
    rng = np.random.default_rng(0)
    plate = rng.uniform(-1, 1, (5000, 3)) * [1, 0.05, 1]
    around = orbit(plate, 4, elevation=25, azimuth=45, width=400, height=400)
    single = orbit(plate, 1, elevation=25, azimuth=20, width=400, height=400)
    for camera in [*around, *single]:
        pixels = camera.project(plate)[0]
        middle = (pixels.min(axis=0) + pixels.max(axis=0)) / 2
        np.testing.assert_allclose(middle, [200, 200], atol=12)


def test_dome_is_even_and_upper():
    for whole in (False, True):
        cameras = dome(ball(), 400, whole=whole)
        d = -np.array([c.world_to_camera[2, :3] for c in cameras])
        heights = np.sort(-d[:, 1])
        even = np.linspace(-1 if whole else 0, 1, 401)
        np.testing.assert_allclose(heights, (even[1:] + even[:-1]) / 2, atol=0.01)
        # No two cameras sit together: n evenly spread points are about sqrt(4 pi / n) from their neighbours.
        apart = np.linalg.norm(d[:, None] - d[None], axis=2) + 9 * np.eye(400)
        assert apart.min() > 0.6 * np.sqrt((4 if whole else 2) * np.pi / 400)


def test_the_distance_of_a_camera_is_that_from_which_it_frames_the_subject():
    """Whatever its near plane: levels in Blender change by it."""
    for camera in (dome(ball(), 3, target=(1, 2, 3))[1], orbit(ball(), 3, target=(1, 2, 3))[2]):
        assert distance_of(camera) == pytest.approx(np.linalg.norm(camera.center - (1, 2, 3)))


def test_look_around_turns_to_the_right():
    cameras = look_around(ball(), 4)
    forward = [c.world_to_camera[2, :3] for c in cameras]
    np.testing.assert_allclose(forward, [(0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0)], atol=1e-9)
    np.testing.assert_allclose(
        [c.center for c in cameras], np.tile(scene_bounds(ball()).center, (4, 1)), atol=1e-9
    )


def test_guess_up():
    np.testing.assert_array_equal(guess_up(make_cloud(ball(10))), (0, -1, 0))
    mesh = SplatMesh(np.eye(3), [[0, 1, 2]], np.ones((3, 4)), up=(0, 0, 2))
    np.testing.assert_array_equal(guess_up(mesh), (0, 0, 1))
    around = orbit(ball(), 12, elevation=40, up=(0, 0, 1))
    np.testing.assert_allclose(guess_up(mesh, around), (0, 0, 1), atol=1e-9)
    np.testing.assert_allclose(orbit(mesh, 1, elevation=0)[0].up, (0, 0, 1), atol=1e-9)
    # Cameras that hang every way round have no mean up.
    sides = [(0, -1, 0), (0, 1, 0), (1, 0, 0), (-1, 0, 0)] * 2 + [(1, 0, 0)]
    rolled = [look_at((0, 0, -5), (0, 0, 0), up=side) for side in sides]
    np.testing.assert_array_equal(guess_up(None, rolled), (0, -1, 0))


def test_cameras_placed_upright_tell_up_exactly():
    """Whatever their number and heights: the mean of their own up directions leans by degrees."""
    cloud = make_cloud(ball(200))
    for number in (5, 8, 40, 41, 200):
        for placed in outside_cameras(cloud, number), inside_cameras(cloud, number):
            np.testing.assert_allclose(guess_up(None, placed), (0, -1, 0), atol=1e-9)
    down = [look_at((np.sin(a), -2, np.cos(a)), (0, 0, 0), up=(0, -1, 0)) for a in (0.0, 0.6, 1.3)]
    np.testing.assert_allclose(guess_up(None, down), (0, -1, 0), atol=1e-9)


def test_cameras_on_one_side_tell_up_though_all_look_down():
    """Along 18 degrees, held by hand, 30 degrees down: the mean of their own up directions leans as far."""
    rng = np.random.default_rng(3)
    held = []
    for angle in np.radians(np.linspace(-9, 9, 20)):
        place = (5 * np.sin(angle), -5 * np.tan(np.radians(30)), -5 * np.cos(angle))
        held.append(look_at(place, (0, 0, 0), up=(np.tan(np.radians(rng.normal(0, 1))), -1, 0)))
    assert guess_up(None, held) @ (0, -1, 0) > np.cos(np.radians(10))
    # Held so badly that what is level cannot be told, their mean is the better guess.
    rolled = [
        look_at(camera.center, (0, 0, 0), up=(np.tan(np.radians(roll)), -1, 0))
        for camera, roll in zip(held, rng.permutation(np.linspace(-6, 6, 20)), strict=True)
    ]
    mean = np.mean([camera.up for camera in rolled], axis=0)
    np.testing.assert_allclose(guess_up(None, rolled), mean / np.linalg.norm(mean), atol=1e-9)


def test_cameras_of_one_direction_or_rolled_ones_tell_up_by_their_mean():
    same = [look_at((0.1 * i, -1, -5), (0.1 * i, 0, 0), up=(0, -1, 0)) for i in range(3)]
    np.testing.assert_allclose(guess_up(None, same), same[0].up, atol=1e-9)
    # Half of them hold the camera upright, half on its side: no direction is level for all.
    turns = [look_at((0, 0, -5), (0, 0, 0), up=up) for up in ((0, -1, 0), (1, 0, 0))]
    np.testing.assert_allclose(guess_up(None, turns), (0.5**0.5, -(0.5**0.5), 0), atol=1e-9)


def test_weighted_quantile_by_hand():
    values, weights = np.array([3.0, 1, 2]), np.array([1.0, 1, 8])
    assert [weighted_quantile(values, weights, q) for q in (0, 0.1, 0.11, 0.9, 0.95, 1)] == [1, 1, 2, 2, 3, 3]


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.zeros((5, 3)), np.eye(3)[:1] * 1e6])
def test_a_single_point_is_framed(points):
    camera = orbit(points, 1)[0]
    pixels, depth = camera.project(points)
    np.testing.assert_allclose(pixels, [[400, 400]] * len(points), atol=1e-3)
    assert (depth > camera.near).all()


@pytest.mark.parametrize("options", [{}, {"mode": "flat"}])
def test_a_mesh_is_framed_as_its_splats(options):
    """Its rims, where nothing is seen, do not count, and the reach of its splats does."""
    rng = np.random.default_rng(0)
    spread = rng.uniform((-1, -3, -0.5), (1, 3, 0.5), (600, 3))
    turns, sizes = rng.normal(size=(600, 4)), rng.uniform(0.05, 0.3, (600, 3))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    cloud = GaussianCloud(spread, turns, sizes, rng.uniform(0.6, 1, 600), np.zeros((600, 1, 3)))
    mesh = convert(cloud, **options)
    before, after = (orbit(scene, 4, elevation=30) for scene in (cloud, mesh))
    middle = scene_bounds(cloud).center
    for a, b in zip(before, after, strict=True):
        assert np.linalg.norm(a.center - b.center) < 0.02 * np.linalg.norm(a.center - middle)


def test_a_mesh_prior_is_framed_by_its_triangles():
    """Its splats are the faces of its base: two, whose centres are no points of a sample."""
    corners = np.array([[-1.0, -2, 0], [1, -2, 0], [1, 0, 0], [-1, 0, 0]])
    prior = bind(BaseMesh(corners, np.array([[0, 1, 2], [0, 2, 3]])), triangles=200).mesh
    np.testing.assert_allclose(scene_bounds(prior).center, (0, -1, 0), atol=0.05)


def test_up_that_is_told_counts_within_45_degrees_of_that_of_cameras():
    told = replace(make_cloud(ball(10)), up=np.array([0, 0, 1.0]))
    for degrees, up in ((40, (0, 0, 1)), (50, (0, np.sin(np.radians(50)), np.cos(np.radians(50))))):
        held = (0, np.sin(np.radians(degrees)), np.cos(np.radians(degrees)))
        np.testing.assert_allclose(guess_up(told, orbit(ball(), 12, elevation=0, up=held)), up, atol=1e-6)


def test_a_scatter_of_small_parts_is_framed_whole():
    """Though one of them is large: it has a fifth of all points."""
    large = ball(200) * 0.2
    small = np.array([[x, y, z] for x in (-2, -1, 1, 2) for y in range(-2, 3) for z in range(-2, 3)], float)
    rng = np.random.default_rng(0)
    parts = (small[:, None] + 0.01 * rng.normal(size=(len(small), 8, 3))).reshape(-1, 3)
    assert len(scene_bounds(np.concatenate([large, parts])).points) == len(large) + len(parts)


def test_one_splat_is_framed_by_its_size():
    camera = orbit(make_cloud(np.ones((1, 3))), 1)[0]
    assert 0.02 < np.linalg.norm(camera.center - 1) < 0.2


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: orbit(np.zeros((0, 3)), 3), "empty"),
        (lambda: orbit(np.zeros((4, 2)), 3), "shape"),
        (lambda: orbit(np.full((4, 3), np.nan), 3), "finite"),
        (lambda: orbit(ball(), 0), "count"),
        (lambda: dome(ball(), 0), "count"),
        (lambda: look_around(ball(), 0), "count"),
        (lambda: orbit(ball(), 2.5), "count must be a whole number, got 2.5"),
        (lambda: orbit(ball(), 3, width=0), "width must be a whole number from 1 to 32768, got 0"),
        (lambda: dome(ball(), 3, height=0.5), "height must be a whole number from 1 to 32768, got 0.5"),
        (lambda: look_around(ball(), 3, width=0), "width must be a whole number"),
        (lambda: look_at((1, 1, 1), (1, 0, 1), height=0), "height must be a whole number"),
        (lambda: orbit(ball(), 3, elevation=91), "elevation"),
        (lambda: orbit(ball(), 3, fov=0), "fov"),
        (lambda: orbit(ball(), 3, distance=0), "distance"),
        (lambda: orbit(ball(), 3, up=(0, 0, 0)), "up"),
        (lambda: look_at((1, 1, 1), (1, 1, 1)), "differ"),
        (lambda: look_at((1, 1, 1), (1, 0, 1)).scaled(0), "factor"),
        (
            lambda: look_at((1, 1, 1), (1, 0, 1), width=20_000, height=10).scaled(2),
            r"an image of 20000 x 10 pixels cannot be drawn 2 times as large.*at most 16384",
        ),
    ],
)
def test_what_cannot_be_placed_is_an_error(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@given(st.floats(0.01, 5), st.integers(1, 300), st.integers(1, 300))
def test_scaled_keeps_the_view(factor, width, height):
    camera = look_at((0, 1, -5), (0, 0, 0), width=width, height=height)
    larger = camera.scaled(factor)
    points = ball(20)
    a, b = camera.project(points)[0], larger.project(points)[0]
    np.testing.assert_allclose(a / [width, height], b / [larger.width, larger.height], atol=1e-9)
    assert abs(larger.width - width * factor) <= max(0.5, 1 - width * factor)


def test_a_window_sees_the_same_at_other_columns_and_rows():
    camera = orbit(np.zeros((1, 3)), 1, width=40, height=30, distance=3)[0]
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.3
    part = camera.window(5, -9, 60, 31)
    assert (part.width, part.height) == (60, 31)
    found, whole = part.project(points), camera.project(points)
    np.testing.assert_allclose(found[0] + [5, -9], whole[0], rtol=1e-12)
    np.testing.assert_array_equal(found[1], whole[1])


def test_camera_file_of_ours(tmp_path):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([OURS, {**OURS, "name": "c", "near": 0.5}]))
    first, second = load_cameras(path)
    assert (first.name, first.width, first.height, first.near) == ("a", 4, 2, None)
    assert (first.fx, first.fy, first.cx, first.cy, second.near) == (3.0, 3.5, 1.75, 1.25, 0.5)
    np.testing.assert_array_equal(first.world_to_camera, OURS["world_to_camera"])
    np.testing.assert_allclose(first.center, (-0.5, -3, 0.25))


def test_camera_file_of_inria(tmp_path):
    (tmp_path / "cameras.json").write_text(json.dumps([INRIA]))
    (camera,) = load_cameras(tmp_path)  # the model folder
    assert (camera.name, camera.cx, camera.cy) == ("b", 2.0, 1.0)
    np.testing.assert_allclose(camera.center, (1, 2, 3))
    # A point one ahead of the camera and two along its x axis, which is the world's y.
    pixels, depth = camera.project(np.array([[1.0, 4.0, 4.0]]))
    np.testing.assert_allclose(pixels, [[2 + 2 * 3.0, 1]])
    np.testing.assert_allclose(depth, [1])


def test_cameras_come_back_with_every_digit(tmp_path):
    cameras = [*dome(ball(), 5, up=(0.1, 0.2, 1)), *look_around(ball(), 2), look_at((0, 0, 0), (0, 0, 1))]
    save_cameras(cameras, tmp_path / "c.json")
    for a, b in zip(cameras, load_cameras(tmp_path / "c.json"), strict=True):
        np.testing.assert_array_equal(a.world_to_camera, b.world_to_camera)
        keys = ("fx", "fy", "cx", "cy", "width", "height", "near", "name")
        assert [getattr(a, k) for k in keys] == [getattr(b, k) for k in keys]
    assert [p.name for p in tmp_path.iterdir()] == ["c.json"]


BROKEN = {
    "no list": ({"cameras": [OURS]}, "JSON list of cameras, this is a JSON object$"),
    "a data set": ({"frames": []}, "JSON object with 'frames', a data set: read it with load_dataset"),
    "empty": ([], "no camera"),
    "no object": ([OURS, 3], "camera 1"),
    "null": ([None], "camera 0"),
    "name a number": ([{**OURS, "name": 3}], "'name'"),
    "no fx": ([{k: v for k, v in OURS.items() if k != "fx"}], r"camera 0 \('a'\): field 'fx' is missing"),
    "width a string": ([{**OURS, "width": "4"}], "'width' must be a finite number"),
    "width true": ([{**OURS, "width": True}], "'width'"),
    "width a fraction": ([{**OURS, "width": 4.5}], "width"),
    "width huge": ([{**OURS, "width": 1e9}], "width"),
    "height zero": ([{**OURS, "height": 0}], "height"),
    "fx not finite": ([{**OURS, "fx": float("inf")}], "'fx'"),
    "fx nan": ([{**OURS, "fx": float("nan")}], "'fx'"),
    "fx negative": ([{**OURS, "fx": -1}], "fx must be positive"),
    "fx null": ([{**OURS, "fx": None}], "'fx'"),
    "fx a huge integer": ([{**OURS, "fx": 10**400}], "'fx'"),
    "near zero": ([{**OURS, "near": 0}], "near"),
    "matrix 3x4": ([{**OURS, "world_to_camera": OURS["world_to_camera"][:3]}], "world_to_camera.*list of 3"),
    "matrix ragged": ([{**OURS, "world_to_camera": [[1], [1, 2], 3, 4]}], "world_to_camera"),
    "matrix nested": ([{**OURS, "world_to_camera": [[[1]] * 4] * 4}], "world_to_camera"),
    "matrix not rigid": ([{**OURS, "world_to_camera": (2 * np.eye(4)).tolist()}], "rigid"),
    "matrix mirrored": ([{**OURS, "world_to_camera": np.diag([1.0, 1, -1, 1]).tolist()}], "mirror"),
    "no pose": ([{k: v for k, v in OURS.items() if k != "world_to_camera"}], "needs 'world_to_camera'"),
    "position of two": ([{**INRIA, "position": [1, 2]}], "'position'"),
    "rotation of nines": ([{**INRIA, "rotation": [[9] * 3] * 3}], "rigid"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_broken_camera_files_say_what_and_where(case, tmp_path):
    content, words = BROKEN[case]
    path = tmp_path / "broken.json"
    path.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=words) as info:
        load_cameras(path)
    assert str(path) in str(info.value)
    assert len(str(info.value)) < 600


@pytest.mark.parametrize(
    "text", [b"", b"[", b"\xff\xfe\x00", b"[" * 100_000, b"ply\nformat ascii 1.0\n", b"[1e"]
)
def test_not_json(text, tmp_path):
    (tmp_path / "c.json").write_bytes(text)
    with pytest.raises(FileFormatError, match="not a JSON file"):
        load_cameras(tmp_path / "c.json")


def test_too_large_is_refused(tmp_path):
    with open(tmp_path / "c.json", "wb") as file:
        file.truncate(1 << 34)  # 16 GiB that take no space
    with pytest.raises(FileFormatError, match="larger than"):
        load_cameras(tmp_path / "c.json")


@given(st.binary(max_size=60))
def test_damaged_camera_files_never_crash(tmp_path_factory, junk):
    text = bytearray(json.dumps([OURS, INRIA]).encode())
    position = sum(junk) % len(text)
    text[position : position + len(junk)] = junk
    path = tmp_path_factory.getbasetemp() / "damaged.json"
    path.write_bytes(text)
    with suppress(FileFormatError):
        assert all(isinstance(camera, Camera) for camera in load_cameras(path))


def test_standard_cameras():
    """They look at the guitar's middle from 2.3 times the radius that holds 90 % of its opacity."""
    from meshsplats.formats.gaussians import load_gaussians

    cameras = load_cameras(shared_data("cameras/guitar_mid.json"))
    bounds = scene_bounds(load_gaussians(shared_data("splats/guitar_sh0.ply")))
    distance = [np.linalg.norm(c.center - bounds.center) for c in cameras]
    assert len(cameras) == 8
    np.testing.assert_allclose(distance, 2.3 * bounds.radius, rtol=0.03)
    np.testing.assert_allclose(guess_up(None, cameras), (0, -1, 0), atol=1e-6)


def test_projection_worked_out_by_hand():
    """A quarter turn about the world's z axis, then a step of (0.5, 0.25, 3): (1, 2, 1) goes to (-1.5, 1.25,
    4) in the camera's frame. Behind the camera, and in the plane through it, nothing is seen."""
    matrix = np.array([[0, -1, 0, 0.5], [1, 0, 0, 0.25], [0, 0, 1, 3], [0, 0, 0, 1]])
    camera = Camera(matrix, fx=16, fy=32, cx=20, cy=8, width=40, height=30)
    points = np.array([[1, 2, 1], [0, 0, -3], [0, 0, -5]])
    for kind in (np.float32, np.float64):
        positions, depth = camera.project(points.astype(kind))
        np.testing.assert_array_equal(positions, [(14, 18), (np.nan, np.nan), (np.nan, np.nan)])
        np.testing.assert_array_equal(depth, [4, 0, -2])
        assert positions.dtype == depth.dtype == kind
    assert camera.project(points)[0].dtype == np.float64
    np.testing.assert_array_equal(camera.in_image(positions), [True, False, False])


def test_points_of_another_shape_are_refused():
    camera = Camera(np.eye(4), 10, 10, 8, 8, 16, 16)
    for shape in ((3,), (4, 2), (1, 2, 3)):
        with pytest.raises(ValueError, match=r"points must have shape \(n, 3\)"):
            camera.project(np.ones(shape))


def test_an_array_that_is_changed_later_does_not_move_the_camera():
    pose = np.eye(4)
    camera = Camera(pose, 10, 10, 8, 8, 16, 16)
    pose[2, 3] = 5
    np.testing.assert_array_equal(camera.world_to_camera, np.eye(4))


def test_names_that_no_camera_file_may_have_are_refused():
    with pytest.raises(TypeError, match="name must be a str, got 3, an int"):
        Camera(np.eye(4), 10, 10, 8, 8, 16, 16, name=3)
    with pytest.raises(ValueError, match="name must have up to 1,000 characters, got 1,001"):
        Camera(np.eye(4), 10, 10, 8, 8, 16, 16, name="n" * 1001)


@pytest.mark.parametrize("away", [10.0, 700.0, 4000.0])
def test_projection_is_as_exact_far_from_the_origin(away):
    """Of float32 points, with the same points in float64 as the truth: to a fiftieth of a pixel."""
    rng = np.random.default_rng(0)
    place = away * np.array([0.6, -0.64, 0.48])
    camera = look_at(place, place + np.array([0.3, 0.2, 1.0]), width=1200, height=900)
    points = (place + rng.uniform((-0.5, -0.5, 1), (0.5, 0.5, 2), (2000, 3))).astype(np.float32)
    single, depths = camera.project(points)
    exact, truths = camera.project(points.astype(np.float64))
    assert single.dtype == depths.dtype == np.float32
    seen = camera.in_image(exact)
    assert np.count_nonzero(seen) > 500
    assert np.abs(single - exact)[seen].max() < 0.02
    assert np.abs(depths / truths - 1)[seen].max() < 1e-5


def test_sees_what_projects_into_the_image():
    """Focal length 10, 40 x 20 pixels, principal point (15, 10), near 1: at depth 2, x from -3 to 5 and y
    from -2 to 2."""
    camera = Camera(np.eye(4), 10, 10, 15, 10, 40, 20, near=1)
    inside = [[-2.99, 0, 2], [4.99, 0, 2], [0, -1.99, 2], [0, 1.99, 2], [0, 0, 1.01]]
    outside = [[-3.01, 0, 2], [5.01, 0, 2], [0, -2.01, 2], [0, 2.01, 2], [0, 0, 0.99], [0, 0, -2], [0, 0, 0]]
    assert camera.sees(np.array(inside)).all()
    assert not camera.sees(np.array(outside)).any()


def test_cameras_of_other_programs():
    camera = orbit(ball(), 3, elevation=20, width=40, height=30)[1]
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    matrix = np.linalg.inv(camera.world_to_camera)
    calibrated = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    for pose, lens, axes in (
        (matrix, intrinsics, "opencv"),
        (matrix[:3].tolist(), calibrated, "opencv"),
        (matrix @ np.diag([1, -1, -1, 1]), intrinsics, "opengl"),
    ):
        made = Camera.from_camera_to_world(pose, lens, 40, 30, axes=axes, near=0.5, name="a")
        np.testing.assert_allclose(made.world_to_camera, camera.world_to_camera, atol=1e-12)
        assert (made.fx, made.fy, made.cx, made.cy) == intrinsics
        assert (made.width, made.height, made.near, made.name) == (40, 30, 0.5, "a")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"matrix": np.eye(3)}, r"matrix must have shape \(3, 4\), got \(3, 3\)"),
        ({"matrix": None}, "matrix must hold numbers, got a NoneType"),
        ({"matrix": np.diag([2.0, 2, 2, 1])}, "from camera to world by a rotation and a translation"),
        ({"matrix": np.diag([1.0, 1, -1, 1])}, "it scales, shears or mirrors"),
        ({"matrix": np.diag([1.0, 1, 1, 2])}, "its last row being 0 0 0 1"),
        ({"intrinsics": (1, 2)}, r"intrinsics must have shape \(4,\), got \(2,\)"),
        ({"intrinsics": [[9, 1, 4], [0, 9, 4], [0, 0, 1]]}, r"intrinsics must be \[\[fx, 0, cx\]"),
        ({"axes": "blender"}, "axes must be one of opencv, opengl, got 'blender'"),
    ],
)
def test_what_is_no_camera_to_world(changed, message):
    fitting = {"matrix": np.eye(4), "intrinsics": (9, 9, 4, 4), "width": 8, "height": 8}
    with pytest.raises((ValueError, TypeError), match=message):
        Camera.from_camera_to_world(**(fitting | changed))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Camera(np.eye(4), None, 9, 4, 4, 8, 8), "fx must be a number, got None: give one"),
        (
            lambda: Camera(np.eye(4), "50", 9, 4, 4, 8, 8),
            r"fx must be a number, got the text '50': float\(fx\)",
        ),
        (
            lambda: Camera(np.eye(4), 9, 9, 4, 4, 8, 8).within(0),
            "side must be a number of pixels above 0, got 0",
        ),
        (lambda: look_at([0, 0], [0, 0, 0]), r"center must have shape \(3,\), got \(2,\)"),
        (lambda: look_at("a", [0, 0, 0]), r"center must be a point \(3,\), got the text 'a': three numbers"),
    ],
)
def test_messages_name_the_argument_that_is_wrong(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()
