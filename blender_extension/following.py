# SPDX-License-Identifier: GPL-3.0-or-later
"""Handlers by which the splats of mesh priors follow their base, after every change and on every frame."""

import bpy
from bpy.app.handlers import persistent

BASE = "meshsplats_base"
"""Property of splats that follow a base; ``meshsplats.blender.inside.priors`` sets it."""


def _has_followers(scene):
    return any(BASE in obj for obj in scene.objects)


@persistent
def after_update(scene, depsgraph):
    if _has_followers(scene):
        from meshsplats.blender.inside import priors

        priors.after_update(scene, depsgraph)


@persistent
def after_frame(scene, depsgraph):
    if _has_followers(scene):
        from meshsplats.blender.inside import priors

        priors.after_frame(scene, depsgraph)


def register():
    bpy.app.handlers.depsgraph_update_post.append(after_update)
    bpy.app.handlers.frame_change_post.append(after_frame)


def unregister():
    bpy.app.handlers.frame_change_post.remove(after_frame)
    bpy.app.handlers.depsgraph_update_post.remove(after_update)
