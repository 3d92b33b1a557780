"""What commands show of splats by default: given views first, then found ones."""

from __future__ import annotations

import json
import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _glb import edit_glb

from meshsplats.cameras.files import save_cameras
from meshsplats.cameras.trajectories import look_at
from meshsplats.conversion import convert
from meshsplats.errors import DataWarning
from meshsplats.formats.base_meshes import load_vertex_colored, save_base
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewpoints import beside, showing
from meshsplats.viewpoints.finding import FoundCameras
from meshsplats.viewpoints.opening import opening_camera
from meshsplats.viewpoints.showing import default_views, opening_beside

UP = np.array([0.0, -1.0, 0.0])
START = {"camera": {"position": [1, 2, 3], "target": [0, 0, 0], "fov": 60}}


def views(count: int, height: float = 1.0):
    return [look_at((i, height, -20), (i, height, 1), width=60, height=40, near=0.1) for i in range(count)]


def splats(count: int = 40) -> GaussianCloud:
    points = np.random.default_rng(2).normal(size=(count, 3))
    turns = np.tile([1.0, 0, 0, 0], (count, 1))
    return GaussianCloud(
        points, turns, np.full((count, 3), 0.01), np.full(count, 0.9), np.zeros((count, 1, 3))
    )


@pytest.fixture
def kind(monkeypatch):
    """Splats that look like what the list says: a place, at first."""
    looks = ["place"]

    def found(cloud, count, **options):
        cameras = tuple(views(count, height=2.0))
        return FoundCameras(looks[0], 0.4, UP, 1.0, 0.0, 3.0, cameras)

    monkeypatch.setattr(showing, "find_cameras", found)
    monkeypatch.setattr(showing, "kind_from_outside", lambda cloud, up, threads: (looks[0], 0.4))
    monkeypatch.setattr(showing, "surely_object", lambda cloud, up, threads: looks[0] == "object")
    return looks


def heights(cameras) -> set[float]:
    return {round(float(camera.center[1]), 6) for camera in cameras}


def model(folder: Path, count: int = 10) -> Path:
    save_cameras(views(count), folder / "cameras.json")
    return folder


def test_found_views_where_none_are_given(kind, tmp_path):
    cameras, words = default_views(splats(), tmp_path, 4, side=(80, 80))
    assert heights(cameras) == {2.0}
    assert "views that were found" in words
    assert len(default_views(splats(), tmp_path, 30, film=True)[0]) == 30


def test_a_model_folder_may_be_where_one_is(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(model(tmp_path))
    assert heights(default_views(splats(), Path("."), 5)[0]) == {1.0}


def test_cameras_of_a_model_come_before_found_ones(kind, tmp_path):
    cameras, words = default_views(splats(), model(tmp_path), 5, side=(90, 120))
    assert heights(cameras) == {1.0}
    assert [camera.center[0] for camera in cameras] == [0, 2, 4, 6, 8]
    assert "5 of its 10 cameras" in words
    for camera in cameras:  # the shorter side spans what it did
        assert (camera.width, camera.height) == (90, 120)
        assert camera.fx / 90 == pytest.approx(views(1)[0].fx / 40)
        assert (camera.cx, camera.cy) == (45, 60)
    film, words = default_views(splats(), tmp_path, 30, film=True)
    assert len(film) == 30
    assert "round through 10 of its 10 cameras" in words
    given, _ = default_views(splats(), tmp_path, 5, given=views(3, height=5.0))
    assert heights(given) == {5.0}


def test_splats_without_a_file_have_no_cameras_of_the_working_directory(kind, tmp_path, monkeypatch):
    (tmp_path / "settings.json").write_text(json.dumps(START))
    monkeypatch.chdir(model(tmp_path))
    assert heights(default_views(splats(), tmp_path, 4)[0]) == {1.0}
    for count in (1, 4):
        assert heights(default_views(splats(), None, count)[0]) == {2.0}
    assert opening_beside(None) is None


def test_objects_and_meshes_are_seen_from_all_around(kind, tmp_path):
    kind[0] = "object"
    assert default_views(splats(), tmp_path, 4) is None
    assert default_views(splats(), model(tmp_path), 4) is None
    kind[0] = "place"
    mesh = SplatMesh(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32), np.zeros((3, 4)))
    assert default_views(mesh, tmp_path, 4) is None
    nothing = splats().take(np.arange(0))
    assert default_views(nothing, tmp_path, 4) is None
    huge = replace(splats(2000), scales=np.full((2000, 3), 50.0))  # would take long
    assert default_views(huge, tmp_path, 4) is None


