# SPDX-License-Identifier: GPL-3.0-or-later
"""Handlers by which the splats of mesh priors follow their base, after every change and on every frame, and
by which what was made for the light of splats goes when they are deleted."""

import bpy
from bpy.app.handlers import persistent

BASE = "meshsplats_base"
"""Property of splats that follow a base; ``meshsplats.blender.inside.priors`` sets it."""


STAND_IN = "meshsplats_stand_in"
"""Property of what was made for the light of splats; ``meshsplats.blender.inside.stand_ins`` sets it."""


def _has_followers(scene):
    return any(BASE in obj for obj in scene.objects)


@persistent
def after_update(scene, depsgraph):
    if _has_followers(scene):
        from meshsplats.blender.inside import priors

        priors.after_update(scene, depsgraph)
    # Handlers may change objects, but not remove them.
    strays = any(STAND_IN in obj and obj.parent is None for obj in scene.objects)
    if strays and not bpy.app.background and not bpy.app.timers.is_registered(sweep):
        bpy.app.timers.register(sweep, first_interval=0)


def sweep():
    """Removes the stand-ins of splats that were deleted."""
    from meshsplats.blender.inside import stand_ins

    stand_ins.remove_strays(bpy.context.scene)


@persistent
def after_frame(scene, depsgraph):
    if _has_followers(scene):
        from meshsplats.blender.inside import priors

        priors.after_frame(scene, depsgraph)


def register():
    bpy.app.handlers.depsgraph_update_post.append(after_update)
    bpy.app.handlers.frame_change_post.append(after_frame)


def unregister():
    if bpy.app.timers.is_registered(sweep):
        bpy.app.timers.unregister(sweep)
    bpy.app.handlers.frame_change_post.remove(after_frame)
    bpy.app.handlers.depsgraph_update_post.remove(after_update)
