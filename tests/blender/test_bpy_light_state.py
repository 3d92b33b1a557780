# ruff: noqa: E402
"""Baked light is older than the scene once anything has changed that lights the splats."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats

from meshsplats import convert
from meshsplats.blender.inside import light_state, objects, stage, versions


def test_whatever_lights_splats_makes_another_state():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    scene = bpy.context.scene
    mesh = convert(ball_splats(50)[0], mode="flat")
    obj = objects.add(objects.prepare(mesh, False), "ball", scene.collection)
    other = objects.add(objects.prepare(mesh, False), "other", scene.collection)
    sun = stage.add_sun(np.array([0.5, 0, 0.9]), 3.0, 1.0, 0.01, scene.collection).data
    lamp = stage.add_sun(np.array([0.5, 0, 0.9]), 3.0, 1.0, 0.01, scene.collection, name="lamp")
    lamp.parent = obj
    material = stage.add_ground(np.zeros(3), 1.0, False, scene.collection).data.materials[0]
    ground = next(node for node in material.node_tree.nodes if node.type == "BSDF_DIFFUSE")
    sky = stage.even_world((0.2, 0.2, 0.2)).node_tree
    image, turn = sky.nodes.new("ShaderNodeTexEnvironment"), sky.nodes.new("ShaderNodeMapping")
    background = next(node for node in sky.nodes if node.type == "BACKGROUND")
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.object
    bevel = cube.modifiers.new("bevel", "BEVEL")
    bpy.ops.object.text_add()
    text = bpy.context.object.data
    props = bpy.data.collections.new("props")
    props.objects.link(bpy.data.objects.new("prop", cube.data))
    empty = bpy.data.objects.new("empty", None)
    scene.collection.objects.link(empty)

    def instance():
        empty.instance_type, empty.instance_collection = "COLLECTION", props

    changes = {
        "angle of the sun": lambda: setattr(sun, "angle", 0.3),
        "lamp on the splats": lambda: setattr(lamp.data, "energy", 5),
        "colour of the ground": lambda: setattr(ground.inputs[0], "default_value", (1, 0, 0, 1)),
        "sky image": lambda: sky.links.new(image.outputs[0], background.inputs[0]),
        "turned sky": lambda: setattr(turn.inputs["Rotation"], "default_value", (0, 0, 1)),
        "edited mesh": lambda: setattr(cube.data.vertices[0], "co", (0, 0, 0)),
        "modifier": lambda: setattr(bevel, "width", 0.3),
        "text": lambda: setattr(text, "body", "splats"),
        "instances": instance,
        "moved instances": lambda: setattr(empty, "location", (1, 2, 3)),
    }
    before = light_state.state(scene, obj)
    for name, change in changes.items():
        change()
        bpy.context.view_layer.update()
        after = light_state.state(scene, obj)
        assert after != before, name
        before = after
    ground.location.x += 10
    bevel.show_expanded = not bevel.show_expanded
    other.data.materials.clear()  # as baking its light changes nodes
    assert light_state.state(scene, obj) == before, "none of these changes light"


def test_what_was_baked_is_known_at_once(monkeypatch):
    """A scene whose state takes long is looked at now and then; but a bake is news."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    obj = objects.add(objects.prepare(convert(ball_splats(50)[0]), False), "ball", scene.collection)
    sun = stage.add_sun(np.array([0.5, 0, 0.9]), 3.0, 1.0, 0.01, scene.collection)
    monkeypatch.setattr(light_state, "_LONG", -1)
    monkeypatch.setattr(light_state, "_REST", 1e9)
    before = light_state.renewed(scene, obj)
    sun.data.energy = 7
    assert light_state.latest(scene, obj) == before
    after = light_state.renewed(scene, obj)
    assert after == light_state.latest(scene, obj) == light_state.state(scene, obj) != before
