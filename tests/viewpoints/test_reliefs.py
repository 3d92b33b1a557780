"""Photographs whose pixels were given depth are told from other scenes, and seen from their front."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from _local import shared_data
from test_finding_cameras import moved

from meshsplats.cameras.framing import guess_up
from meshsplats.cli import main
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.rendering.api import render_splats
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.viewpoints.finding import find_cameras, first_impression
from meshsplats.viewpoints.relief import find_relief, unhidden
from meshsplats.viewpoints.showing import default_views

WIDTH, HEIGHT, FOCAL = 160, 90, 120.0


def pixels(width: int = WIDTH, height: int = HEIGHT) -> tuple[np.ndarray, np.ndarray]:
    """(h * w,) of each pixel of an image, from its middle: to the right, and down."""
    y, x = np.mgrid[:height, :width]
    return (x.ravel() + 0.5 - width / 2), (y.ravel() + 0.5 - height / 2)


def depths(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """What a camera sees in a direction (tangents): a meadow, a wavy wall behind it, a ball before both."""
    meadow = np.where(y > 0.02, 1.2 / np.maximum(y, 0.02), np.inf)
    depth = np.minimum(meadow, 9 + np.sin(9 * x) + 3 * x)
    near = (x + 0.1) ** 2 + (y - 0.05) ** 2 < 0.15**2
    return np.where(near, 2.5 - 2 * np.sqrt(np.maximum(0.15**2 - (x + 0.1) ** 2 - (y - 0.05) ** 2, 0)), depth)


def splats(points: np.ndarray, sizes: np.ndarray | float, flat: float = 0.2) -> GaussianCloud:
    scales = np.repeat(np.broadcast_to(sizes, len(points))[:, None], 3, axis=1) * [1, 1, flat]
    turns = np.zeros((len(points), 4))
    turns[:, 0] = 1
    sh = np.random.default_rng(0).uniform(-1, 1, (len(points), 1, 3))
    return GaussianCloud(points, turns, scales, np.full(len(points), 0.98), sh)


def photograph(layers: int = 2, rough: float = 0.4) -> GaussianCloud:
    """As Apple's SHARP writes it: the camera at the origin looks along z, y is down; layers of splats with
    sizes in proportion to depth, about, the second behind the first."""
    rng = np.random.default_rng(1)
    x, y = pixels()
    rays = np.stack([x, y, np.full(len(x), FOCAL)], axis=1) / FOCAL
    depth = depths(rays[:, 0], rays[:, 1])
    behind = depth * rng.uniform(1, 1.3, len(depth))
    points = np.concatenate([rays * depth[:, None], rays * behind[:, None]][:layers])
    sizes = 0.6 / FOCAL * points[:, 2] * np.exp(rough * rng.normal(size=len(points)))
    return splats(points, sizes)


def raised(toward: float, width: int = WIDTH, height: int = HEIGHT) -> GaussianCloud:
    """A photograph that is spread over the plane z = 0, its near parts raised along z; y is down."""
    x, y = pixels(width, height)
    near = 1 / depths(x / FOCAL, y / FOCAL)
    points = np.stack([x, y, toward * 20 * near / near.max()], axis=1) / 80
    return splats(points, 0.7 / 80)


def turned(degrees: float, axis: tuple[float, float, float]) -> np.ndarray:
    a = np.radians(degrees)
    k = np.cross(np.eye(3), np.asarray(axis) / np.linalg.norm(axis))
    return np.eye(3) + np.sin(a) * k + (1 - np.cos(a)) * k @ k


@pytest.mark.parametrize("layers", [1, 2])
def test_a_photograph_is_seen_from_where_it_was_taken(layers):
    cloud = photograph(layers)
    found = find_cameras(cloud, 9, width=64, height=36)
    assert found.kind == "relief"
    assert found.confidence > 0.8
    first = found.cameras[0]
    np.testing.assert_allclose(first.center, 0, atol=1e-9)
    np.testing.assert_allclose(first.world_to_camera[2, :3], [0, 0, 1], atol=0.01)
    np.testing.assert_allclose(found.up, [0, -1, 0], atol=0.01)
    half = first.width / 2 / first.fx
    assert WIDTH / 2 / FOCAL < half < 1.08 * WIDTH / 2 / FOCAL, "the whole image, and little more"
    image = render_splats(cloud, first)
    assert image.alpha[2:-2, 2:-2].min() > 0.8
    away = np.array([np.linalg.norm(camera.center) for camera in found.cameras])
    assert away[1:].min() > 0
    assert away.max() < 0.4, "steps aside that show little of what nobody saw"
    for camera in found.cameras:
        assert camera.world_to_camera[2, 2] > 0.98
        assert camera.near < 1


@pytest.mark.parametrize("scale", [0.05, 40.0])
def test_a_photograph_that_was_turned(scale):
    """Editors and formats turn scenes about the origin, and scale them: density tells the gaze."""
    turn = turned(70, (0.3, 1, -0.2))
    cloud = moved(photograph(), scale, turn, np.zeros(3))
    found = find_cameras(cloud, 3, up=turn @ [0, -1, 0])
    assert found.kind == "relief"
    assert found.up_confidence == 1
    np.testing.assert_allclose(found.cameras[0].center, 0, atol=1e-9)
    assert found.cameras[0].world_to_camera[2, :3] @ turn[:, 2] > np.cos(np.radians(2))
    still = find_cameras(photograph(), 3)
    assert found.extent == pytest.approx(scale * still.extent, rel=0.02)
    away, expected = (np.linalg.norm(f.cameras[2].center) for f in (found, still))
    assert away == pytest.approx(scale * expected, rel=0.05)


@pytest.mark.parametrize("toward", [1, -1])
def test_an_image_that_was_raised_is_seen_from_its_front(toward):
    cloud = raised(toward)
    found = find_cameras(cloud, 5)
    assert found.kind == "relief"
    for camera in found.cameras:
        assert camera.center[2] * toward > 1
        assert camera.world_to_camera[2, 2] * toward < -0.97
        assert camera.in_image(camera.project(cloud.means)[0]).mean() > 0.99


def test_where_nothing_else_tells_an_image_rises_from_the_origin():
    """A face: neither its upper nor its lower half is nearer."""
    x, y = pixels()
    height = 15 * np.exp(-(x * x + y * y) / 900)
    for toward in (1, -1):
        cloud = splats(np.stack([x, y, toward * (1 + height)], axis=1) / 80, 0.7 / 80)
        assert find_cameras(cloud, 1).cameras[0].center[2] * toward > 1


def test_a_turned_image_that_was_raised():
    turn = turned(33, (0, 1, 0))
    cloud = moved(raised(1), 3.0, turn, np.array([5.0, 2, 1]))
    found = find_cameras(cloud, 1)
    assert found.kind == "relief"
    assert found.cameras[0].world_to_camera[2, :3] @ -turn[:, 2] > np.cos(np.radians(6))


def test_a_map_is_no_relief():
    """The same grid lying on the ground is terrain."""
    assert find_relief(raised(1), np.array([0.0, 0, 1])) is None
    assert find_relief(raised(1), np.array([0.0, -1, 0])) is not None


def test_part_of_a_wide_photograph():
    """Its rays are as even as those of a plane that the camera faced, which is not the middle of the part."""
    x, y = pixels()
    part = x > -40
    rays = np.stack([x[part], y[part], np.full(part.sum(), 60)], axis=1) / 60
    cloud = splats(rays * depths(x[part] / FOCAL, y[part] / FOCAL)[:, None], 0.02)
    found = find_cameras(cloud, 1)
    assert found.kind == "relief"
    assert found.confidence > 0.8
    middle = np.array([20.0, 0, 60]) / np.hypot(20, 60)
    assert found.cameras[0].world_to_camera[2, :3] @ middle > np.cos(np.radians(1.5))


def test_a_flat_image_is_not_seen_from_its_edge():
    x, y = pixels()
    cloud = splats(np.stack([x, y, np.full(len(x), 30)], axis=1) / 80, 0.01)
    assert abs(find_cameras(cloud, 1).cameras[0].world_to_camera[2, 2]) > 0.99


def test_two_even_sheets_are_no_photograph():
    """A box without sides: half of its splats are hidden by the others."""
    x, y = pixels()
    sheet = np.stack([x, y, 30 + 9 * np.sin(x / 9) * np.sin(y / 11)], axis=1) / 80
    assert find_relief(splats(sheet, 0.01), np.array([0.0, -1, 0])) is not None
    both = splats(np.concatenate([sheet, sheet * [1, 1, -1]]), 0.01)
    assert find_relief(both, np.array([0.0, -1, 0])) is None


def test_a_sheet_without_a_front_is_an_object():
    """A flag, denser in its middle: as much of it is seen from behind."""
    x, y = np.random.default_rng(0).normal(size=(2, 8000))
    flag = splats(np.stack([x, y, 0.2 * np.sin(3 * x)], axis=1), 0.01)
    assert unhidden(flag.means.astype(float), np.array([0.0, 0, 1])) > 0.9
    assert find_relief(flag, np.array([0.0, -1, 0])) is None


def even_box() -> GaussianCloud:
    """A box with a grid of splats of one size on each of its faces."""
    x, y = pixels(60, 60)
    face = np.stack([x, y, np.full(len(x), 30)], axis=1) / 30
    return splats(
        np.concatenate([side * np.roll(face, k, axis=1) for k in range(3) for side in (1, -1)]), 0.03
    )


def test_even_splats_all_around_are_an_object():
    box = even_box()
    assert find_relief(box, np.array([0.0, -1, 0])) is None
    assert find_cameras(box, 1).kind == "object"
    assert unhidden(box.means.astype(float), np.array([1.0, 0, 0])) < 0.6


def test_images_of_several_photographs_before_each_other():
    """A bent background with a figure before it, all splats of one size: seen from their front."""
    x, y = pixels()
    turn = x / WIDTH * np.radians(150)
    background = np.stack([3 * np.sin(turn), 3 * y / 100, 3 * np.cos(turn)], axis=1)
    fx, fy = pixels(60, 70)
    figure = np.stack([fx / 100 + 0.3, fy / 100 + 0.2, 1.8 + 0.1 * np.cos(fx / 20)], axis=1)
    cloud = splats(np.concatenate([background, figure]), 0.02)
    found = find_cameras(cloud, 3)
    assert found.kind == "relief"
    assert found.confidence < 0.5
    assert found.cameras[0].world_to_camera[2, 2] > 0.9
    fitted = replace(
        cloud, scales=cloud.scales * np.exp(np.random.default_rng(0).normal(size=(len(x) + len(fx), 1)))
    )
    assert find_relief(fitted, np.array([0.0, -1, 0])) is None


def test_every_run_of_views_is_the_beginning_of_a_longer_one():
    cloud = photograph()
    few, many = find_cameras(cloud, 4), find_cameras(cloud, 20)
    for a, b in zip(few.cameras, many.cameras, strict=False):
        assert (a.world_to_camera == b.world_to_camera).all()
        assert a.name == b.name
    places = np.array([camera.center for camera in many.cameras])
    assert np.linalg.norm(places[:10].mean(axis=0)) < 0.3 * np.linalg.norm(places, axis=1).max()


def test_info_and_cameras_and_previews_say_so(tmp_path, capsys):
    path = tmp_path / "photo.ply"
    save_gaussians(photograph(), path)
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["scene"] == "relief"
    assert facts["scene_confidence"] > 0.8
    assert first_impression(photograph()).extent == pytest.approx(facts["view_depth"])
    assert main(["cameras", str(path), "-o", str(tmp_path / "c.json"), "--count", "3"]) == 0
    assert "a single image with depth (2.5D)" in capsys.readouterr().out
    views, words = default_views(load_gaussians(path), path, 1)
    assert "a single image with depth (2.5D)" in words
    np.testing.assert_allclose(views[0].center, 0, atol=1e-6)
    film, _ = default_views(load_gaussians(path), path, 8, film=True)
    assert all(camera.world_to_camera[2, 2] > 0.98 for camera in film)


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize(
    "name",
    [
        "splats/guitar_sh0.ply",
        "splats/monkey_0001.sog",
        "splats/playcanvas-logo-sog",
        "splats/truck.splat",
        "splats/places/building_300k_sh3/lod-meta.json",
        "splats/places/park_526k_sh0",
        "splats/places/stone_186k_sh3",
        "splats/trained/lego_60k_sh0.ply",
        "splats/trained/miku_58k_sh0.ply",
    ],
)
def test_splats_of_many_photographs_are_none(name):
    cloud = load_gaussians(shared_data(name))
    assert find_relief(cloud, guess_up(cloud)) is None
