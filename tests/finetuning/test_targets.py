"""What a mesh is optimised on."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from _balls import cameras_around
from _photographs import write_photographs

from meshsplats.cameras.files import save_cameras
from meshsplats.datasets.views import WHITE
from meshsplats.demo_scene import make_scene
from meshsplats.errors import DataWarning, FileFormatError, OptionsError
from meshsplats.finetuning.targets import Targets
from meshsplats.scene.mesh import SplatMesh

CLOUD = make_scene().take(np.arange(0, 4000, 40))


def test_images_of_splats_have_the_size_counts_and_look_that_are_named(tmp_path):
    data = Targets(views=5, held_out=2, width=24).make(CLOUD, tmp_path / "s.ply", WHITE, 1)
    assert (len(data.train), len(data.test), data.train[0].camera.width, data.look) == (5, 2, 24, "area")
    paper = Targets(views=3, held_out=1, width=24).make(CLOUD, tmp_path / "s.ply", WHITE, 1, preset="paper")
    assert paper.look == "splats"
    worthwhile = Targets(held_out=1, width=24).make(CLOUD, tmp_path / "s.ply", WHITE, 1, 7)
    assert len(worthwhile.train) == 7


def test_cameras_of_the_model_folder_are_taken_unless_cameras_are_placed(tmp_path):
    (tmp_path / "point_cloud").mkdir()
    save_cameras(cameras_around(9), tmp_path / "cameras.json")
    given = {tuple(np.round(c.center, 3)) for c in cameras_around(9)}

    def taken(**options):
        data = Targets(views=4, held_out=1, width=24, **options).make(CLOUD, tmp_path, WHITE, 1)
        return {tuple(np.round(view.camera.center, 3)) for view in data.train} <= given

    assert taken()
    assert taken(cameras=tmp_path / "cameras.json", placement="object")
    assert not taken(placement="object")


@pytest.mark.parametrize("sees", [True, False])
def test_cameras_of_a_record_are_taken_where_they_see_the_scene(tmp_path, sees):
    (tmp_path / "s.ply").touch()
    behind = np.eye(4)
    behind[2, 3] = -1e4
    cameras = [camera if sees else replace(camera, world_to_camera=behind) for camera in cameras_around(9)]
    save_cameras(cameras, tmp_path / "s.ply.cameras.json")
    targets = Targets(views=4, held_out=1, width=24)
    with nullcontext() if sees else pytest.warns(DataWarning, match="none of the 9 cameras beside the file"):
        data = targets.make(CLOUD, tmp_path / "s.ply", WHITE, 1)
    given = {tuple(np.round(c.center, 3)) for c in cameras}
    assert ({tuple(np.round(view.camera.center, 3)) for view in data.train} <= given) == sees


def test_photographs_that_are_all_held_out_leave_nothing_to_train_on(tmp_path):
    folder = write_photographs(tmp_path / "p", cameras_around(4), [np.zeros((64, 64, 3))] * 4)
    data = Targets(data=folder, test_every=2).make(CLOUD, tmp_path, WHITE, 1)
    assert (len(data.train), len(data.test)) == (2, 2)
    lone = write_photographs(tmp_path / "lone", cameras_around(1), [np.zeros((64, 64, 3))])
    with pytest.raises(FileFormatError, match="all its 1 views are held out"):
        Targets(data=lone).make(CLOUD, tmp_path, WHITE, 1)


def test_a_mesh_needs_photographs(tmp_path):
    mesh = SplatMesh(np.zeros((3, 3)), np.array([[0, 1, 2]]), np.ones((3, 4)))
    with pytest.raises(OptionsError, match="is a mesh: give its photographs with data, or splats"):
        Targets().make(mesh, tmp_path, WHITE, 1)
    with pytest.raises(TypeError, match="scene must be a GaussianCloud"):
        Targets().make(None, tmp_path, WHITE, 1)
