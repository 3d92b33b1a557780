# ruff: noqa: E402
"""Splat meshes of a Blender file become splats again, where they are."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats

from meshsplats import convert
from meshsplats.blender.inside import exporting, frame, objects
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.spherical_harmonics import sh_basis


def test_moved_splats_keep_shape_and_what_they_show_from_each_side():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    cloud = ball_splats(50)[0]
    rng = np.random.default_rng(0)
    sh = np.concatenate([cloud.sh, 0.2 * rng.normal(size=(50, 3, 3))], axis=1)
    cloud = GaussianCloud(cloud.means, cloud.quaternions, cloud.scales, 0.5 * cloud.opacities, sh)
    mesh = convert(cloud, footprint="none", shrink_faint=False)
    obj = objects.add(objects.prepare(mesh, False), "ball", bpy.context.collection)
    foot = np.array(obj.location)
    obj.rotation_euler, obj.location, obj.scale = (0.4, 0.2, 1), (3, 0, 1), (2, 2, 2)
    bpy.context.view_layer.update()

    exported = exporting.exported([obj])
    found, left_out = exporting.exported_splats([obj])
    assert left_out == 0
    # From the file's world to Blender's, there to where the object was put, and back to y down.
    upright = frame.to_blender(np.array([0.0, -1, 0]))
    world = np.array(obj.matrix_world)
    turn = upright.T @ world[:3, :3]
    origin = np.array(obj.data[objects.ORIGIN])
    np.testing.assert_allclose(upright @ origin, foot, atol=1e-6)
    expected = (cloud.means - origin) @ turn.T + upright.T @ world[:3, 3]
    np.testing.assert_allclose(found.means, expected, atol=1e-4)
    np.testing.assert_allclose(found.up, [0, -1, 0], atol=1e-6)
    largest = np.sort(found.scales, axis=1)[:, 1:] / 2
    np.testing.assert_allclose(largest, np.sort(cloud.scales, axis=1)[:, 1:], rtol=2e-3)
    np.testing.assert_allclose(found.sh[:, 0], cloud.sh[:, 0], atol=1e-4)
    # Seen along the turned direction, each shows what it showed along the first.
    before = np.array([[0.6, 0.0, 0.8]])
    rotation = turn / 2

    def shown(harmonics, direction):
        return np.einsum("nk,skc->sc", sh_basis(direction, 1)[:, 1:], harmonics)

    seen = shown(cloud.sh[:, 1:], before)
    np.testing.assert_allclose(shown(found.sh[:, 1:], before @ rotation.T), seen, atol=1e-4)
    np.testing.assert_allclose(
        shown(exported.harmonics, before @ (world[:3, :3] / 2).T), seen, atol=1e-4, err_msg="the mesh, too"
    )


def test_cut_splats_are_counted():
    import bmesh

    bpy.ops.wm.read_factory_settings(use_empty=True)
    obj = objects.add(objects.prepare(convert(ball_splats(50)[0]), False), "ball", bpy.context.collection)
    edit = bmesh.new()
    edit.from_mesh(obj.data)
    edit.faces.ensure_lookup_table()
    bmesh.ops.delete(edit, geom=[edit.faces[0]], context="FACES_ONLY")
    edit.to_mesh(obj.data)
    edit.free()
    found, left_out = exporting.exported_splats([obj])
    assert (len(found), left_out) == (49, 1)
