"""Cameras that others have set: SuperSplat's start camera, a model folder's cameras from the file inside."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from meshsplats.cameras.files import load_cameras, model_folder, save_cameras
from meshsplats.cameras.trajectories import look_at
from meshsplats.cameras.viewer_settings import start_camera
from meshsplats.errors import FileFormatError
from meshsplats.viewpoints.beside import cameras_beside

POSE = {"position": [1.0, 2.0, -3.0], "target": [1.0, 2.0, 5.0], "fov": 60}
SECOND = {"version": 2, "cameras": [{"initial": POSE}, {"initial": {}}], "startMode": "default"}
FIRST = {"camera": POSE | {"startAnim": "none"}, "background": {}}
HERE = Path("settings.json")


@pytest.mark.parametrize("content", [FIRST, SECOND])
def test_the_viewers_world_is_turned_half_round_z(content):
    camera = start_camera(content, HERE)
    assert np.allclose(camera.center, [-1, -2, -3])
    assert np.allclose(camera.world_to_camera[2, :3], [0, 0, 1])  # towards larger z, as there
    assert np.allclose(camera.up, [0, -1, 0])  # y points up there
    assert camera.fx == pytest.approx(400 / np.tan(np.radians(30)))
    assert camera.near == pytest.approx(0.02 * 8)


def test_a_version_without_an_angle_has_the_viewers():
    content = {"camera": {key: POSE[key] for key in ("position", "target")}}
    assert start_camera(content, HERE).fx == pytest.approx(400 / np.tan(np.radians(37.5)))


@pytest.mark.parametrize(
    "content",
    [
        [],
        {"editor.fontSize": 12},
        {"camera": {"fov": 60, "startAnim": "orbit"}},
        {"version": 2, "cameras": []},
        {"version": 2, "cameras": [{}]},
        {"camera": "perspective"},
    ],
)
def test_files_without_a_start_camera_name_none(content):
    assert start_camera(content, HERE) is None


def test_the_default_of_a_program_is_no_choice():
    """splat-transform writes it for every scene: a bird 20 cm high is a dot in it."""
    pose = {"position": [2, 2, -2], "target": [0, 0, 0], "fov": 75}
    content = {"version": 2, "cameras": [{"initial": pose}]}
    assert np.allclose(start_camera(content, HERE).center, [-2, -2, -2])
    assert start_camera(content, HERE, chosen=True) is None
    pose["target"] = [0, 0.5, 0]
    assert start_camera(content, HERE, chosen=True) is not None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fov": 0.5}, "'fov' must lie between 1 and 170"),
        ({"fov": "wide"}, "'fov' must lie between 1 and 170"),
        ({"position": [1, 2]}, "'position' must be three finite numbers"),
        ({"target": [1, 2, float("nan")]}, "'target' must be three finite numbers"),
        ({"target": [1, 2, True]}, "'target' must be three finite numbers"),
        ({"target": POSE["position"]}, "'position' and 'target' must differ"),
    ],
)
def test_a_broken_start_camera_is_refused(change, message):
    with pytest.raises(FileFormatError, match=message):
        start_camera({"camera": POSE | change}, HERE)


def test_the_file_is_a_camera_file(tmp_path):
    (tmp_path / "settings.json").write_text(json.dumps(SECOND))
    (camera,) = load_cameras(tmp_path / "settings.json", origin=(10, 0, 0))
    assert np.allclose(camera.center, [-11, -2, -3])
    (tmp_path / "other.json").write_text(json.dumps({"editor.fontSize": 12}))
    with pytest.raises(FileFormatError, match="this is a JSON object"):
        load_cameras(tmp_path / "other.json")


def test_splats_in_a_model_folder_know_its_cameras(tmp_path):
    inside = tmp_path / "model" / "point_cloud" / "iteration_7000"
    inside.mkdir(parents=True)
    splats = inside / "point_cloud.ply"
    splats.touch()
    assert model_folder(splats) is None
    camera = look_at((1, 0, 0), (0, 0, 0))
    save_cameras([camera], tmp_path / "model" / "cameras.json")
    for source in (splats, inside, tmp_path / "model"):
        assert model_folder(source) == tmp_path / "model"
        assert np.allclose(cameras_beside(source)[0].center, camera.center)


def test_a_camera_file_beside_any_splats_is_not_theirs(tmp_path):
    """It may be of another file of the folder."""
    (tmp_path / "a.ply").touch()
    save_cameras([look_at((1, 0, 0), (0, 0, 0))], tmp_path / "cameras.json")
    assert model_folder(tmp_path / "a.ply") is None
    assert cameras_beside(tmp_path / "a.ply") is None
    assert model_folder(tmp_path) == tmp_path