def fans(count: int = 40) -> SplatMesh:
    return convert(splats(count))


def test_a_mesh_of_a_place_is_seen_from_within_by_its_splats(kind, tmp_path):
    mesh, file = fans(), tmp_path / "mesh.npz"
    assert heights(default_views(mesh, file, 4)[0]) == {2.0}
    assert len(default_views(mesh, file, 30, film=True)[0]) == 30
    assert heights([opening_camera(mesh)]) == {2.0}
    assert default_views(replace(mesh, face_splat=None), file, 4) is None
    kind[0] = "object"
    assert default_views(mesh, file, 4) is None
    assert heights([opening_camera(mesh)]) != {2.0}


@pytest.mark.parametrize("scene", ["mesh", "splats", "surface"])
def test_cameras_beside_a_file_come_before_found_ones(kind, tmp_path, scene):
    known = {"mesh": fans(), "splats": splats(), "surface": replace(fans(), face_splat=None)}[scene]
    file = tmp_path / "scene.npz"
    file.write_bytes(b"")
    save_cameras(views(10), tmp_path / "scene.npz.cameras.json")
    cameras, words = default_views(known, file, 5)
    assert [camera.center[0] for camera in cameras] == [0, 2, 4, 6, 8]
    assert heights(cameras) == {1.0}
    assert "5 of its 10 cameras" in words
    assert len(default_views(known, file, 30, film=True)[0]) == 30
    moved = replace(known, origin=np.array([1.0, 0, 0]))
    assert [camera.center[0] for camera in default_views(moved, file, 5)[0]] == [-1, 1, 3, 5, 7]
    if scene != "surface":
        kind[0] = "object"
        assert default_views(known, file, 5) is None
    kind[0] = "place"
    (tmp_path / "scene.npz.cameras.json").write_text("{}")
    with pytest.warns(DataWarning, match="the cameras beside the file are not used"):
        default_views(known, file, 5)


def test_cameras_of_an_older_file_of_the_name_are_not_used(kind, tmp_path):
    file, record = tmp_path / "scene.npz", tmp_path / "scene.npz.cameras.json"
    file.write_bytes(b"")
    save_cameras(views(10), record)
    for seconds, height in ((59, 1.0), (61, 2.0)):
        os.utime(record, (1e9, 1e9))
        os.utime(file, (1e9, 1e9 + seconds))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            cameras, _ = default_views(fans(), file, 5)
        assert heights(cameras) == {height}
        assert any("may be of another" in str(w.message) for w in said) == (height == 2.0)


@pytest.mark.parametrize("away", [1e4, 1e300])
def test_cameras_that_see_nothing_of_the_scene_are_not_used(kind, tmp_path, away):
    file, record = tmp_path / "scene.npz", tmp_path / "scene.npz.cameras.json"
    file.write_bytes(b"")
    matrix = np.eye(4)
    matrix[2, 3] = -away  # behind the camera
    off = replace(views(1)[0], world_to_camera=matrix)
    save_cameras([off, off], record)
    with pytest.warns(DataWarning, match="none of the 2 cameras beside the file sees"):
        assert heights(default_views(fans(), file, 5)[0]) == {2.0}
    save_cameras([off, *views(3)], record)
    assert heights(default_views(fans(), file, 5)[0]) == {1.0}


