"""Which way up an object stands whose file does not say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _local import shared_data

from meshsplats._common.geometry import quaternions_of
from meshsplats.cameras.files import save_cameras
from meshsplats.cli import main
from meshsplats.conversion import convert
from meshsplats.conversion.streaming import convert_blocks
from meshsplats.datasets.scene_files import SceneReading
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.formats.meshes import load_mesh
from meshsplats.scene.gaussians import SH_C0, GaussianCloud
from meshsplats.viewpoints import standing
from meshsplats.viewpoints.finding import (
    BY_COARSENESS,
    BY_STANCE,
    BY_SURVEY,
    find_cameras,
    first_impression,
    unusual_up,
)
from meshsplats.viewpoints.standing import (
    STOOD,
    UPS,
    base_of,
    coarse_beneath,
    find_stance,
    thinned,
    tips_over,
)
from meshsplats.viewpoints.views import Chooser

USUAL = [0, -1, 0]


def boxes(*parts: tuple, seed: int = 0, count: int = 6000) -> GaussianCloud:
    """Splats on the surfaces of boxes, each of a centre and half its size, with z up, lit from above."""
    rng = np.random.default_rng(seed)
    points, light = [], []
    areas = np.array([np.prod(half) / min(half) for _, half in parts])
    for (middle, half), share in zip(parts, areas / areas.sum(), strict=True):
        some = rng.uniform(-1, 1, (int(count * share) + 1, 3))
        axis = rng.integers(0, 3, len(some))
        side = np.sign(some[np.arange(len(some)), axis])
        some[np.arange(len(some)), axis] = side
        points.append(np.array(middle) + some * half)
        light.append(0.5 + 0.3 * side * (axis == 2))
    means = np.concatenate(points)
    n = len(means)
    return GaussianCloud(
        means,
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), 0.012),
        np.full(n, 0.95),
        np.repeat((np.concatenate(light) - 0.5)[:, None, None] / SH_C0, 3, axis=2),
    )


def chair() -> GaussianCloud:
    """Four legs, a seat, a high back, on which it would lie with y up; z is up."""
    legs = [((x, y, -0.4), (0.05, 0.05, 0.4)) for x in (-0.4, 0.4) for y in (-0.4, 0.4)]
    return boxes(*legs, ((0, 0, 0.05), (0.45, 0.45, 0.05)), ((0, -0.4, 0.9), (0.45, 0.05, 0.8)))


def turned(cloud: GaussianCloud, *rows: tuple) -> GaussianCloud:
    turn = np.array(rows, float)
    rotations = np.einsum("ij,njk->nik", turn, cloud.rotations.astype(np.float64))
    return replace(cloud, means=cloud.means @ turn.T, quaternions=quaternions_of(rotations))


def upright(cloud: GaussianCloud) -> GaussianCloud:
    """A cloud with z up, with y down."""
    return turned(cloud, (1, 0, 0), (0, 0, -1), (0, 1, 0))


def lollipop(coarse) -> GaussianCloud:
    """A ball with a thin post beside it, longer than the ball at both ends of y, which tips over on it;
    ``coarse``: how many times larger than the others splats are in their unit directions from the middle."""
    rng = np.random.default_rng(1)
    n, post = 12_000, 1500
    means = rng.normal(size=(n, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    toward = means.copy()
    means[:post] = [0.95, 0, 0] + rng.uniform(-1, 1, (post, 3)) * [0.05, 1.5, 0.05]
    scales = 0.02 * coarse(toward)[:, None] * np.ones(3)
    scales[:post] = 0.02
    return GaussianCloud(
        means, np.tile([1.0, 0, 0, 0], (n, 1)), scales, np.full(n, 0.95), np.zeros((n, 1, 3))
    )


def test_a_chair_that_lies_stands_up():
    up, sure = find_stance(chair())
    assert (up.tolist(), sure) == ([0, 0, 1], STOOD)


@pytest.mark.parametrize("up", range(3))
def test_a_chair_stands_any_way(up):
    to = np.array(UPS[up])
    across = np.array([1.0, 0, 0])
    cloud = turned(chair(), *np.stack([across, np.cross(to, across), to], axis=1))
    assert find_stance(cloud)[0].tolist() == list(UPS[up])


def test_what_stands_the_usual_way_is_not_looked_at(monkeypatch):
    monkeypatch.setattr(standing, "AllSplats", None)
    up, sure = find_stance(upright(chair()))
    assert up.tolist() == USUAL
    assert sure > 0


def test_a_mask_does_not_lie_on_its_back():
    """Its rim is a wide base, and with y down it tips over."""
    back, face, chin = (0.5, 0.9, 0.05), (0.3, 0.5, 0.1), (0.1, 0.3, 0.05)
    mask = boxes(((0, 0, 0), back), ((0, -0.3, 0.15), face), ((0.3, 0.9, 0), chin))
    assert tips_over(mask)
    assert find_stance(mask) == (pytest.approx(np.array(USUAL)), 0.0)


def test_what_is_coarse_beneath_stands_on_its_head():
    """Nobody photographs an object from below."""
    cloud = lollipop(lambda toward: np.where(toward[:, 1] < -0.5, 6.0, 1.0))
    assert tips_over(cloud)
    up, sure = find_stance(cloud)
    assert up.tolist() == [0, 1, 0]
    assert sure == standing.SEEN


def test_what_is_coarse_behind_was_photographed_from_its_front():
    cloud = lollipop(lambda toward: np.exp(0.9 * (1 + toward[:, 2])))
    assert tips_over(cloud)
    assert find_stance(cloud) == (pytest.approx(np.array(USUAL)), 0.0)


def test_coarse_beneath_or_behind():
    """A size that grows all the way down is one that grows away from cameras in front."""
    directions = standing.fibonacci(200)
    up, all_the_way = np.array([0, 0, 1.0]), -directions[:, 2]
    beneath = np.maximum(all_the_way, 0) * 2
    assert coarse_beneath(directions, beneath, up, alone=True)
    assert coarse_beneath(directions, all_the_way, up, alone=False)
    assert not coarse_beneath(directions, all_the_way, up, alone=True)
    assert not coarse_beneath(directions, beneath, -up, alone=False)
    assert not coarse_beneath(directions, beneath, np.array([0, 0.6, 0.8]), alone=False)
    assert not coarse_beneath(directions, 0.2 * beneath, up, alone=False)


def test_a_base_by_hand():
    """A slab twice as long as wide, 1 high: its mass is above the middle, a quarter of the length from the
    long edges."""
    slab = boxes(((0, 0, 0), (1, 0.5, 0.5)), count=20_000)
    base = base_of(standing.scene_bounds(slab), np.array([0, 0, 1.0]))
    assert base.margin == pytest.approx(0.25, abs=0.02)
    assert base.share == pytest.approx(1, abs=0.03)
    assert base.height == pytest.approx(0.5, abs=0.02)


def test_a_thinned_scene_is_the_same_however_it_is_cut(monkeypatch):
    cloud = chair()
    monkeypatch.setattr(standing, "MOST", 700)
    whole = thinned([cloud])
    for size in (37, 800, 5000):
        cut = thinned(cloud.take(slice(i, i + size)) for i in range(0, len(cloud), size))
        assert np.array_equal(cut.means, whole.means)
    assert 350 <= len(whole) <= 700


def test_cameras_and_info_say_how_it_stands():
    found = find_cameras(chair(), 4)
    assert (found.kind, found.up.tolist(), found.up_confidence) == ("object", [0, 0, 1], STOOD)
    assert min(camera.center[2] for camera in found.cameras) >= -0.4
    scene = first_impression(chair())
    assert scene is not None
    assert scene.up.tolist() == [0, 0, 1]
    assert find_cameras(chair(), 4, up=USUAL).up.tolist() == USUAL
    assert unusual_up(replace(chair(), up=np.array(USUAL))) is None
    assert unusual_up(upright(chair())) is None


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("up", range(1, len(UPS)))
def test_what_shows_its_coarse_side_was_photographed_another_way_up(up):
    """A cube stands on any side; the one that lay on the ground is coarse."""
    box = boxes(((0, 0, 0), (0.4, 0.4, 0.4)))
    height = box.means @ np.array(UPS[up])
    below = height < 0.9 * height.min()
    box = replace(box, scales=box.scales * np.where(below, 5, 1)[:, None].astype(np.float32))
    assert not tips_over(box)
    found = find_cameras(box, 3)
    assert (found.kind, found.up.tolist(), found.up_confidence) == ("object", list(UPS[up]), standing.SEEN)
    told = unusual_up(box)
    assert told is not None
    assert (told.up.tolist(), told.reason) == (list(UPS[up]), BY_COARSENESS.format("-y"))
    assert find_cameras(box, 3, up=USUAL).kind == "ring"


def test_a_ring_opens_with_its_whole_subject(monkeypatch):
    """The box above in the usual way up: its middle is in that of the image, from further back."""
    box = boxes(((0, 0, 0), (0.4, 0.4, 0.4)))
    coarse = box.means[:, 0] > 0.36
    box = replace(box, scales=box.scales * np.where(coarse, 5, 1)[:, None].astype(np.float32))
    found = find_cameras(box, 3, up=USUAL)
    monkeypatch.setattr(Chooser, "of_subject", lambda chooser, view, lens, limit: view)
    as_photographed = find_cameras(replace(box), 3, up=USUAL)
    assert found.kind == as_photographed.kind == "ring"
    for camera, other in zip(found.cameras[1:], as_photographed.cameras[1:], strict=True):
        np.testing.assert_array_equal(camera.world_to_camera, other.world_to_camera)
    opening, near = found.cameras[0], as_photographed.cameras[0]
    (middle,), _ = opening.project(np.zeros((1, 3)))
    assert np.abs(middle - 200).max() < 20
    assert np.linalg.norm(opening.center) > 1.1 * np.linalg.norm(near.center)
    assert opening.fx == near.fx


def test_a_survey_stands_as_its_coordinates_say_unless_it_would_tip_over():
    at = np.array([500_000.0, 4_500_000.0, 100.0])
    y_up = turned(chair(), (1, 0, 0), (0, 0, 1), (0, -1, 0))
    for cloud, up, reason in (
        (chair(), [0, 0, 1], BY_SURVEY),
        (y_up, [0, 1, 0], BY_STANCE.format("z")),
    ):
        found = unusual_up(replace(cloud, origin=at))
        assert found is not None
        assert (found.up.tolist(), found.reason) == (up, reason)


class Telling(SceneReading):
    def tell(self, text: str) -> None:
        self.told.append(text)

    def __init__(self) -> None:
        super().__init__()
        object.__setattr__(self, "told", [])


def test_a_file_that_is_read_stands(tmp_path):
    path = tmp_path / "chair.ply"
    save_gaussians(chair(), path)
    reading = Telling()
    cloud = reading.load(path)
    assert cloud.up.tolist() == [0, 0, 1]
    assert len(reading.told) == 1
    assert reading.told[0].startswith("up: z, as the object stands (likely): ")
    assert reading.load(path, find_up=False).up is None
    assert reading.load(path, up="-y").up is None
    stream = reading.stream(path)
    assert stream.up.tolist() == [0, 0, 1]
    parts = list(convert_blocks(stream))
    assert parts[0].up.tolist() == convert(cloud).up.tolist() == [0, 0, 1]
    assert reading.stream(path, up="-y").up is None
    folder = tmp_path / "model"
    folder.mkdir()
    save_cameras(find_cameras(chair(), 3).cameras, folder / "cameras.json")
    (folder / "point_cloud.ply").write_bytes(path.read_bytes())
    assert load_gaussians(folder).up is None
    assert reading.load(folder).up is None


@pytest.mark.slow
def test_a_mesh_stands_in_its_file(tmp_path, capsys):
    path = tmp_path / "chair.splat"
    save_gaussians(chair(), path)
    assert main(["convert", str(path), "-o", str(tmp_path / "a.glb")]) == 0
    assert "up: z, as the object stands" in capsys.readouterr().err
    assert main(["convert", str(path), "-o", str(tmp_path / "b.glb"), "--up", "-y"]) == 0
    assert "stands" not in capsys.readouterr().err
    assert load_mesh(tmp_path / "a.glb").up == pytest.approx([0, 0, 1], abs=1e-6)
    assert load_mesh(tmp_path / "b.glb").up == pytest.approx(USUAL, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "up"),
    [
        ("trained/lego_60k_sh3.ply", [0, 0, 1]),
        ("guitar.compressed.ply", None),
        ("truck.splat", None),
        ("playbot_lod3_31k_sh2.ply", None),
        ("playbot_lod6_2k_sh2.ply", None),
        ("monkey_0001.sog", None),
    ],
)
def test_real_objects(name, up):
    found = unusual_up(load_gaussians(shared_data(f"splats/{name}")))
    assert (None if found is None else found.up.tolist()) == up
