"""Which views of a scene the options name, from Python."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _balls import cameras_around
from _photographs import write_photographs

from meshsplats.cameras.files import save_cameras
from meshsplats.datasets.scene_views import SceneViews, cameras_named
from meshsplats.scene.mesh import SplatMesh

SQUARE = SplatMesh(
    np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32),
    np.array([[0, 1, 2]], np.int32),
    np.ones((3, 4), np.float32),
)


def made(tmp_path, scene=SQUARE, **options):
    return SceneViews(**options).make(scene, tmp_path / "mesh.npz", count=3, side=40)


def centres(cameras):
    return np.array([camera.center for camera in cameras])


def test_the_default_is_an_orbit_of_the_given_count_and_size(tmp_path):
    cameras = made(tmp_path)
    assert [(c.width, c.height) for c in cameras] == [(40, 40)] * 3
    assert [(c.width, c.height) for c in made(tmp_path, width=30, height=20)] == [(30, 20)] * 3
    assert len(made(tmp_path, orbit=5)) == 5
    assert len(made(tmp_path, dome=4)) == 4
    assert len(made(tmp_path, look_around=6)) == 6


def test_a_focal_length_counts_millimetres_on_a_film_of_36(tmp_path):
    for width, height in ((40, 40), (80, 40), (40, 80)):
        camera = made(tmp_path, focal_length=50, width=width, height=height)[0]
        assert camera.fx == pytest.approx(width * 50 / 36)


def test_views_look_at_the_point_that_is_named_relative_to_the_origin_of_the_scene(tmp_path):
    far = replace(SQUARE, origin=np.array([1000.0, 0, 0]))
    for camera in made(tmp_path, far, look_at=(1000.5, 0, 0)):
        x, y = camera.project(np.array([[0.5, 0, 0]]))[0][0][:2]
        assert (x, y) == pytest.approx((20, 20), abs=1e-3)


def test_views_of_a_file_are_relative_to_the_scene_and_scaled(tmp_path):
    cameras = cameras_around(4)
    save_cameras(cameras, tmp_path / "c.json")
    far = replace(SQUARE, origin=np.array([10.0, 0, 0]))
    found = made(tmp_path, far, cameras=tmp_path / "c.json", width=32)
    assert np.allclose(centres(found), centres(cameras) - [10, 0, 0], atol=1e-5)
    assert {c.width for c in found} == {32}


def test_only_views_that_follow_each_other_make_a_turntable():
    still = {"cameras": Path("c.json"), "data": Path("photographs"), "dome": 5}
    assert not any(SceneViews(**{name: value}).moving for name, value in still.items())
    assert SceneViews().moving
    assert SceneViews(orbit=3).moving
    assert SceneViews(look_around=3).moving


def test_views_of_photographs_are_those_held_out_and_training_views_those_named(tmp_path):
    cameras = cameras_around(9)
    folder = write_photographs(tmp_path / "p", cameras, [np.zeros((64, 64, 3))] * 9)
    held_out = made(tmp_path, data=folder)
    named = cameras_named(None, folder)
    assert len(held_out) + len(named) == 9
    both = np.concatenate([centres(held_out), centres(named)])
    assert np.allclose(sorted(both.tolist()), sorted(centres(cameras).tolist()), atol=1e-5)
    shifted = cameras_named(None, folder, origin=(1, 2, 3))
    assert np.allclose(centres(shifted), centres(named) - [1, 2, 3], atol=1e-5)
    assert cameras_named(None, None) is None
    save_cameras(cameras, tmp_path / "c.json")
    assert len(cameras_named(tmp_path / "c.json", None)) == 9


@pytest.mark.parametrize(("name", "value"), [("width", 0), ("height", 1 << 20), ("focal_length", 0.5)])
def test_values_out_of_range_are_named(tmp_path, name, value):
    with pytest.raises(ValueError, match=f"{name} must be .* from 1 to"):
        made(tmp_path, **{name: value})
