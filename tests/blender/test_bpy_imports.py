# ruff: noqa: E402
"""Our files, opened by Blender's own importers, look right as they are or after one click."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats, cameras, random_mesh

from meshsplats import convert, render, save_mesh
from meshsplats.blender.inside import adjusting, foreign, frame, meshes, objects, rendering, stage, versions
from meshsplats.blender.inside.adjusting import Adjustment
from meshsplats.evaluation.metrics import psnr
from meshsplats.scene.colors import srgb_to_linear

UP = (0.0, -1.0, 0.0)


def usd_text(mesh) -> str:
    """What ``save_mesh`` writes as .usda, without its package: colour in linear light, opacity apart."""
    linear = srgb_to_linear(mesh.colors[:, :3])

    def row(values):
        return ", ".join(f"({', '.join(map(repr, map(float, v)))})" for v in values)

    return f"""#usda 1.0
(
    defaultPrim = "Splats"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "Splats"
{{
    quatd xformOp:orient = (0, 1, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:orient"]
    def Mesh "Mesh"
    {{
        uniform bool doubleSided = 1
        int[] faceVertexCounts = {[3] * len(mesh.faces)}
        int[] faceVertexIndices = {mesh.faces.ravel().tolist()}
        point3f[] points = [{row(mesh.vertices)}]
        color3f[] primvars:displayColor = [{row(linear)}] (interpolation = "vertex")
        float[] primvars:displayOpacity = {mesh.colors[:, 3].tolist()} (interpolation = "vertex")
        int[] primvars:face_splat = {mesh.face_splat.tolist()} (interpolation = "uniform")
        uniform token subdivisionScheme = "none"
    }}
}}
"""


def opened(mesh, suffix, folder):
    """The object that Blender's importer makes of ``mesh``, in an empty scene."""
    path = folder / f"m{suffix}"
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    if suffix == ".usda":
        path.write_text(usd_text(mesh))
        bpy.ops.wm.usd_import(filepath=str(path))
    else:
        save_mesh(mesh, path)
        if suffix == ".glb":
            bpy.ops.import_scene.gltf(filepath=str(path))
        else:  # the file's own axes: y is down in it
            bpy.ops.wm.ply_import(filepath=str(path), up_axis="NEGATIVE_Y", forward_axis="Z")
    bpy.context.view_layer.update()
    return next(obj for obj in bpy.data.objects if obj.type == "MESH")


def click(obj, shading):
    """What a user does: the object is chosen, and its shading."""
    if obj.name not in bpy.context.scene.collection.all_objects:
        bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.meshsplats_shading(shading=shading)


def shot(view, path):
    """The scene as ``view`` sees it, by exact settings, on white."""
    scene = bpy.context.scene
    camera = stage.add_camera(
        view, "camera", frame.to_blender(np.array(UP)), 100, stage.collection("Cameras")
    )
    stage.even_world((1, 1, 1))
    rendering.exact_settings(scene, "cycles")
    stage.aim(scene, view, camera)
    rendering.render_to(scene, path)
    return np.clip(rendering.read_pixels(path)[..., :3], 0, 1)


@pytest.mark.parametrize(("suffix", "least"), [(".glb", 50), (".ply", 60), (".usda", 60)])
def test_one_click_gives_the_exact_image(extension, tmp_path, suffix, least):
    """Upright, in its place, blended as ``render`` blends. (Blender keeps 8 bits of a .glb's colours.)"""
    mesh = random_mesh(150, up=UP)
    view = cameras()[1]
    click(opened(mesh, suffix, tmp_path), "unlit")
    assert psnr(shot(view, tmp_path / "p.exr"), render(mesh, view).color) > least


def test_a_glb_for_linear_blending_stays_so(extension, tmp_path):
    mesh = random_mesh(150, up=UP, blending="linear")
    view = cameras()[1]
    obj = opened(mesh, ".glb", tmp_path)
    click(obj, "unlit")
    assert objects.as_splat_mesh(obj).blending == "linear"
    assert psnr(shot(view, tmp_path / "p.exr"), render(mesh, view).color) > 50
    scene = bpy.context.scene
    objects.render_settings(scene, [obj], lit=False)
    assert scene.view_settings.view_transform == "Standard"
    other = bpy.data.objects.new("other", bpy.data.meshes.new("display"))
    assert "too dark" in objects.clash([obj, other], lit=False)
    objects.render_settings(scene, [obj, other], lit=False)
    assert scene.view_settings.view_transform == "Raw"
    assert objects.clash([obj, other], lit=True) == objects.clash([obj], lit=False) == ""


def test_a_glb_needs_no_click(tmp_path):
    mesh = random_mesh(150, up=UP)
    view = cameras()[0]
    linear = np.column_stack([srgb_to_linear(mesh.colors[:, :3]), mesh.colors[:, 3]])
    opened(mesh, ".glb", tmp_path)
    assert psnr(shot(view, tmp_path / "p.exr"), render(replace(mesh, colors=linear), view).color) > 55


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".usda"])
def test_lit_click_gives_linear_colours_and_smoothed_normals(extension, tmp_path, suffix):
    cloud, _ = ball_splats(300)
    mesh = convert(cloud, mode="flat")
    obj = opened(mesh, suffix, tmp_path)
    bpy.context.scene.meshsplats_fast = True  # how well light is made is tested elsewhere
    click(obj, "lit")
    data = obj.data
    assert data.materials[0].name.startswith("Splats, lit")
    assert 1 < data[objects.LAYERS] < 200
    normals = np.empty(3 * len(data.vertices), np.float32)
    data.attributes[meshes.NORMAL].data.foreach_get("vector", normals)
    outward = np.empty(3 * len(data.vertices), np.float32)
    data.vertices.foreach_get("co", outward)
    outward, normals = outward.reshape(-1, 3), normals.reshape(-1, 3)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.median((outward * normals).sum(axis=1)) > 0.9, "nearly the ball's own, which turn across a disc"
    again = objects.as_splat_mesh(obj)
    assert np.abs(np.sort(again.colors[:, 0]) - np.sort(mesh.colors[:, 0])).max() < 0.01


