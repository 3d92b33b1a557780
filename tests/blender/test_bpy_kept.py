# ruff: noqa: E402
"""Other colours, light and cuts leave what an artist has added to a splat mesh."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

import bmesh
from _blender_scenes import ball_splats

from meshsplats import save_gaussians
from meshsplats.blender.inside import materials, objects, remaking, versions


@pytest.fixture
def ball(extension, tmp_path):
    """Splats with all that an artist may add to a mesh, in a scene without lamps."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.meshsplats_fast = True
    save_gaussians(ball_splats(40)[0], tmp_path / "ball.ply")
    bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / "ball.ply"), at_origin=True)
    obj = bpy.context.object
    data = obj.data
    group = obj.vertex_groups.new(name="Head")
    for vertex in data.vertices:
        group.add([vertex.index], 0.25 + 0.5 * (vertex.co.x > 0), "REPLACE")
    obj.shape_key_add(name="Basis")
    up = obj.shape_key_add(name="Up")
    up.data.foreach_set("co", (versions.positions(data) + np.float32([0, 0, 1])).ravel())
    up.driver_add("value").driver.expression = "0.5"
    places = versions.positions(data)[versions.corners(data)]
    data.uv_layers.new(name="Mine").uv.foreach_set("vector", places[:, :2].ravel())
    mask = data.attributes.new("Mask", "FLOAT", "POINT")
    mask.data.foreach_set("value", np.ascontiguousarray(versions.positions(data)[:, 0]))
    data.materials.append(bpy.data.materials.new("Metal"))
    data.polygons.foreach_set("material_index", (places[::3, 0] > 0).astype(np.int32))
    data["note"] = "mine"
    bpy.ops.ed.undo_push(message="before")
    return obj


def assert_kept(obj, metal=True):
    """All of it is there, and where it belongs."""
    data = obj.data
    places, corners = versions.positions(data), versions.corners(data)
    weights = [group.weight for vertex in data.vertices for group in vertex.groups]
    assert obj.vertex_groups.keys() == ["Head"]
    away = places[:, 0] - values(data, "Mask")
    np.testing.assert_allclose(away, away[0], atol=1e-5)
    was_right = values(data, "Mask") > 0
    np.testing.assert_array_equal(weights, 0.25 + 0.5 * was_right)
    keys = data.shape_keys.key_blocks
    assert keys.keys() == ["Basis", "Up"]
    for key, height in zip(keys, (0, 1), strict=True):
        there = np.empty(places.size, np.float32)
        key.data.foreach_get("co", there)
        np.testing.assert_allclose(there.reshape(-1, 3), places + np.float32([0, 0, height]), atol=1e-5)
    assert len(data.shape_keys.animation_data.drivers) == 1
    uv = np.empty(2 * len(corners), np.float32)
    data.uv_layers["Mine"].uv.foreach_get("vector", uv)
    away = uv.reshape(-1, 2) - places[corners, :2]
    np.testing.assert_allclose(away, np.broadcast_to(away[0], away.shape), atol=1e-5)
    assert data["note"] == "mine"
    assert data.materials[1].name == "Metal"
    index = np.empty(len(data.polygons), np.int32)
    data.polygons.foreach_get("material_index", index)
    np.testing.assert_array_equal(index, was_right[corners[::3]])
    first = corners.reshape(-1, 3)
    edges = np.array([edge.vertices[:] for edge in data.edges])
    own = np.empty(len(corners), np.int32)
    data.loops.foreach_get("edge_index", own)
    np.testing.assert_array_equal(
        np.sort(edges[own]), np.sort(np.stack([corners, np.roll(first, -1, axis=1).ravel()], axis=1))
    )
    assert not data.validate()


def values(data, name):
    found = np.empty(len(data.attributes[name].data), np.float32)
    data.attributes[name].data.foreach_get("value", found)
    return found


def test_shading_and_light(ball):
    before = objects.as_splat_mesh(ball).colors
    bpy.ops.object.meshsplats_shading(shading="lit")
    assert_kept(ball)
    assert ball.data.materials[0].name.startswith("Splats, lit")
    ball.data.vertices[0].co.z += 1e-3  # so that light is made anew
    bpy.ops.scene.meshsplats_bake_light(fast=True)
    ball.data.vertices[0].co.z -= 1e-3
    assert_kept(ball)
    bpy.ops.object.meshsplats_shading(shading="unlit")
    assert_kept(ball)
    assert [material.name.split(".")[0] for material in ball.data.materials] == ["Splats, unlit", "Metal"]
    np.testing.assert_array_equal(objects.as_splat_mesh(ball).colors, before)
    left = {"Color", "Mask", "Mine", "splat", "splat_center"}
    names = {attribute.name for attribute in ball.data.attributes}
    assert names & {"DisplayColor", "LitColor", "splat_normal", "Light", "light_point"} == set()
    assert left <= names


def test_undo(ball):
    name = ball.name
    for shading in ("lit", "unlit"):
        bpy.ops.object.meshsplats_shading("EXEC_DEFAULT", True, shading=shading)
    for lit in (True, False):
        bpy.ops.ed.undo()
        assert objects.is_lit(bpy.data.objects[name]) == lit
        assert_kept(bpy.data.objects[name])
    bpy.ops.ed.redo()
    assert objects.is_lit(bpy.data.objects[name])
    assert_kept(bpy.data.objects[name])


