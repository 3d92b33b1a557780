# ruff: noqa: E402
"""Convert Again keeps what the user did: joined and edited objects are converted as they are now."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

import bmesh
from _blender_scenes import ball_splats

from meshsplats import bind, orbit, psnr, render, save_gaussians, save_mesh
from meshsplats.blender.inside import exporting, meshes, objects, sources
from meshsplats.conversion.recovery import recover_splats
from meshsplats.scene.base_mesh import BaseMesh


@pytest.fixture
def captures(extension, tmp_path):
    """Two captures in an empty scene, side by side; the first is active, both are selected."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    for name, seed in (("one", 0), ("two", 1)):
        cloud = ball_splats(200, noise=0.3, seed=seed)[0]
        save_gaussians(cloud, tmp_path / f"{name}.ply")
        bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / f"{name}.ply"), at_origin=True)
    one, two = bpy.data.objects["one"], bpy.data.objects["two"]
    two.location.x = 3
    one.rotation_euler.z += 0.5
    bpy.context.view_layer.update()
    one.select_set(True)
    bpy.context.view_layer.objects.active = one
    return one, two


def images(objs):
    mesh = exporting.exported(objs)
    views = [camera.with_near_plane(mesh.vertices) for camera in orbit(mesh, 2, width=60, height=60)]
    return views, [render(mesh, view).color for view in views]


def test_joined_captures_are_converted_both(captures):
    one, _ = captures
    bpy.ops.object.join()
    views, before = images([one])
    count = len(one.data.polygons)
    assert bpy.ops.object.meshsplats_convert_again() == {"FINISHED"}
    mesh = exporting.exported([one])
    assert (len(mesh.splats), len(mesh.faces)) == (400, count)
    for view, image in zip(views, before, strict=True):
        assert psnr(render(mesh, view).color, image) > 42
    one.meshsplats.max_triangles = 1600
    bpy.ops.object.meshsplats_convert_again()
    xs = np.quantile(exporting.exported([one]).vertices[:, 0], [0.1, 0.9])
    assert 1000 < len(one.data.polygons) <= 1600
    assert np.ptp(xs) > 3, "there is something of both"


def test_splats_stay_as_large_however_often_they_are_converted(captures, tmp_path):
    """Conversion makes small splats wider, for pixels, and faint ones smaller."""
    cloud = ball_splats(100)[0]
    cloud = replace(cloud, scales=0.02 * cloud.scales, opacities=np.full(100, 0.05))
    save_gaussians(cloud, tmp_path / "small.ply")
    bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / "small.ply"))
    obj = bpy.context.object
    del obj[sources.MADE]
    before = recover_splats(objects.as_splat_mesh(obj))[0]
    for _ in range(2):
        bpy.ops.object.meshsplats_convert_again()
    after = recover_splats(objects.as_splat_mesh(obj))[0]
    np.testing.assert_allclose(after.scales[:, :2], before.scales[:, :2], rtol=0.01)
    np.testing.assert_allclose(after.opacities, before.opacities, rtol=0.02)


@pytest.mark.parametrize("shading", ["unlit", "lit"])
def test_edits_are_converted_and_untouched_files_read_again(captures, shading):
    """Merging and shading do not count as edits, so that the file gives back what was merged."""
    one, two = captures
    two.select_set(False)
    bpy.context.scene.meshsplats_fast = True
    bpy.ops.object.meshsplats_shading(shading=shading)
    one.meshsplats.shading = shading
    one.location.z += 1
    full = len(one.data.polygons)
    for most, expected in ((800, range(500, 801)), (0, range(full, full + 1))):
        one.meshsplats.max_triangles = most
        bpy.ops.object.meshsplats_convert_again()
        assert len(one.data.polygons) in expected
        assert sources.is_as_made(one)
    bpy.ops.object.meshsplats_adjust(saturation=0.0)
    assert not sources.is_as_made(one)
    bpy.ops.object.meshsplats_cut(shape="all", by_color=True, color=(0.7, 0.7, 0.7), color_distance=0.05)
    left = objects.as_splat_mesh(one)
    bpy.ops.object.meshsplats_convert_again()
    again = objects.as_splat_mesh(one)
    assert 0 < len(again.splats) == len(left.splats) < 200
    assert np.ptp(again.colors[:, :3], axis=1).max() < 0.01, "still grey"
    assert not sources.is_as_made(one)