def test_a_record_that_cannot_be_opened_ends_nothing(kind, tmp_path, monkeypatch):
    def refuse(path, **_):
        raise PermissionError(13, "Permission denied", str(path))

    file = tmp_path / "scene.npz"
    file.write_bytes(b"")
    save_cameras(views(3), tmp_path / "scene.npz.cameras.json")
    monkeypatch.setattr(beside, "load_cameras", refuse)
    with pytest.warns(DataWarning, match="Permission denied"):
        assert heights(default_views(fans(), file, 5)[0]) == {2.0}


def test_names_may_be_as_long_as_the_system_allows(kind, tmp_path):
    file = tmp_path / ("n" * 251 + ".ply")
    file.write_bytes(b"")
    assert heights(default_views(fans(), file, 5)[0]) == {2.0}


def test_the_start_camera_is_the_first_view(kind, tmp_path):
    (tmp_path / "settings.json").write_text(json.dumps(START))
    cameras, _ = default_views(splats(), tmp_path, 4)
    assert np.allclose(cameras[0].center, [-1, -2, 3])
    assert len(cameras) == 4
    assert heights(cameras[1:]) == {2.0}
    assert heights(default_views(splats(), tmp_path, 4, film=True)[0]) == {2.0}
    kind[0] = "object"
    ((only,), words) = default_views(splats(), tmp_path, 1)
    assert np.allclose(only.center, [-1, -2, 3])
    assert "start camera" in words


def test_a_start_camera_is_of_the_only_splats_of_its_folder(tmp_path):
    source = tmp_path / "a.ply"
    source.touch()
    assert opening_beside(source) is None
    (tmp_path / "settings.json").write_text(json.dumps(START))
    assert np.allclose(opening_beside(source, (1, 0, 0)).center, [-2, -2, 3])
    (tmp_path / "b.sog").touch()
    assert opening_beside(source) is None
    assert opening_beside(tmp_path) is not None
    unchosen = {"camera": {"position": [2, 2, -2], "target": [0, 0, 0], "fov": 75}}
    (tmp_path / "settings.json").write_text(json.dumps(unchosen))
    assert opening_beside(tmp_path) is None
    (tmp_path / "settings.json").write_text(json.dumps({"camera": {"position": [1], "target": [0, 0, 0]}}))
    with pytest.warns(DataWarning, match="the start camera is not used"):
        assert opening_beside(tmp_path) is None


@pytest.fixture
def surface(tmp_path):
    """A surface whose file has eight cameras, and the scene as commands read it."""
    base = BaseMesh(np.eye(3) * 9, [[0, 1, 2]], np.ones((3, 4)), up=UP, origin=np.array([5e5, 0, 0]))
    save_base(base, tmp_path / "room.glb", cameras=views(8))
    return load_vertex_colored(tmp_path / "room.glb"), tmp_path / "room.glb"


def test_a_mesh_is_seen_by_the_cameras_in_its_file(surface, tmp_path):
    mesh, path = surface
    found, said = default_views(mesh, path, 4, side=(80, 60))
    assert said == "seen from 4 of the 8 cameras in its file"
    np.testing.assert_allclose([c.center[0] for c in found], [0, 2, 4, 6], atol=1e-4)
    assert {(c.width, c.height) for c in found} == {(80, 60)}
    assert len(default_views(mesh, path, 1)[0]) == 1
    film, said = default_views(mesh, path, 24, film=True)
    assert (len(film), "on a round through" in said) == (24, True)
    assert default_views(mesh, None, 4) is None
    assert default_views(mesh, tmp_path, 4) is None


def test_few_cameras_in_a_file_make_no_round(surface):
    mesh, path = surface
    save_base(BaseMesh(mesh.vertices, mesh.faces, mesh.colors, up=UP), path, cameras=views(3))
    assert default_views(mesh, path, 24, film=True) is None
    assert len(default_views(mesh, path, 24)[0]) == 3


def test_broken_cameras_in_a_file_are_not_used(surface):
    mesh, path = surface
    edit_glb(path, lambda document: document["cameras"][0]["perspective"].pop("yfov"))
    with pytest.warns(DataWarning, match="the cameras of the file are not used"):
        assert default_views(mesh, path, 4) is None
