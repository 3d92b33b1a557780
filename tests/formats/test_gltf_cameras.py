"""Cameras inside glTF files with splats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _glb import edit_glb
from _splats import few_splats

from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.formats.gltf.cameras import cameras_in_gltf
from meshsplats.viewpoints.showing import opening_beside

LENS = {"yfov": np.pi / 2, "aspectRatio": 1.5, "znear": 0.1}


def write(path, *, lens=LENS, up=None, **node):
    """One splat at (0, 1, 0) of the scene, and a camera at ``node``; ``up``: in a note of ours."""
    cloud = few_splats().take(np.arange(1))
    save_gaussians(replace(cloud, means=np.zeros((1, 3)), up=up), path)

    def change(document):
        document["nodes"][0]["translation"] = [0, 1, 0]
        document["cameras"] = [{"type": "orthographic"}, {"type": "perspective", "perspective": lens}]
        document["nodes"] += [{"camera": 0}, {"name": "front", "camera": 1} | node]
        document["scenes"][0]["nodes"] += [len(document["nodes"]) - 2, len(document["nodes"]) - 1]

    edit_glb(path, change)
    return path


def test_a_camera_sees_the_splats_where_the_scene_has_them(tmp_path):
    path = write(tmp_path / "scene.glb", translation=[0, 0, 5])
    (camera,) = cameras_in_gltf(path)  # looks along -z, y points up
    cloud = load_gaussians(path)
    (position,), (depth,) = camera.project(cloud.means + cloud.origin)
    assert depth == pytest.approx(5)
    assert position == pytest.approx([600, 400 - 400 / 5])
    assert (camera.width, camera.height, camera.name) == (1200, 800, "front")
    assert np.allclose(opening_beside(path, (0, 0, 1)).center, camera.center - [0, 0, 1])


def test_a_turned_camera_of_another_size(tmp_path):
    # A quarter turn about y: it looks along -x.
    turned = [0, np.sqrt(0.5), 0, np.sqrt(0.5)]
    path = write(tmp_path / "scene.glb", translation=[3, 1, 0], rotation=turned, scale=[2, 2, 2])
    (camera,) = cameras_in_gltf(path)
    (position,), (depth,) = camera.project(load_gaussians(path).means)
    assert depth == pytest.approx(3)
    assert position == pytest.approx([600, 400])


def test_files_with_a_frame_of_their_own_have_none(tmp_path):
    assert cameras_in_gltf(write(tmp_path / "scene.glb", up=np.array([0, 0, 1.0]))) == []


@pytest.mark.parametrize("lens", [{}, {"yfov": 0}, {"yfov": 4}, {"yfov": 1, "aspectRatio": 0}])
def test_a_broken_lens_is_refused(lens, tmp_path):
    path = write(tmp_path / "scene.glb", lens=lens)
    with pytest.raises(FileFormatError, match="camera"):
        cameras_in_gltf(path)
    with pytest.warns(DataWarning, match="the start camera is not used"):
        assert opening_beside(path) is None


def test_a_mirrored_camera_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match="mirrors it"):
        cameras_in_gltf(write(tmp_path / "scene.glb", scale=[-1, 1, 1]))
