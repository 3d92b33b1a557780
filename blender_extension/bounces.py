# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats that were appended or linked, into a scene whose rays pass too few layers for them: a line in the
panel with the button that sets it, and one in the console where images are rendered in the background."""

import bpy
from bpy.app.handlers import persistent

LAYERS = "meshsplats_layers"
"""Property of the data of splat meshes; ``meshsplats.blender.inside.bounces`` sets it."""


def missing(scene, *, now=True):
    """The limit on transparent bounces that ``scene`` lacks for its splats, or 0; without ``now``, of a large
    scene by what was so a short while ago."""
    if not any(LAYERS in data for data in bpy.data.meshes):  # or the panel would load our libraries
        return 0
    from meshsplats.blender.inside import bounces

    return bounces.missing(scene, now=now)


def described(scene, limit):
    """What is wrong where ``scene`` lacks the ``limit``."""
    passed = scene.cycles.transparent_max_bounces
    return f"Rays pass {passed} transparent layers and splats need {limit}: deeper ones are black"


@persistent
def before_render(scene, *_):
    limit = missing(scene) if bpy.app.background else 0
    if limit:
        print(f"MeshSplats: {described(scene, limit)}: bpy.ops.scene.meshsplats_bounces()", flush=True)


class SetBounces(bpy.types.Operator):
    """Let rays pass as many transparent layers as the splats of the scene need, instances of collections too;
    all other settings stay"""

    bl_idname = "scene.meshsplats_bounces"
    bl_label = "Set Transparent Bounces"
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's own form

    def execute(self, context):
        scene = context.scene
        before, limit = scene.cycles.transparent_max_bounces, missing(scene)
        if limit:
            scene.cycles.transparent_max_bounces = limit
            self.report({"INFO"}, f"MeshSplats: transparent bounces {before} to {limit}")
        return {"FINISHED"}


def register():
    bpy.utils.register_class(SetBounces)
    bpy.app.handlers.render_init.append(before_render)


def unregister():
    bpy.app.handlers.render_init.remove(before_render)
    bpy.utils.unregister_class(SetBounces)
