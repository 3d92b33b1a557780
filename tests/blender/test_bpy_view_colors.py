# ruff: noqa: E402
"""View-dependent colours in Blender: unlit images are those of ``render``; they are read back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

import bmesh
from _blender_scenes import ball_splats, random_mesh
from _eevee import draw_by_eevee
from _local import shared_data
from mathutils import Matrix

from meshsplats import convert, load_gaussians, orbit, render, save_mesh
from meshsplats.blender import SceneOptions, draw
from meshsplats.blender.inside import (
    exporting,
    far_to_near,
    foreign,
    frame,
    meshes,
    objects,
    turning,
    versions,
)
from meshsplats.blender.inside.rendering import read_pixels
from meshsplats.demo_scene import make_scene
from meshsplats.evaluation.metrics import psnr
from meshsplats.scene.spherical_harmonics import moved_harmonics


def colorful(degree: int):
    """The still life with strong harmonics, and colours up to above white. Its triangles are small: Blender
    shades fragments, not vertices."""
    scene = make_scene(1500)
    rng = np.random.default_rng(degree)
    sh = rng.normal(0, 0.4, (len(scene), (degree + 1) ** 2, 3))
    sh[:, 0] = 3 * scene.sh[:, 0]
    return convert(replace(scene, sh=sh))


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_cycles_draws_what_the_renderer_draws(degree, tmp_path):
    mesh = colorful(degree)
    views = orbit(mesh, 2, azimuth=20, width=120, height=100)
    paths = [tmp_path / f"{i}.exr" for i in range(len(views))]
    draw(mesh, views, images=paths, options=SceneOptions())
    for view, path in zip(views, paths, strict=True):
        drawn = read_pixels(path)[..., :3]
        assert psnr(drawn, render(mesh, view).color) > 50, view.name
        assert psnr(drawn, render(mesh.of_degree(0), view).color) < 30


@pytest.mark.nightly(keep=1)
@pytest.mark.parametrize("degree", [3, 2])
def test_eevee_takes_as_many_attributes(degree, tmp_path):
    """It draws wrong colours, or nothing, where a material reads more than 14."""
    mesh = colorful(degree)
    view = orbit(mesh, 1, azimuth=20, width=120, height=100)[0]
    draw_by_eevee(mesh, [view], images=[tmp_path / "a.exr"], options=SceneOptions(engine="eevee"))
    drawn = read_pixels(tmp_path / "a.exr")[..., :3].clip(0, 1)
    image = render(mesh, view, samples=4, order="splat").color.clip(0, 1)
    plain = render(mesh.of_degree(0), view, samples=4, order="splat").color
    assert psnr(drawn, image) > psnr(drawn, plain.clip(0, 1)) + 6


def test_a_capture_in_cycles(tmp_path):
    cloud = load_gaussians(shared_data("splats/playbot_lod5_3k_sh2.ply"))
    mesh = convert(cloud)
    view = orbit(mesh, 1, azimuth=40, width=200, height=200)[0]
    draw(mesh, [view], images=[tmp_path / "a.exr"], options=SceneOptions())
    drawn, expected = read_pixels(tmp_path / "a.exr")[..., :3], render(mesh, view).color
    assert psnr(drawn.clip(0, 1), expected.clip(0, 1)) > 60


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_an_object_gives_its_harmonics_back(degree):
    mesh = colorful(degree)
    obj = objects.add(objects.prepare(mesh, False), "splats", bpy.context.scene.collection)
    found = objects.as_splat_mesh(obj)
    assert np.array_equal(found.harmonics, mesh.harmonics)
    assert np.array_equal(found.colors, mesh.colors)
    assert len([a for a in obj.data.attributes if a.name.startswith("splat_sh_")]) <= 12
    lit = objects.prepare(mesh, True, fast=True, views=())
    assert lit["harmonics"] is None
    assert lit["colors"].max() <= 1
    assert meshes.read_harmonics(obj.data).shape == (len(mesh.vertices), mesh.harmonics.shape[1], 3)


@pytest.fixture
def followed():
    """An empty scene with the handler of the extension."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    handlers = bpy.app.handlers.depsgraph_update_post
    handlers.append(lambda _, depsgraph: far_to_near.after_update(depsgraph))
    yield bpy.context.scene
    handlers.clear()


def balls(scene, count):
    """Selected objects, each turned in its own way, the first one active."""
    made = []
    for i in range(count):
        cloud = ball_splats(60, seed=i)[0]
        sh = np.concatenate([cloud.sh, np.random.default_rng(i).normal(0, 0.2, (60, 3, 3))], axis=1)
        mesh = convert(replace(cloud, sh=sh))
        obj = objects.add(objects.prepare(mesh, False), "ball", scene.collection)
        obj.rotation_euler, obj.location.x = (0.4 + i, 0.2, 1 - i), 3 * i
        made.append(obj)
    bpy.context.view_layer.update()
    for obj in made:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = made[0]
    return made


def assert_seen_alike(obj, before):
    """In exports, and by the attributes that the material reads."""
    bpy.context.view_layer.update()
    after = exporting.exported([obj])
    np.testing.assert_allclose(after.vertices, before.vertices, atol=1e-5)
    np.testing.assert_allclose(after.harmonics, before.harmonics, atol=0.01)
    own = meshes.read_harmonics(obj.data, after.faces[after.splats.starts, 0])
    turn = np.array(obj.matrix_world)[:3, :3]
    np.testing.assert_allclose(moved_harmonics(own, turn), before.harmonics, atol=0.01)


