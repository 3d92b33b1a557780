# ruff: noqa: E402
"""Lit splats that modifiers deform: light and shadow are those of the shape that one sees."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender's module is not here: make test-blender")

from _blender_scenes import ball_splats

from meshsplats import convert
from meshsplats.blender.inside import baking, deforming, materials, objects, setting, versions


def light_on(obj) -> np.ndarray:
    """(v, 3) baked light of the vertices."""
    found = np.empty(4 * len(obj.data.vertices), np.float32)
    obj.data.attributes[materials.LIGHT].data.foreach_get("color", found)
    return found.reshape(-1, 4)[:, :3]


def with_one(places) -> np.ndarray:
    return np.c_[places, np.ones(len(places))]


def test_baked_light_and_shadow_are_those_of_the_deformed_splats():
    """A rig turns a ball upside down: what was below is lit by the sun then."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    mesh = convert(ball_splats(700, noise=0.1)[0], mode="flat")
    obj = objects.add(objects.prepare(mesh, True, fast=True, views=()), "ball", scene.collection)
    bpy.context.view_layer.update()
    setting.set_up(scene, [obj], "noon", camera=False, fast=True)
    heights = (versions.positions(obj.data) @ np.array(obj.matrix_world)[:3, :3].T)[:, 2]
    top, bottom = heights > np.quantile(heights, 0.9), heights < np.quantile(heights, 0.1)
    assert light_on(obj)[top].mean() > 1.5 * light_on(obj)[bottom].mean()
    assert not baking.is_older(scene, obj)
    surface = next(c for c in obj.children if c.name.endswith("stand-in"))
    rest = versions.positions(surface.data)
    rig = bpy.data.objects.new("rig", None)
    scene.collection.objects.link(rig)
    rig.matrix_world = obj.matrix_world
    bpy.context.view_layer.update()
    hook = obj.modifiers.new("rig", "HOOK")
    hook.object = rig
    hook.matrix_inverse = rig.matrix_world.inverted() @ obj.matrix_world
    hook.vertex_indices_set(range(len(obj.data.vertices)))
    rig.rotation_euler.rotate_axis("X", np.pi)
    rig.location.z += 2  # the origin is at the foot
    bpy.context.view_layer.update()
    drawn = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    deformed = versions.positions(drawn)
    turned = np.linalg.lstsq(with_one(versions.positions(obj.data)), deformed, rcond=None)[0]
    assert np.abs(deformed - versions.positions(obj.data)).max() > 1
    assert baking.is_older(scene, obj)
    assert baking.bake(scene, [obj], samples=4) == 1
    assert not baking.is_older(scene, obj)
    np.testing.assert_allclose(versions.positions(surface.data), with_one(rest) @ turned, atol=1e-3)
    assert light_on(obj)[bottom].mean() > 1.5 * light_on(obj)[top].mean()
    obj.modifiers.remove(hook)
    deforming.follow(obj)
    np.testing.assert_array_equal(versions.positions(surface.data), rest)
