"""nerfstudio's camera_path.json as cameras."""

from __future__ import annotations

import json

import numpy as np
import pytest
from _datasets import rotation

from meshsplats import load_cameras
from meshsplats.cli import main
from meshsplats.errors import FileFormatError


def pose(i: int) -> np.ndarray:
    """OpenGL camera to world: right, up, back, position."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(i)[1]
    matrix[:3, 3] = (i, -1, 2)
    return matrix


def written(tmp_path, count=3, **change):
    frames = [
        {"camera_to_world": pose(i).ravel().tolist(), "fov": 60.0 + i, "aspect": 1.5} for i in range(count)
    ]
    keys = [{"matrix": pose(i).ravel().tolist(), "fov": 50, "aspect": 1.5} for i in range(2)]
    content = {
        "camera_type": "perspective",
        "render_height": 200,
        "render_width": 300.0,
        "default_fov": 75.0,
        "fps": 30,
        "keyframes": keys,
        "camera_path": frames,
    }
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(content | change))
    return path


def check_pose(camera, matrix: np.ndarray) -> None:
    np.testing.assert_allclose(camera.center, matrix[:3, 3], atol=1e-9)
    right, down, forward = camera.world_to_camera[:3, :3]
    np.testing.assert_allclose(right, matrix[:3, 0], atol=1e-9)
    np.testing.assert_allclose(down, -matrix[:3, 1], atol=1e-9)
    np.testing.assert_allclose(forward, -matrix[:3, 2], atol=1e-9)


def test_the_cameras_of_the_path(tmp_path):
    cameras = load_cameras(written(tmp_path))
    assert len(cameras) == 3
    for i, camera in enumerate(cameras):
        check_pose(camera, pose(i))
        assert (camera.width, camera.height, camera.cx, camera.cy) == (300, 200, 150, 100)
        # The angle is that from the upper edge to the lower: both edges are half of it away from the axis.
        half = np.radians(60 + i) / 2
        upper = camera.center + pose(i)[:3, :3] @ [0, np.tan(half), -1]
        np.testing.assert_allclose(camera.project(upper[None])[0], [[150, 0]], atol=1e-9)


def test_keyframes_stand_in_for_a_path_that_is_empty(tmp_path):
    for path in ([], None):
        cameras = load_cameras(written(tmp_path, camera_path=path))
        assert len(cameras) == 2
        check_pose(cameras[1], pose(1))
        assert cameras[0].fx == pytest.approx(100 / np.tan(np.radians(25)))
    # As text, column by column, in files of the viewer up to 2023; without an angle of their own.
    keys = [{"matrix": json.dumps(pose(2).T.ravel().tolist()), "fov": None}]
    (camera,) = load_cameras(written(tmp_path, camera_path=[], keyframes=keys))
    check_pose(camera, pose(2))
    assert camera.fx == pytest.approx(100 / np.tan(np.radians(37.5)))


def test_three_rows_and_nested_rows_are_taken(tmp_path):
    for matrix in (pose(1)[:3].ravel().tolist(), pose(1).tolist()):
        (camera,) = load_cameras(written(tmp_path, camera_path=[{"camera_to_world": matrix, "fov": 50}]))
        check_pose(camera, pose(1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_type": "equirectangular"}, "of type 'equirectangular'; only 'perspective' is read"),
        ({"camera_path": [], "keyframes": []}, "a camera path without cameras"),
        ({"camera_path": [3]}, "camera_path 0: must be a JSON object"),
        ({"camera_path": [{"fov": 50}]}, "'camera_to_world' must be 16 finite numbers"),
        ({"camera_path": [{"camera_to_world": [0] * 16, "fov": 50}]}, "no rotation and translation"),
        ({"camera_path": [{"camera_to_world": [1e12] * 16, "fov": 50}]}, "must be 16 finite numbers"),
        ({"camera_path": [{"camera_to_world": ["1"] * 16, "fov": 50}]}, "must be 16 finite numbers"),
        ({"camera_path": [], "keyframes": [{"matrix": "[[[", "fov": 50}]}, "'matrix' must be 16 finite"),
        ({"camera_path": [{"camera_to_world": pose(0).tolist(), "fov": 180}]}, "between 0 and 180"),
        ({"camera_path": [{}], "default_fov": None}, "'fov' must be a finite number, got null"),
        ({"render_width": None}, "'render_width' must be a finite number, got null"),
        ({"render_width": 300.5}, "width must be a whole number"),
        ({"camera_path": [{}] * 20_001}, "20001 cameras, more than the 20000"),
    ],
)
def test_broken_paths_are_refused(tmp_path, change, message):
    with pytest.raises(FileFormatError, match=message):
        load_cameras(written(tmp_path, **change))


def test_info_says_whose_frame_it_is(tmp_path, capsys):
    path = written(tmp_path)
    assert main(["info", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["kind"], found["cameras"]) == ("cameras", 3)
    assert found["frame"] == "nerfstudio's, that of the splats it exports"
    (tmp_path / "dataparser_transforms.json").write_text("{}")
    assert main(["info", str(path)]) == 0
    assert "dataparser_transforms.json leads from that of the photographs to it" in capsys.readouterr().out