@pytest.mark.parametrize("lit", [False, True])
def test_both_parts_of_a_cut(ball, lit):
    if lit:
        bpy.ops.object.meshsplats_shading(shading="lit")
    count = len(ball.data.polygons)
    data = ball.data
    bpy.ops.object.meshsplats_cut(action="separate", shape="all", by_color=True, color=(0.8, 0.2, 0.1))
    (made,) = (o for o in bpy.context.scene.objects if o.type == "MESH" and o.name == "ball.001")
    assert ball.data == data
    assert 0 < len(made.data.polygons) < count
    assert len(made.data.polygons) + len(ball.data.polygons) == count
    for part in (ball, made):
        assert_kept(part)
        assert objects.is_lit(part) == lit


def test_another_user_of_the_mesh_keeps_it(ball):
    other = bpy.data.objects.new("other", ball.data)
    bpy.context.collection.objects.link(other)
    bpy.ops.object.meshsplats_shading(shading="lit")
    assert_kept(ball)
    assert_kept(other)
    assert [objects.is_lit(obj) for obj in (ball, other)] == [True, False]


def test_joined_materials_become_one(ball):
    data = ball.data
    data.materials.append(data.materials[0].copy())
    index = np.zeros(len(data.polygons), np.int32)
    data.polygons.foreach_get("material_index", index)
    index[:5] = 2
    data.polygons.foreach_set("material_index", index)
    bpy.ops.object.meshsplats_shading(shading="lit")
    assert [material.name.split(".")[0] for material in data.materials] == ["Splats, lit", "Metal"]
    after = np.zeros(len(data.polygons), np.int32)
    data.polygons.foreach_get("material_index", after)
    np.testing.assert_array_equal(after, np.where(index == 2, 0, index))


def shadow_distance(material):
    return material.node_tree.nodes[materials.SELF_SHADOW].outputs[0]


def test_a_material_that_was_changed_stays(ball, capfd):
    """Where its kind does; else in the file, as is said. Light and self-shadow distance are not its look."""
    bpy.ops.object.meshsplats_shading(shading="lit")
    fresh = ball.data.materials[0]
    materials.set_baked(fresh, True)
    assert not remaking._is_changed(fresh)
    fresh.node_tree.nodes.new("ShaderNodeHueSaturation")
    for how in ("light", "again"):
        before = shadow_distance(fresh).default_value
        if how == "light":
            bpy.ops.object.meshsplats_shading(shading="lit")
        else:
            ball.meshsplats.max_triangles, ball.meshsplats.shading = 200, "lit"
            bpy.ops.object.meshsplats_convert_again()
        assert ball.data.materials[0] == fresh
        assert not materials.shows_baked(fresh)
        assert (shadow_distance(fresh).default_value == before) == (how == "light")
    assert "stays in the file" not in capfd.readouterr().out
    shadow_distance(fresh).default_value, fresh.name = 0.123, "Bronze"
    bpy.ops.object.meshsplats_shading(shading="lit")
    assert [material.name for material in ball.data.materials] == ["Bronze", "Metal"]
    assert shadow_distance(fresh).default_value == np.float32(0.123)
    bpy.ops.object.meshsplats_shading(shading="unlit")
    assert [material.name.split(".")[0] for material in ball.data.materials] == ["Splats, unlit", "Metal"]
    assert "your material Bronze stays in the file" in capfd.readouterr().out
    assert fresh.use_fake_user


def test_a_material_that_was_changed_for_some_faces_is_not_that_of_all(ball, capfd):
    some = ball.data.materials[0].copy()
    some.pass_index = 3
    ball.data.materials[1] = some
    bpy.ops.object.meshsplats_shading(shading="unlit")
    assert [material.pass_index for material in ball.data.materials] == [0]
    assert some.use_fake_user
    assert f"your material {some.name} stays in the file" in capfd.readouterr().out


def test_convert_again_names_what_is_lost(ball, capfd):
    bpy.ops.object.meshsplats_convert_again()
    assert_kept(ball)
    assert "lost" not in capfd.readouterr().out
    ball.meshsplats.max_triangles = 200
    bpy.ops.object.meshsplats_convert_again()
    said = capfd.readouterr().out
    assert "lost its vertex groups, shape keys, UV maps, attributes (Mask), materials of faces" in said
    assert ball.data["note"] == "mine"
    assert ball.data.materials[1].name == "Metal"


def test_a_mesh_with_other_faces_is_cut_with_a_warning(ball, capfd):
    ball.data.attributes.remove(ball.data.attributes["splat"])
    edited = bmesh.new()
    edited.from_mesh(ball.data)
    bmesh.ops.join_triangles(edited, faces=edited.faces, angle_face_threshold=3.2, angle_shape_threshold=3.2)
    edited.to_mesh(ball.data)
    edited.free()
    assert any(len(polygon.vertices) == 4 for polygon in ball.data.polygons)
    bpy.ops.object.meshsplats_cut(shape="all", by_color=True, color=(0.8, 0.2, 0.1))
    assert "lost its vertex groups" in capfd.readouterr().out