def test_up_and_owners_survive(tmp_path):
    mesh = random_mesh(20, up=UP)
    for suffix in (".glb", ".usda"):
        taken = foreign.splat_mesh(opened(mesh, suffix, tmp_path))
        world = opened(mesh, suffix, tmp_path).matrix_world.to_3x3()
        assert np.allclose(np.array(world) @ taken.up, [0, 0, 1], atol=1e-6)
    assert taken.face_splat.tolist() == mesh.face_splat.tolist()


def test_an_object_that_is_no_splat_mesh_is_refused(extension):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with pytest.raises(RuntimeError, match="context is incorrect"):
        click(bpy.data.objects.new("empty", None), "lit")
    data = bpy.data.meshes.new("square")
    data.from_pydata([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [], [(0, 1, 2, 3)])
    obj = bpy.data.objects.new("square", data)
    with pytest.raises(RuntimeError, match="no vertex colours"):
        click(obj, "lit")
    data.color_attributes.new("c", "FLOAT_COLOR", "POINT")
    with pytest.raises(RuntimeError, match="triangulate it first"):
        click(obj, "lit")


def test_a_georeferenced_mesh_stands_near_zero_and_keeps_its_origin():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    far = np.array([500_000.125, 4_500_000.0, 100.0])
    mesh = replace(random_mesh(20, up=UP), origin=far)
    obj = objects.add(objects.prepare(mesh, False), "far", bpy.context.collection)
    assert np.abs(np.array(obj.location)).max() < 100
    again = objects.as_splat_mesh(obj)
    np.testing.assert_array_equal(again.origin, far)
    np.testing.assert_allclose(again.vertices, mesh.vertices, atol=1e-5)
    near = objects.add(
        objects.prepare(replace(mesh, origin=np.zeros(3)), False), "near", bpy.context.collection
    )
    assert not objects.as_splat_mesh(near).origin.any()


@pytest.fixture
def tiles(extension, tmp_path):
    """Files of three tiles of a survey, each with coordinates of its own, 300 m apart from west to east."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    paths = []
    for i in range(3):
        cloud = replace(ball_splats(40)[0], origin=np.array([500_000.0 + 300 * i, 4_500_000, 100]))
        paths.append(tmp_path / f"{'abc'[i]}.npz")
        save_mesh(replace(convert(cloud), up=np.array([0, 0, 1], np.float32)), paths[-1])
    return paths


def test_tiles_of_a_survey_lie_side_by_side(tiles, capfd):
    """Of one import and of a later one, wherever the first stands."""
    first = [{"name": path.name} for path in tiles[:2]]
    folder = str(tiles[0].parent)
    bpy.ops.import_scene.meshsplats(directory=folder, files=first, at_origin=True, frame_view=False)
    assert "placed by their coordinates" not in capfd.readouterr().out
    bpy.ops.import_scene.meshsplats(filepath=str(tiles[2]), frame_view=False)
    assert "placed by their coordinates beside what was imported before: c" in capfd.readouterr().out
    a, b, c = (bpy.data.objects[name] for name in "abc")
    np.testing.assert_allclose(a.location, 0, atol=1e-5)
    steps = [np.array(two.location) - np.array(one.location) for one, two in ((a, b), (b, c))]
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 300, rtol=1e-4)
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-2)


def test_coordinates_of_what_is_gone_do_not_count(tiles):
    bpy.ops.import_scene.meshsplats(filepath=str(tiles[0]), frame_view=False)
    bpy.data.objects.remove(bpy.data.objects["a"])
    bpy.ops.import_scene.meshsplats(filepath=str(tiles[2]), frame_view=False)
    bpy.ops.import_scene.meshsplats(filepath=str(tiles[1]), frame_view=False)
    away = np.array(bpy.data.objects["b"].location) - np.array(bpy.data.objects["c"].location)
    np.testing.assert_allclose(np.linalg.norm(away), 300, rtol=1e-4)


@pytest.mark.skipif(bpy.app.version < (5, 0), reason="older files have one working space")
def test_linear_colours_are_those_of_the_working_space(tmp_path):
    mesh = random_mesh(150, up=UP, blending="linear")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    bpy.ops.wm.set_working_color_space(working_space="ACEScg")
    obj = objects.add(objects.prepare(mesh, False), "splats", bpy.context.collection)
    assert np.abs(meshes.read_colors(obj.data, meshes.COLOR)[:, :3] - mesh.colors[:, :3]).max() > 0.05
    np.testing.assert_allclose(objects.as_splat_mesh(obj).colors, mesh.colors, atol=1e-5)
    change = Adjustment(saturation=0.5)
    adjusting.adjust(obj.data, change)
    found = objects.as_splat_mesh(obj).colors
    bpy.ops.wm.read_factory_settings(use_empty=True)
    plain = objects.add(objects.prepare(mesh, False), "splats", bpy.context.collection)
    adjusting.adjust(plain.data, change)
    np.testing.assert_allclose(found, objects.as_splat_mesh(plain).colors, atol=1e-5)
