"""Cameras found from splats alone: laws, a room whose inside is known, and real scenes."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from _local import shared_data

from meshsplats._common.geometry import quaternions_of
from meshsplats.cameras.files import load_cameras, save_cameras
from meshsplats.cameras.placing import outside_cameras
from meshsplats.cameras.trajectories import look_at
from meshsplats.cli import main
from meshsplats.datasets.splat_targets import splat_dataset
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.scene.gaussians import SH_C0, GaussianCloud
from meshsplats.viewpoints.finding import FoundCameras, find_cameras, first_impression, varied
from meshsplats.viewpoints.kind import fineness_outside
from meshsplats.viewpoints.relief import Relief
from meshsplats.viewpoints.sample import AllSplats, Sample
from meshsplats.viewpoints.search import find_places
from meshsplats.viewpoints.thinning import ByPlace, probabilities, sizes_of
from meshsplats.viewpoints.upright import find_upright, height_over_width
from meshsplats.viewpoints.views import SIDE, Checked, Chooser, check, depth_of

HALF = np.array([2.0, 1.3, 3.0])
"""Half the width, height and length of the room; y points down."""
COUNT = 12


def room(count: int = 20_000, noise: int = 8000) -> GaussianCloud:
    """A room with a table in it, closed and sharp from within, in a cloud of large splats."""
    rng = np.random.default_rng(3)
    area = np.repeat([HALF[1] * HALF[2], HALF[0] * HALF[2], HALF[0] * HALF[1]], 2)
    table = count // 12
    ends = np.round(np.cumsum(area) / area.sum() * (count - table)).astype(int)
    wall = np.append(np.repeat(np.arange(6), np.diff(ends, prepend=0)), np.full(table, 3))
    axis, side = wall // 2, np.where(wall % 2, 1.0, -1.0)
    even = 2 * ((0.5 + np.arange(count)[:, None] * 1.32471795724 ** -np.array([1, 2])) % 1) - 1
    points = np.stack([side * (axis == k) for k in range(3)], axis=1)
    for k in range(3):
        points[axis == k, k - 2], points[axis == k, k - 1] = even[axis == k].T
    points *= HALF
    points[-table:] = np.array([0.9, 0.5, -1.4]) + 0.4 * points[-table:] / HALF * [1, 0, 1]
    scales = np.full((count, 3), 0.045)
    scales[np.arange(count), axis] = 0.002
    shell = rng.normal(size=(noise, 3))
    shell = shell / np.abs(shell).max(axis=1, keepdims=True) * rng.uniform(1.3, 2.2, (noise, 1)) * HALF
    turns = np.zeros((count + noise, 4))
    turns[:, 0] = 1
    return GaussianCloud(
        np.concatenate([points, shell]),
        turns,
        np.concatenate([scales, rng.uniform(0.2, 0.5, (noise, 3))]),
        np.concatenate([np.full(count, 0.97), rng.uniform(0.1, 0.9, noise)]),
        rng.uniform(-1, 1, (count + noise, 1, 3)) * 0.5 / SH_C0,
    )


def moved(cloud: GaussianCloud, scale: float, turn: np.ndarray, shift: np.ndarray) -> GaussianCloud:
    rotations = np.einsum("ij,njk->nik", turn, cloud.rotations.astype(np.float64))
    return replace(
        cloud,
        means=scale * cloud.means @ turn.T + shift,
        quaternions=quaternions_of(rotations),
        scales=cloud.scales * np.float32(scale),
    )


@pytest.fixture(scope="module")
def found() -> FoundCameras:
    return find_cameras(room(), COUNT, threads=2)


@pytest.fixture(scope="module")
def sparse() -> GaussianCloud:
    """The room of few splats, in which a search takes less than half of the time. It is known again."""
    return room(4000, 1500)


@pytest.fixture(scope="module")
def found_in_sparse(sparse) -> FoundCameras:
    return find_cameras(sparse, COUNT, threads=2)


def gazes(cameras: tuple) -> np.ndarray:
    return np.array([camera.world_to_camera[2, :3] for camera in cameras])


def centers(cameras: tuple) -> np.ndarray:
    return np.array([camera.center for camera in cameras])


def test_a_room_is_seen_from_inside_and_upright(found):
    assert found.kind in ("place", "ring")
    assert len(found.cameras) == COUNT
    inside = (np.abs(centers(found.cameras)) < HALF).all(axis=1)
    assert inside.all()
    assert found.up @ [0, -1, 0] > np.cos(np.radians(3))
    assert found.up_confidence > 0.5
    assert abs(found.ground + HALF[1]) < 0.1  # along up: the floor is at y = +1.3
    upright = np.array([camera.up for camera in found.cameras])
    assert (upright @ found.up > 0.4).all()


def test_the_dome_stands_outside_of_the_same_room():
    cameras = outside_cameras(room(), COUNT)
    assert not (np.abs(centers(tuple(cameras))) < HALF).all(axis=1).any()


def test_views_of_a_room_look_in_several_directions_from_the_start(found):
    first = gazes(found.cameras[: COUNT // 2])
    assert np.linalg.norm(first.mean(axis=0)) < 0.85
    assert np.linalg.norm(gazes(found.cameras).mean(axis=0)) < 0.8


@pytest.mark.nightly
def test_fewer_views_by_one_thread_are_the_first_of_more_to_the_bit(found_in_sparse):
    found = found_in_sparse
    fewer = find_cameras(room(4000, 1500), 5, threads=1)  # other splats: it is searched again
    for a, b in zip(fewer.cameras, found.cameras[:5], strict=True):
        assert np.array_equal(a.world_to_camera, b.world_to_camera)
        assert (a.fx, a.near) == (b.fx, b.near)
    assert np.array_equal(found.up, fewer.up)
    assert found.ground == fewer.ground


@pytest.mark.slow
def test_a_scene_is_searched_once_for_views_of_all_sizes(monkeypatch):
    searches = []

    def places(*arguments):
        searches.append(arguments)
        return find_places(*arguments, (12, 8, 6))

    monkeypatch.setattr("meshsplats.viewpoints.finding.find_places", places)
    cloud = room(3000, 800)
    three = find_cameras(cloud, 3, width=320, height=200)
    two = find_cameras(cloud, 2, width=64, height=40)
    assert len(searches) == 1
    for small, large in zip(two.cameras, three.cameras, strict=False):
        assert small.fx == pytest.approx(large.fx / 5)
        assert np.array_equal(small.world_to_camera, large.world_to_camera)
    fresh = find_cameras(cloud.take(np.arange(len(cloud))), 2, width=64, height=40)
    assert len(searches) == 2  # other splats
    for again, small in zip(fresh.cameras, two.cameras, strict=True):
        assert again.fx == small.fx
        assert np.array_equal(again.world_to_camera, small.world_to_camera)
    assert fresh.extent == two.extent
    find_cameras(cloud, 2, up=(0, -1, 0.01))
    assert len(searches) == 3  # another up
    find_cameras(cloud, 2)
    cloud.means[:, 0] *= 2  # changed in place
    find_cameras(cloud, 2)
    assert len(searches) == 5
    monkeypatch.setattr("meshsplats.viewpoints.finding.kind_from_outside", lambda *a: ("object", 1.0))
    ball = room(2000, 100)
    within = find_cameras(ball, 1, anywhere=True).cameras[0]
    around = find_cameras(ball, 1).cameras[0]
    assert len(searches) == 6  # whose views are not those of the object that it is taken for
    assert np.linalg.norm(around.center - within.center) > 0.1


def test_an_object_is_looked_at_from_outside_once(monkeypatch):
    looked = []
    look = lambda *arguments: looked.append(arguments) or ("object", 1.0)  # noqa: E731
    monkeypatch.setattr("meshsplats.viewpoints.finding.kind_from_outside", look)
    cloud = room(500, 100)
    for count in (1, 24, 1):
        assert find_cameras(cloud, count).kind == "object"
    assert len(looked) == 1
    find_cameras(cloud, 1, up=(0, 0, 1))
    cloud.means[:, 0] *= 2  # changed in place
    find_cameras(cloud, 1, up=(0, 0, 1))
    assert len(looked) == 3


@pytest.mark.slow
def test_cameras_move_with_the_scene(sparse, found_in_sparse):
    found = found_in_sparse
    # A quarter turn around the vertical (the default of up stays) and a power of two round nothing.
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    there = find_cameras(moved(sparse, 4, turn, np.zeros(3)), COUNT, threads=2)
    assert there.kind == found.kind
    assert there.extent == pytest.approx(4 * found.extent, rel=1e-3)
    assert np.abs(4 * centers(found.cameras) @ turn.T - centers(there.cameras)).max() < 0.01
    assert np.abs(gazes(found.cameras) @ turn.T - gazes(there.cameras)).max() < 0.001


@pytest.mark.slow
def test_a_given_up_is_kept(sparse):
    tilted = np.array([0.0, -1, 0.2]) / np.linalg.norm([0, 1, 0.2])
    answer = find_cameras(replace(sparse, up=tilted), 2, threads=2)
    assert answer.up @ tilted > 1 - 1e-6
    assert answer.up_confidence == 1


def test_more_views_than_can_be_found_are_variations(found):
    many = varied(found.cameras, 40)
    assert len(many) == 40
    assert many[:COUNT] == list(found.cameras)
    assert len({camera.world_to_camera.tobytes() for camera in many}) == 40
    for i, camera in enumerate(many):
        parent = found.cameras[i % COUNT]
        assert np.linalg.norm(camera.center - parent.center) < 0.2 * depth_of(parent)
        assert camera.world_to_camera[2, :3] @ parent.world_to_camera[2, :3] > np.cos(np.radians(12))


def test_the_depth_of_a_view_is_that_by_which_it_was_made():
    """Whatever its lens and near plane: extents of scenes and variations of views follow from it."""
    image = np.zeros((SIDE, SIDE))
    sample = SimpleNamespace(whole=SimpleNamespace(look=lambda camera: (image, image, image)))
    view = check(sample, np.zeros(3), np.array([0, 0, 1.0]), 7.0, np.array([0, -1.0, 0]), 0.01)
    assert depth_of(view.camera) == pytest.approx(7)
    assert depth_of(view.with_lens(0, 800, 600)) == pytest.approx(7)
    relief = Relief(np.zeros(3), np.array([0, 0, 7.0]), np.array([0, -1.0, 0]), (0.5, 0.5), 0.1, 1.0)
    assert [depth_of(camera) for camera in relief.cameras(3, 80, 60)] == pytest.approx([7] * 3)


def test_the_widest_lens_of_a_good_picture(found):
    view = Checked(found.cameras[0], np.array([1, 1.5, 2]), np.array([0.5, 0.1, 0]), np.array([0.1, 2, 0.1]))
    assert view.widest(3) == 1
    assert view.widest(1) == 2
    assert view.widest(0.01) is None
    assert view.with_lens(2, 800, 600).fx == pytest.approx(found.cameras[0].fx * 2 * 600 / 400)


def test_views_that_fail_lead_the_search_back_to_good_ones():
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0, 3.6, 0.15), np.arange(0, 2, 0.15)))
    count = len(x)
    poor = np.where(x < 1.2, 0.0, 1.0)[:, None]
    chooser = Chooser.__new__(Chooser)
    chooser.place, chooser.spots = np.arange(count), np.stack([x, y], axis=1)
    chooser.shown, chooser.weight = np.eye(count, dtype=np.float32), np.ones(count)
    chooser.worth, chooser.rich = np.ones(count), np.ones(count, bool)
    chooser._checked = {k: Checked(None, np.ones(1), poor[k], np.zeros(1)) for k in range(count)}
    chosen = chooser.in_order(0, 6, 1.0)  # 80 of all candidates are good; more fail than it has patience for
    assert len(chosen) == 6
    assert (x[chosen] < 1.2).all()


def test_variations_of_narrow_views_stay_narrow():
    for fov in (40.0, 60.0, 80.0):
        parent = look_at((0, 0, -2), (0, 0, 2), fov=fov, width=400, height=400, near=0.1)
        wide = varied([parent], 3)[2]
        widest = np.tan(np.radians(85 / 2)) / np.tan(np.radians(fov / 2))
        assert parent.fx / wide.fx == pytest.approx(min(1.5, widest), rel=1e-6)


@pytest.mark.slow
def test_a_first_impression_says_what_the_search_does(sparse, found_in_sparse):
    found, scene = found_in_sparse, first_impression(room(), threads=2)
    assert scene.kind in ("place", "ring")
    assert scene.cameras == ()
    assert scene.up @ found.up > np.cos(np.radians(2))
    assert abs(scene.ground - found.ground) < 0.1
    assert 0.5 < scene.extent / found.extent < 2
    told = first_impression(replace(sparse, up=np.array([0.0, -0.8, 0.6])), threads=2)
    assert told.up_confidence == 1
    assert told.up @ [0, -0.8, 0.6] > 1 - 1e-6


def test_a_first_impression_of_an_object_and_of_nothing():
    small = room(400, 0)
    scene = first_impression(small)
    assert (scene.kind, scene.cameras) == ("object", ())
    assert (scene.up == [0, -1, 0]).all()
    assert first_impression(small.take(np.arange(0))) is None
    assert first_impression(replace(room(), scales=np.full((28_000, 3), 40.0))) is None  # takes long


def test_faces_of_a_panorama_leave_out_what_they_do_not_show(monkeypatch):
    sample = Sample(room(3000, 500), np.array([0.0, -1, 0]), 1)
    place = np.array([0.4, -0.2, 0.9])
    shares, alpha, depth = sample.panorama(place)
    monkeypatch.setattr("meshsplats.viewpoints.sample.REACH", np.inf)
    for mine, whole in zip((shares, alpha, depth), sample.panorama(place), strict=True):
        assert (np.isfinite(mine) == np.isfinite(whole)).mean() > 0.999
        both = np.isfinite(mine) & np.isfinite(whole)
        assert np.abs(mine[both] - whole[both]).mean() < 0.004


@pytest.mark.parametrize(("limit", "count"), [("MOST", 60_000), ("MOST_IN_VIEW", 20_000)])
def test_some_of_many_splats_show_what_all_do(limit, count, monkeypatch):
    camera = look_at((0, 0, -2), (0.2, 0.1, 2), width=24, height=24, fov=70, near=0.02)
    cloud = room(120_000, 100)
    cloud = replace(cloud, scales=cloud.scales * np.float32(0.5))
    angle, alpha, spread = AllSplats(cloud, 2).look(camera)
    monkeypatch.setattr(f"meshsplats.viewpoints.sample.{limit}", count)
    few_angle, few_alpha, few_spread = AllSplats(cloud, 2).look(camera)
    assert np.abs(few_alpha - alpha).mean() < 0.04
    assert np.abs(few_angle - angle).mean() < 0.1
    assert np.abs(few_spread - spread).mean() < 0.05


def test_of_many_splats_a_place_shows_those_that_fill_its_panorama():
    # Of 120,000 splats of walls and 8000 large ones around them, 3000.
    cloud = room(120_000, 8000)
    cloud = replace(cloud, scales=np.where(cloud.scales < 0.05, cloud.scales * np.float32(0.4), cloud.scales))
    place, up = np.array([0.3, 0.1, -0.5]), np.array([0.0, -1, 0])
    depth = Sample(cloud, up, 2).panorama(place)[2]
    few = Sample(cloud, up, 2, 3000)
    assert few.by_place is not None
    assert np.median(np.abs(np.log(few.panorama(place)[2] / depth))) < 0.12
    few.by_place = None  # any are as likely: the noise comes through the walls
    assert np.median(np.abs(np.log(few.panorama(place)[2] / depth))) > 0.25


def test_splats_that_a_place_shows_cover_what_all_do():
    cloud = room(60_000, 3000)
    by_place = ByPlace(cloud, 1500)
    assert len(by_place.pool) == len(cloud)  # fewer than a pool has
    place = np.array([0.2, -0.3, 1.0])
    thin, size = by_place.seen_from(place, 0.01)
    assert 1200 < len(thin) < 1900
    assert (sizes_of(thin.scales) >= size * (1 - 1e-6)).all()
    assert (thin.scales.min(axis=1) <= cloud.scales.max()).all()

    def solid_angle(splats: GaussianCloud) -> float:
        away = np.linalg.norm(splats.means - place, axis=1)
        return float((sizes_of(splats.scales).astype(float) ** 2 * splats.opacities / away**2).sum())

    assert solid_angle(thin) == pytest.approx(solid_angle(cloud), rel=0.1)


def test_probabilities_have_the_sum_that_is_asked_for():
    value = np.random.default_rng(0).exponential(size=20_000) ** 3
    likely = probabilities(value, 3000)
    assert likely.sum() == pytest.approx(3000, rel=0.1)
    assert likely.max() <= 1
    assert likely.min() > 0
    between = (likely < 1) & (likely > likely.min())
    assert np.ptp(likely[between] / value[between]) < 1e-12 * likely.max() / value[between].min()
    assert (probabilities(value, 20_000) == 1).all()


def test_the_noise_around_a_capture_of_many_splats_is_coarse(monkeypatch):
    # Four splats of half the size stand for one: what is fine against the splats of the scene stays so.
    cloud = room(3000, 4000)
    quarters = GaussianCloud.joined([cloud] * 4)
    quarters = replace(quarters, scales=quarters.scales / 2)
    up = np.array([0.0, -1, 0])
    monkeypatch.setattr("meshsplats.viewpoints.kind.USUAL", 1000)
    unscaled = fineness_outside(quarters, up)
    monkeypatch.setattr("meshsplats.viewpoints.kind.MANY", len(cloud))
    assert fineness_outside(quarters, up) == pytest.approx(fineness_outside(cloud, up), abs=0.02)
    assert unscaled > fineness_outside(quarters, up) + 0.1


def test_a_floor_is_told_from_a_wall_by_the_width_of_what_lies_on_it():
    points = np.random.default_rng(2).uniform(-1, 1, (2000, 3)) * [6, 5, 1]
    assert height_over_width(points, np.array([0.0, 0, 1])) == pytest.approx(1 / 5.5, rel=0.1)
    assert height_over_width(points, np.array([1.0, 0, 0])) == pytest.approx(2, rel=0.1)


def test_a_wall_that_fills_more_of_the_images_than_the_floor_is_no_floor(monkeypatch):
    # A low hall; z is up, against the default.
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    low = room(6000, 500)
    hall = moved(replace(low, means=low.means * np.float32([1, 0.5, 1])), 1, turn, np.zeros(3))
    sample = Sample(hall, np.array([0.0, -1, 0]), 2)
    places = find_places(sample, (12, 8, 6))
    wall, floor = np.array([0.0, -1, 0]), np.array([0.0, 0, 1])
    for shares, up, sure in (((0.14, 0.12), floor, 0.8), ((0.3, 0.05), wall, 1)):
        planes = list(zip(shares, (wall, floor), strict=True))
        monkeypatch.setattr("meshsplats.viewpoints.upright._planes", lambda *a, planes=planes: planes)
        found = find_upright(sample, places, np.array([0.0, -1, 0]))
        assert abs(found.up @ up) > 0.999
        assert found.confidence == pytest.approx(sure)


def test_what_is_kept_of_many_splats_is_no_more_than_views_need(monkeypatch):
    cloud = room(6000, 500)
    cloud = replace(cloud, sh=np.pad(cloud.sh, ((0, 0), (0, 15), (0, 0))))
    monkeypatch.setattr("meshsplats.viewpoints.sample.MOST", 2000)
    some = AllSplats(cloud, 2)
    assert 1000 < len(some.cloud) <= 2000
    assert some.cloud.sh.shape[1] == 1
    assert some.wider == pytest.approx((len(cloud) / len(some.cloud)) ** 0.5, rel=0.01)


@pytest.mark.slow
def test_targets_of_a_room_are_its_inside(sparse, found_in_sparse):
    """Of a search that was made before, for more views."""
    auto = splat_dataset(sparse, train=4, test=2, width=32, threads=2)
    for view in (*auto.train, *auto.test):
        assert (np.abs(view.camera.center) < HALF).all()
    assert auto.placed.endswith(" units deep: seen from views that were found")
    assert auto.opening is auto.test[0].camera
    dome = splat_dataset(sparse, train=4, test=2, width=32, placement="object")
    assert not any((np.abs(view.camera.center) < HALF).all() for view in dome.train)
    with pytest.raises(ValueError, match="placement must be one of auto, object"):
        splat_dataset(room(2000, 10), placement="outside")
    assert dome.placed == ""
    assert dome.opening is None


@pytest.mark.slow
def test_the_command_writes_cameras_a_sheet_and_a_line(tmp_path, capsys, monkeypatch):
    pytest.importorskip("PIL")
    searches = []

    def once(*arguments, **options):  # as a search takes seconds
        if not searches:
            searches.append(find_cameras(*arguments, **options))
        return searches[0]

    monkeypatch.setattr("meshsplats.viewpoints.finding.find_cameras", once)
    save_gaussians(room(4000, 600), tmp_path / "room.ply")
    out = tmp_path / "cameras.json"
    options = ["--count", "3", "--width", "64", "--height", "48", "--threads", "2"]
    assert main(["cameras", str(tmp_path / "room.ply"), "-o", str(out), *options]) == 0
    assert "up " in capsys.readouterr().out
    assert [(c.width, c.height) for c in load_cameras(out)] == [(64, 48)] * 3
    assert (tmp_path / "cameras.json.preview.png").exists()
    assert main(["cameras", str(tmp_path / "room.ply"), "-o", str(out), *options]) == 3
    assert main(["cameras", str(tmp_path / "room.ply"), "-o", str(out), *options, "--force", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["cameras"] == 3
    assert main(["cameras", str(tmp_path / "room.ply"), "-o", str(tmp_path / "c.txt")]) == 2


@pytest.mark.nightly(keep=1)
@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        ("splats/guitar.compressed.ply", {"object"}),
        ("splats/playbot_lod6_2k_sh2.ply", {"object"}),
        ("splats/tt_truck_sh0.ply", {"object"}),
        ("splats/trained/lego_60k_sh3.ply", {"object"}),
        ("splats/trained/miku_58k_sh0.ply", {"ring", "place"}),
    ],
)
def test_kinds_of_real_scenes(name, kinds, tmp_path):
    cloud = load_gaussians(shared_data(name))
    found = find_cameras(cloud, 4, threads=2)
    assert found.kind in kinds
    if found.kind == "object":
        train = splat_dataset(cloud, train=1, test=4, width=16, up=found.up, threads=2)
        assert [v.camera.name for v in train.test] == [f"view_{i:04d}" for i in range(4)]
        for view, camera in zip(train.test, found.cameras, strict=True):
            same = view.camera.world_to_camera == camera.world_to_camera
            assert same.all()
    save_cameras(found.cameras, tmp_path / "cameras.json")
    assert len(load_cameras(tmp_path / "cameras.json")) == 4


def test_an_empty_scene_and_wrong_values_are_refused():
    nothing = GaussianCloud(
        np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 1, 3))
    )
    with pytest.raises(ValueError, match="the scene is empty"):
        find_cameras(nothing)
    unseen = room(100, 10)
    unseen = replace(unseen, opacities=np.zeros_like(unseen.opacities))
    with pytest.raises(ValueError, match="no splat has any opacity"):
        find_cameras(unseen, anywhere=True)
    with pytest.raises(ValueError, match="count must be at least 1"):
        find_cameras(room(100, 10), 0)
    with pytest.raises(ValueError, match="width and height"):
        find_cameras(room(100, 10), width=0)
