# ruff: noqa: E402
"""Baked light is older than the scene once anything has changed that lights the splats."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats

from meshsplats import convert
from meshsplats.blender.inside import light_state, objects, pacing, stage, versions


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
    cube.shape_key_add(name="Basis")
    key = cube.shape_key_add(name="key")
    rig = bpy.data.objects.new("rig", bpy.data.armatures.new("rig"))
    scene.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    rig.data.edit_bones.new("bone").tail = (0, 0, 1)
    bpy.ops.object.mode_set(mode="OBJECT")
    cube.modifiers.new("rig", "ARMATURE").object = rig
    outer, inner, linked = (bpy.data.collections.new(name) for name in ("outer", "inner", "linked"))
    scene.collection.children.link(outer)
    outer.children.link(inner)
    inner.objects.link(stage.add_sun(np.array([0, 0, 1.0]), 1.0, 1.0, 0.01, scene.collection, name="third"))
    scene.collection.objects.unlink(scene.objects["third"])
    linked.objects.link(cube)
    place = bpy.context.view_layer.layer_collection.children["outer"].children["inner"]

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
        "shape key": lambda: setattr(key, "value", 0.5),
        "pose": lambda: setattr(rig.pose.bones["bone"], "location", (0, 1, 0)),
        "no shadow": lambda: setattr(cube, "visible_shadow", False),
        "light linking": lambda: setattr(lamp.light_linking, "receiver_collection", linked),
        "linked to less": lambda: linked.objects.unlink(cube),
        "excluded collection": lambda: setattr(place, "exclude", True),
        "collection again": lambda: setattr(place, "exclude", False),
        "hidden outer collection": lambda: setattr(outer, "hide_render", True),
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
    scene.cycles.film_exposure = 2.0
    cube.is_holdout = True  # it still casts its shadow
    assert light_state.state(scene, obj) == before, "none of these changes light"


def test_what_was_baked_is_known_at_once(monkeypatch):
    """A scene whose state takes long is looked at now and then; but a bake is news."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    obj = objects.add(objects.prepare(convert(ball_splats(50)[0]), False), "ball", scene.collection)
    sun = stage.add_sun(np.array([0.5, 0, 0.9]), 3.0, 1.0, 0.01, scene.collection)
    monkeypatch.setattr(pacing, "_LONG", -1)
    monkeypatch.setattr(pacing, "_REST", 1e9)
    before = light_state.latest(scene, obj, now=True)
    sun.data.energy = 7
    assert light_state.latest(scene, obj) == before
    after = light_state.latest(scene, obj, now=True)
    assert after == light_state.latest(scene, obj) == light_state.state(scene, obj) != before


def test_the_state_is_the_same_in_every_blender():
    """Light that was baked in 4.2 is not older in 5.3, which has other properties and sockets."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    versions.enable_cycles()
    scene = bpy.context.scene
    obj = objects.add(objects.prepare(convert(ball_splats(50)[0]), False), "ball", scene.collection)
    stage.even_world((0.2, 0.2, 0.2))
    stage.add_ground(np.zeros(3), 1.0, False, scene.collection)
    for kind in ("POINT", "SUN", "SPOT", "AREA"):
        bpy.ops.object.light_add(type=kind, location=(1, 2, 3))
    bpy.ops.mesh.primitive_cube_add()
    for kind in ("SUBSURF", "BEVEL", "NODES", "ARMATURE"):
        bpy.context.object.modifiers.new(kind, kind)
    material = bpy.data.materials.new("plastic")
    bpy.context.object.data.materials.append(material)
    nodes = versions.node_tree(material).nodes
    sky = nodes.new("ShaderNodeTexSky")
    sky.sky_type = "NISHITA" if bpy.app.version < (5, 0, 0) else "SINGLE_SCATTERING"
    for node in (nodes.new("ShaderNodeBsdfPrincipled"), nodes.new("ShaderNodeBsdfGlass"), sky):
        if "Subsurface Scale" in node.inputs:  # what is new has other defaults
            node.inputs["Subsurface Scale"].default_value = 0.05
    sky.altitude = 0
    bpy.context.view_layer.update()
    assert light_state.state(scene, obj) == "8cb5f919"