def test_what_would_be_lost_is_refused_with_a_remedy(captures, tmp_path):
    one, _ = captures
    edit = bmesh.new()
    edit.from_mesh(one.data)
    edit.faces.ensure_lookup_table()
    bmesh.ops.delete(edit, geom=[edit.faces[0]], context="FACES_ONLY")
    edit.to_mesh(one.data)
    edit.free()
    count = len(one.data.polygons)
    with pytest.raises(RuntimeError, match=r"one was edited.* a splat in it is incomplete.* Import its"):
        bpy.ops.object.meshsplats_convert_again()
    assert len(one.data.polygons) == count
    corners = np.array([[-1.0, -2, 0], [1, -2, 0], [1, 0, 0], [-1, 0, 0]])
    base = BaseMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), up=np.array([0, -1, 0]))
    save_mesh(bind(base, triangles=200).mesh, tmp_path / "prior.npz")
    bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / "prior.npz"))
    prior = bpy.context.object
    prior.parent.data.vertices[0].co.x += 1
    assert bpy.ops.object.meshsplats_convert_again() == {"FINISHED"}, "its base may have changed its shape"
    one.select_set(True)
    bpy.context.view_layer.objects.active = prior
    bpy.ops.object.join()
    count = len(prior.data.polygons)
    with pytest.raises(RuntimeError, match=r"prior was edited or joined.* its splats are bound"):
        bpy.ops.object.meshsplats_convert_again()
    assert len(prior.data.polygons) == count


@pytest.mark.parametrize("axes", ["z-up", "z-down", "y-up"])
def test_another_up_stands_a_capture_upright(captures, axes):
    """As it was turned and moved since; and on the ground where it stood."""
    one, _ = captures
    one.location, one.scale = (2, 1, 0.5), (2, 2, 2)
    one.meshsplats.axes = axes
    bpy.ops.object.meshsplats_convert_again()
    bpy.context.view_layer.update()
    up = {"z-up": (0, 0, 1), "z-down": (0, 0, -1), "y-up": (0, -1, 0)}[axes]
    world = np.array(one.matrix_world)[:3, :3]
    np.testing.assert_allclose(world @ up, (0, 0, 2), atol=1e-5)
    np.testing.assert_allclose((world @ world.T), 4 * np.eye(3), atol=1e-5)
    if axes != "y-up":
        points = meshes.world_points(one)
        np.testing.assert_allclose(points[:, 2].min(), 0.5, atol=0.6)
        np.testing.assert_allclose(points[:, :2].mean(axis=0), (2, 1), atol=0.3)
    one.rotation_euler.x += 0.3
    bpy.context.view_layer.update()
    before = np.array(one.matrix_world)
    if axes == "z-up":
        bpy.context.scene.meshsplats_fast = True
        bpy.ops.object.meshsplats_shading(shading="lit")
    bpy.ops.object.meshsplats_convert_again()
    bpy.context.view_layer.update()
    np.testing.assert_array_equal(np.array(one.matrix_world), before, "nothing more is turned")


def test_a_place_that_is_converted_again_is_not_searched_again(captures, monkeypatch):
    from meshsplats.blender import subject
    from meshsplats.blender.inside import views
    from meshsplats.cameras.trajectories import look_at

    asked = []
    monkeypatch.setattr(subject, "default_views", lambda *arguments, **_: asked.append(1))
    one, _ = captures
    bpy.context.scene.meshsplats_fast = True
    known = [look_at((0.1, y, 0.3), (1, 0.4, 0.3), fov=60, width=400, height=400) for y in (0.1, 0.2)]
    for cameras, times in ((known, 0), ([], 0), (None, 1)):
        if cameras is None:
            del one[views.VIEWS]
        else:
            views.remember(one, cameras)  # none: of what is seen from around
        one.meshsplats.shading = "lit"
        bpy.ops.object.meshsplats_convert_again()
        assert len(asked) == times
