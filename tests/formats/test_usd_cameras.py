"""Cameras inside USD files with meshes."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats import BaseMesh, load_mesh, load_vertex_colored, look_at, save_base
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats.usd.cameras import cameras_in_usd
from meshsplats.viewpoints.showing import default_views

pytest.importorskip("pxr", reason="install meshsplats[usd]")

UP = np.array([0.1, -1, 0.2]) / np.linalg.norm([0.1, -1, 0.2])
STAGE = """#usda 1.0
(
    upAxis = "{up}"
    metersPerUnit = 1
)
def Mesh "Triangle"
{{
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 1, 0), (1, 1, 0), (0, 2, 0)]
    color3f[] primvars:displayColor = [(1, 0, 0)]
}}
def Xform "Rig"
{{
    double3 xformOp:translate = (0, 0, 5)
    float3 xformOp:scale = (2, 2, 2)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    def Camera "Front"
    {{
        float focalLength = {focal}
        float horizontalAperture = 30
        float verticalAperture = {high}
        token visibility = "{visibility}"
        token projection = "{projection}"
    }}
}}
"""
WHOLE = {"up": "Y", "focal": 10, "high": 20, "visibility": "inherited", "projection": "perspective"}


def triangle() -> BaseMesh:
    return BaseMesh(np.eye(3) * 9, [[0, 1, 2]], np.ones((3, 4)), up=UP, origin=np.array([5e5, 0, 0]))


def around(count: int):
    places = np.random.default_rng(3).uniform(-4, 4, (count, 3))
    return [look_at(place, (1, 2, 3), up=tuple(UP), fov=70, width=90, height=60) for place in places]


def write(path, **changes):
    path.write_text(STAGE.format(**WHOLE | changes))
    return path


def test_usds_own_library_sees_the_surface_by_its_views(tmp_path):
    from pxr import Usd, UsdGeom

    base, given = triangle(), around(3)
    save_base(base, tmp_path / "a.usdc", cameras=given)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/Splats/Surface"))
    to_world = np.array(shape.ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
    points = np.array(shape.GetPointsAttr().Get(), np.float64)
    cameras = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    assert len(cameras) == 3
    for prim, camera in zip(cameras, given, strict=True):
        frustum = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default()).frustum
        clip = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
        seen = np.c_[points, np.ones(3)] @ to_world @ clip
        places, depths = camera.project(points)
        np.testing.assert_allclose(seen[:, 3], depths, atol=1e-5)
        across = (seen[:, 0] / seen[:, 3] + 1) / 2 * camera.width
        down = (1 - seen[:, 1] / seen[:, 3]) / 2 * camera.height
        np.testing.assert_allclose(np.c_[across, down], places, atol=1e-2)


def test_cameras_of_other_programs(tmp_path):
    """In units and the frame of the stage, whatever the size of what they hang on."""
    path = write(tmp_path / "a.usda")
    (camera,) = cameras_in_usd(path)  # looks along -z, y points up
    mesh = load_mesh(path)
    positions, depths = camera.project(mesh.vertices + mesh.origin)
    np.testing.assert_allclose(depths, 5)
    # Half of the height is seen at a depth of 1: the image is 800 pixels high, 10 at a depth of 5.
    np.testing.assert_allclose(positions, [[600, 320], [680, 320], [600, 240]], atol=1e-6)
    assert (camera.width, camera.height, camera.name) == (1200, 800, "Front")


@pytest.mark.parametrize("changes", [{"visibility": "invisible"}, {"projection": "orthographic"}])
def test_cameras_that_nobody_looks_through_are_left_out(tmp_path, changes):
    assert cameras_in_usd(write(tmp_path / "a.usda", **changes)) == []


def test_a_mesh_without_cameras_takes_no_second_process(tmp_path, monkeypatch):
    save_base(triangle(), tmp_path / "a.usdc")
    save_base(triangle(), tmp_path / "b.usdc", cameras=around(1))
    monkeypatch.setattr("meshsplats.formats.usd.cameras.extracted", lambda *_: ({"cameras": []}, 1 / 0))
    assert cameras_in_usd(tmp_path / "a.usdc") == []
    with pytest.raises(ZeroDivisionError):
        cameras_in_usd(tmp_path / "b.usdc")


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("changes", [{"high": 0}, {"focal": "nan"}])
def test_a_broken_lens_is_refused(tmp_path, changes):
    path = write(tmp_path / "a.usda", **changes)
    with pytest.raises(FileFormatError, match=r"a\.usda: a camera needs"):
        cameras_in_usd(path)
    with pytest.warns(DataWarning, match="the cameras of the file are not used"):
        assert default_views(load_mesh(path), path, 4) is None


def test_a_surface_is_seen_by_the_cameras_in_its_file(tmp_path):
    path, given = tmp_path / "room.usda", around(8)
    save_base(triangle(), path, cameras=given)
    mesh = load_vertex_colored(path)
    found, said = default_views(mesh, path, 4, side=(80, 60))
    assert said == "seen from 4 of the 8 cameras in its file"
    np.testing.assert_allclose([c.center for c in found], [c.center for c in given[::2]], atol=1e-4)