def test_colours_stay_where_a_rotation_is_applied(followed):
    (obj,) = balls(followed, 1)
    before = exporting.exported([obj])
    bpy.ops.object.transform_apply()
    assert_seen_alike(obj, before)
    obj.scale.x = -1
    bpy.context.view_layer.update()
    mirrored = exporting.exported([obj]).harmonics
    bpy.ops.object.transform_apply()
    bpy.context.view_layer.update()
    np.testing.assert_allclose(exporting.exported([obj]).harmonics, mirrored, atol=0.01)
    assert np.abs(mirrored - before.harmonics).max() > 0.2


def test_a_file_of_an_earlier_release_may_be_in_edit_mode(followed):
    """Blender opens a file in the mode that it was saved in: other objects are brought up to date at once."""
    edited, other = balls(followed, 2)
    for obj in (edited, other):
        obj.data.attributes.remove(obj.data.attributes[turning.REST])
    other.select_set(False)
    bpy.ops.object.mode_set(mode="EDIT")
    far_to_near.renew()
    assert turning.REST in other.data.attributes
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    assert turning.REST in edited.data.attributes


def test_colours_of_appended_splats_stay_where_a_rotation_is_applied(followed, tmp_path):
    """Of a file of the command, or of an earlier release: nothing is called when they are appended."""
    (saved,) = balls(followed, 1)
    saved.data.attributes.remove(saved.data.attributes[turning.REST])
    bpy.data.libraries.write(str(tmp_path / "ball.blend"), {saved})
    bpy.data.objects.remove(saved)
    with bpy.data.libraries.load(str(tmp_path / "ball.blend")) as (_, given):
        given.objects = ["ball"]
    (obj,) = given.objects
    followed.collection.objects.link(obj)
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj
    bpy.context.view_layer.update()
    before = exporting.exported([obj])
    bpy.ops.object.transform_apply()
    assert_seen_alike(obj, before)


@pytest.mark.parametrize("count", [2, 3])
def test_colours_stay_where_objects_are_joined(followed, count):
    objs = balls(followed, count)
    before = exporting.exported(objs)
    bpy.ops.object.join()
    assert_seen_alike(objs[0], before)


def test_colours_turn_with_splats_that_are_turned(followed):
    (obj,) = balls(followed, 1)
    obj.matrix_world = Matrix()
    bpy.context.view_layer.update()
    before = exporting.exported([obj])
    turn = np.array(Matrix.Rotation(1.2, 3, (1, 2, 3)))
    half = before.splats.of_vertex >= 30
    places = versions.positions(obj.data)
    places[half] = places[half] @ turn.T
    versions.set_positions(obj.data, places)
    obj.data.update()
    bpy.context.view_layer.update()
    found = meshes.read_harmonics(obj.data, before.faces[before.splats.starts, 0])
    np.testing.assert_array_equal(found[:30], before.harmonics[:30])
    np.testing.assert_allclose(found[30:], moved_harmonics(before.harmonics[30:], turn), atol=0.01)
    cut = bmesh.new()
    cut.from_mesh(obj.data)
    cut.verts.ensure_lookup_table()
    bmesh.ops.delete(cut, geom=[cut.verts[2], cut.verts[3]], context="VERTS")
    cut.to_mesh(obj.data)
    cut.free()
    bpy.context.view_layer.update()
    after = exporting.exported([obj])
    np.testing.assert_allclose(after.harmonics, found, atol=0.02, err_msg="a part of a splat is not turned")


def test_normals_turn_with_the_mesh(followed):
    mesh = random_mesh(50)
    normals = np.repeat(np.random.default_rng(0).normal(size=(50, 3)), 3, axis=0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    data = meshes.make_mesh(
        "m", mesh.vertices, mesh.faces, mesh.colors, normals=normals, face_splat=mesh.face_splat
    )
    turning.remember(data)
    turn = Matrix.Rotation(1.2, 4, (1, 2, 3))
    data.transform(turn)
    turning.follow(data)
    found = np.empty(normals.size, np.float32)
    data.attributes[meshes.NORMAL].data.foreach_get("vector", found)
    np.testing.assert_allclose(found.reshape(-1, 3), normals @ np.array(turn)[:3, :3].T, atol=1e-3)
    turning.follow(data)  # once
    again = np.empty_like(found)
    data.attributes[meshes.NORMAL].data.foreach_get("vector", again)
    np.testing.assert_array_equal(again, found)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_glb_with_texture_coordinates_has_its_harmonics_after_a_click(extension, degree, tmp_path):
    mesh = replace(colorful(degree), up=np.array([0, 0, 1], np.float32))
    save_mesh(mesh, tmp_path / "m.glb", harmonics="texcoords")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    bpy.ops.import_scene.gltf(filepath=str(tmp_path / "m.glb"))
    bpy.context.view_layer.update()
    obj = next(obj for obj in bpy.data.objects if obj.type == "MESH")
    found = foreign.splat_mesh(obj)
    assert len(found.harmonics) == mesh.splat_count
    turn = np.array(obj.matrix_world.to_3x3(), np.float64)
    world = frame.to_blender(np.array(mesh.up, np.float64))
    expected = moved_harmonics(mesh.harmonics, turn.T @ world)
    largest = np.abs(mesh.harmonics).max()
    np.testing.assert_allclose(found.harmonics, expected, atol=0.02 * largest)
    np.testing.assert_allclose(found.colors, mesh.colors, atol=0.01)
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.meshsplats_shading(shading="unlit")
    assert meshes.read_harmonics(obj.data) is not None
