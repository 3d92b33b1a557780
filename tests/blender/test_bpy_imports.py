# ruff: noqa: E402
"""Our files, opened by Blender's own importers, look right as they are or after one click."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats, cameras, random_mesh

from meshsplats import convert, render, save_mesh
from meshsplats.blender.inside import foreign, frame, meshes, objects, rendering, stage, versions
from meshsplats.blender.options import FAST
from meshsplats.colors import srgb_to_linear
from meshsplats.evaluation.metrics import psnr

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
def test_one_click_gives_the_exact_image(tmp_path, suffix, least):
    """Upright, in its place, blended as ``render`` blends. (Blender keeps 8 bits of a .glb's colours.)"""
    mesh = random_mesh(150, up=UP)
    view = cameras()[1]
    objects.dress(opened(mesh, suffix, tmp_path), lit=False)
    assert psnr(shot(view, tmp_path / "p.exr"), render(mesh, view).color) > least


def test_a_glb_for_linear_blending_stays_so(tmp_path):
    mesh = random_mesh(150, up=UP, blending="linear")
    view = cameras()[1]
    obj = opened(mesh, ".glb", tmp_path)
    objects.dress(obj, lit=False)
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
def test_lit_click_gives_linear_colours_and_smoothed_normals(tmp_path, suffix, monkeypatch):
    monkeypatch.setattr(objects, "CAREFUL", FAST)  # how well light is made is tested elsewhere
    cloud, _ = ball_splats(300)
    mesh = convert(cloud, mode="flat")
    obj = opened(mesh, suffix, tmp_path)
    objects.dress(obj, lit=True)
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


def test_an_object_that_is_no_splat_mesh_is_refused():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with pytest.raises(ValueError, match="no vertex colours"):
        objects.dress(bpy.data.objects.new("empty", None), True)
    data = bpy.data.meshes.new("square")
    data.from_pydata([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [], [(0, 1, 2, 3)])
    obj = bpy.data.objects.new("square", data)
    with pytest.raises(ValueError, match="no vertex colours"):
        objects.dress(obj, True)
    data.color_attributes.new("c", "FLOAT_COLOR", "POINT")
    with pytest.raises(ValueError, match="triangulate it first"):
        objects.dress(obj, True)


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
