# SPDX-License-Identifier: GPL-3.0-or-later
"""Handlers by which the splats of mesh priors follow their base, after every change and on every frame, and
by which what was made for the light of splats goes when they are deleted."""

import bpy
from bpy.app.handlers import persistent

from .settings import is_splat_mesh

BASE = "meshsplats_base"
"""Property of splats that follow a base; ``meshsplats.blender.inside.priors`` sets it."""


STAND_IN = "meshsplats_stand_in"
"""Property of what was made for the light of splats; ``meshsplats.blender.inside.stand_ins`` sets it."""


def _has_followers():
    """Whether the file has any, also in collections of which scenes show instances."""
    return any(BASE in obj for obj in bpy.data.objects)


@persistent
def after_load(*_):
    """Brings files of earlier releases up to date."""
    if _has_followers():
        from meshsplats.blender.inside import priors

        priors.tie_all()
    if any(map(is_splat_mesh, bpy.data.objects)):
        from meshsplats.blender.inside import far_to_near

        far_to_near.renew()


@persistent
def after_update(scene, depsgraph):
    if _has_followers():
        from meshsplats.blender.inside import priors

        priors.after_update(scene, depsgraph)
    _sweep_soon(scene)


def _sweep_soon(scene):
    """Handlers may change objects, but neither remove nor move them."""
    if not bpy.app.background and has_strays(scene) and not bpy.app.timers.is_registered(sweep):
        bpy.app.timers.register(sweep, first_interval=0)


def has_strays(scene):
    """Whether stand-ins in ``scene`` lack their splats, or are not where these are, or not hidden as they
    are."""
    if not any(STAND_IN in obj for obj in scene.objects):  # or every file would load our libraries
        return False
    from meshsplats.blender.inside import stand_ins

    return stand_ins.has_strays(scene)


def sweep():
    """Removes the stand-ins of splats that were deleted, and has the others follow theirs."""
    from meshsplats.blender.inside import stand_ins

    stand_ins.remove_strays(bpy.context.scene)


@persistent
def before_render(scene, *_):
    """Scripts have no timers. In the window, images are rendered by a thread, which must move nothing."""
    if bpy.app.background and has_strays(scene):
        from meshsplats.blender.inside import stand_ins

        stand_ins.follow(scene)


@persistent
def after_frame(scene, depsgraph):
    if _has_followers():
        from meshsplats.blender.inside import priors

        priors.after_frame(scene, depsgraph)
    _sweep_soon(scene)


def register():
    bpy.app.handlers.load_post.append(after_load)
    bpy.app.handlers.depsgraph_update_post.append(after_update)
    bpy.app.handlers.frame_change_post.append(after_frame)
    bpy.app.handlers.render_init.append(before_render)


def unregister():
    if bpy.app.timers.is_registered(sweep):
        bpy.app.timers.unregister(sweep)
    bpy.app.handlers.render_init.remove(before_render)
    bpy.app.handlers.frame_change_post.remove(after_frame)
    bpy.app.handlers.depsgraph_update_post.remove(after_update)
    bpy.app.handlers.load_post.remove(after_load)
