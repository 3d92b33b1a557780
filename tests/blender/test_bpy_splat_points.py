# ruff: noqa: E402
"""Splats that Blender imported itself (5.3): read from its point clouds as they were in the file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats
from _splat_points import splat_points

from meshsplats import DataWarning, convert
from meshsplats.blender.inside import frame, objects
from meshsplats.blender.inside import splat_points as reader


@pytest.fixture
def collection():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene.collection


def made(cloud, collection):
    obj = splat_points(cloud, "ball", collection)
    if obj is None:
        pytest.skip("Blender 4.2 makes no point clouds to edit")
    return obj


def read(obj):
    return reader.cloud_of(obj, bpy.context.evaluated_depsgraph_get())


def world_vertices(obj):
    bpy.context.view_layer.update()
    points = np.empty(3 * len(obj.data.vertices), np.float32)
    obj.data.vertices.foreach_get("co", points)
    matrix = np.array(obj.matrix_world)
    return points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]


def test_splats_are_those_of_the_file(collection):
    cloud = ball_splats(300)[0]
    found = read(made(cloud, collection))
    for name in ("means", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(found, name), getattr(cloud, name)), name
    assert np.abs(found.quaternions - cloud.quaternions).max() < 1e-6


@pytest.mark.parametrize("terms", [3, 8, 15])
def test_harmonics_are_those_of_the_file(collection, terms):
    sh = np.random.default_rng(0).normal(0, 0.2, (20, 1 + terms, 3)).astype(np.float32)
    cloud = replace(ball_splats(20)[0], sh=sh)
    obj = made(cloud, collection)
    found = read(obj)
    assert np.array_equal(found.sh, sh)
    np.testing.assert_array_equal(convert(found).harmonics, convert(cloud).harmonics)
    obj.data.attributes.remove(obj.data.attributes[f"radiance:sh_{terms - 1}"])
    kept = {3: 1, 8: 4, 15: 9}[terms]
    assert np.array_equal(read(obj).sh, sh[:, :kept]), "whole degrees"


def test_the_mesh_stands_where_the_splats_do(collection):
    """Under a parent, moved, turned and stretched."""
    cloud = ball_splats(100)[0]
    obj = made(cloud, collection)
    obj.parent = bpy.data.objects.new("parent", None)
    collection.objects.link(obj.parent)
    obj.parent.location, obj.parent.scale = (1, 2, 3), (2, 2, 2)
    obj.location, obj.rotation_euler, obj.scale = (0.5, 0, -1), (-1.2, 0.3, 0.7), (1, 1, 2)
    bpy.context.view_layer.update()
    mesh = convert(read(obj), up=frame.up_of(obj))
    prepared = objects.prepare(mesh, lit=False)
    placed = objects.add(prepared, "mesh", collection)
    reader.take_place(placed, obj, prepared["origin"])
    matrix = np.array(obj.matrix_world)
    expected = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.abs(world_vertices(placed) - expected).max() < 1e-5
    obj.parent.location.x += 5
    expected[:, 0] += 5
    assert np.abs(world_vertices(placed) - expected).max() < 1e-5, "with the same parent"


def test_modifiers_count(collection):
    """Nodes that keep the splats of the upper half."""
    obj = made(ball_splats(200)[0], collection)
    tree = bpy.data.node_groups.new("half", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    delete, index = tree.nodes.new("GeometryNodeDeleteGeometry"), tree.nodes.new("GeometryNodeInputIndex")
    compare = tree.nodes.new("FunctionNodeCompare")
    compare.data_type, compare.operation = "INT", "GREATER_EQUAL"
    values = [socket for socket in compare.inputs if socket.type == "INT"]
    values[1].default_value = 150
    tree.links.new(index.outputs[0], values[0])
    tree.links.new(compare.outputs[0], delete.inputs["Selection"])
    tree.links.new(start.outputs[0], delete.inputs["Geometry"])
    tree.links.new(delete.outputs[0], end.inputs[0])
    obj.modifiers.new("half", "NODES").node_group = tree
    assert len(read(obj)) == 150


def test_unusable_splats_are_left_out_and_counted(collection):
    cloud = ball_splats(50)[0]
    obj = made(cloud, collection)
    values = np.asarray(cloud.means).copy()
    values[7] = np.nan
    obj.data.attributes["position"].data.foreach_set("vector", values.ravel())
    turns = np.asarray(cloud.quaternions).copy()
    turns[9] = 0
    obj.data.attributes["rotation"].data.foreach_set("value", turns.ravel())
    obj.data.update_tag()
    with pytest.warns(DataWarning, match="2 of 50 splats are unusable"):
        found = read(obj)
    assert np.array_equal(found.means, np.delete(cloud.means, (7, 9), axis=0))


def test_other_points_are_no_splats(collection):
    obj = made(ball_splats(5)[0], collection)
    assert reader.is_splats(obj)
    obj.data.attributes.remove(obj.data.attributes["scale"])
    assert not reader.is_splats(obj)
    with pytest.raises(ValueError, match="leave no splats"):
        read(obj)
    assert not reader.is_splats(None)


def test_opacities_and_sizes_out_of_range_are_brought_into_it(collection):
    cloud = ball_splats(5)[0]
    obj = made(cloud, collection)
    obj.data.attributes["scale"].data.foreach_set("vector", (-np.asarray(cloud.scales)).ravel())
    base = obj.data.attributes["radiance:base"]
    key = reader.KEYS[base.data_type]
    values = np.empty(20, np.float32)
    base.data.foreach_get(key, values)
    values[3], values[7] = 1.5, -1
    base.data.foreach_set(key, values)
    obj.data.update_tag()
    found = read(obj)
    assert np.array_equal(found.scales, cloud.scales)
    assert found.opacities[:2].tolist() == [1.0, 0.0]
    replace(found)  # the cloud checks itself
