# ruff: noqa: E402
"""Operators say why they cannot change splats, and what does not light them."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats

from meshsplats import save_gaussians
from meshsplats.blender.inside import objects

CHANGES = (
    ("object", "shading", {"shading": "lit"}),
    ("object", "shading", {"shading": "unlit"}),
    ("object", "convert_again", {}),
    ("object", "cut", {"shape": "all", "below_opacity": 0.5}),
    ("object", "clean", {}),
    ("object", "adjust", {"hue": 1.0}),
    ("scene", "stage", {"lights": "studio"}),
    ("scene", "bake_light", {}),
)


@pytest.fixture
def ball(extension, tmp_path):
    bpy.ops.wm.read_factory_settings()
    bpy.context.scene.meshsplats_fast = True
    save_gaussians(ball_splats(40)[0], tmp_path / "ball.ply")
    bpy.ops.import_scene.meshsplats(filepath=str(tmp_path / "ball.ply"), at_origin=True)
    return bpy.context.object


def assert_refused(reason):
    for group, name, arguments in CHANGES:
        with pytest.raises(RuntimeError, match=reason):
            getattr(getattr(bpy.ops, group), f"meshsplats_{name}")(**arguments)


def test_edit_mode(ball):
    bpy.ops.object.mode_set(mode="EDIT")
    assert_refused("Only in Object Mode")
    bpy.ops.object.mode_set(mode="OBJECT")
    assert bpy.ops.object.meshsplats_shading(shading="lit") == {"FINISHED"}


@pytest.mark.parametrize("override", [False, True])
def test_linked_splats(ball, tmp_path, override):
    file = str(tmp_path / "lib.blend")
    bpy.data.libraries.write(file, {ball})
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(file, link=True) as (there, here):
        here.objects = there.objects
    (obj,) = here.objects
    bpy.context.collection.objects.link(obj)
    if override:
        obj = obj.override_create(remap_local_usages=True)
    bpy.context.view_layer.objects.active = obj
    assert_refused("ball is linked from lib.blend: Object > Relations > Make Local")


@pytest.mark.parametrize("light", ["none", "lamp", "sky", "image"])
def test_lit_where_nothing_lights_it(ball, capfd, light):
    """The start lamp is hidden by the import, and the start world is nearly black."""
    scene = bpy.context.scene
    background = next(node for node in scene.world.node_tree.nodes if node.type == "BACKGROUND")
    if light == "lamp":
        scene.collection.objects.link(bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN")))
    elif light == "sky":
        background.inputs["Color"].default_value = (0.2, 0.4, 1, 1)
    elif light == "image":
        tree = scene.world.node_tree
        tree.links.new(tree.nodes.new("ShaderNodeTexEnvironment").outputs[0], background.inputs["Color"])
    bpy.ops.object.meshsplats_shading(shading="lit")
    assert ("nothing lights the splats: click Sun, Noon, Overcast or Studio" in capfd.readouterr().out) == (
        light == "none"
    )


def test_up_is_that_of_the_scene_after_the_rotation_was_applied(ball):
    ball.rotation_euler.x += 0.5
    for _ in range(2):
        bpy.context.view_layer.update()
        up = np.array(ball.matrix_world)[:3, :3] @ objects.as_splat_mesh(ball).up
        np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)
        ball.select_set(True)
        bpy.ops.object.transform_apply(location=False, scale=False)
