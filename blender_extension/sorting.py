# SPDX-License-Identifier: GPL-3.0-or-later
"""Handlers by which EEVEE's viewports and images show splats far to near
(``meshsplats.blender.inside.far_to_near``)."""

import time

import bpy
from bpy.app.handlers import persistent

from .settings import is_splat_mesh

SAME = 0.99998
"""Cosine between two directions, a third of a degree apart, above which the order stays."""

_views = {}
"""By region of a viewport: the direction to the viewer when it was drawn last, zero for the active camera's.
Only a view that turns has its splats sorted, or two viewports would do so in turn for ever."""
_wanted = {}
"""By scene: the direction that its splats are to be sorted for, or None for no sorting."""
_shown = {}
"""By scene: the direction that its splats were sorted for last."""


def has_splats(scene):
    return any(map(is_splat_mesh, scene.objects))


def blends(space, scene):
    """Whether the viewport ``space`` is drawn by EEVEE."""
    kind = space.shading.type
    return kind == "MATERIAL" or (kind == "RENDERED" and "EEVEE" in scene.render.engine)


def direction(region_data):
    """Direction to the viewer of a viewport, or zero where it shows the view of the active camera."""
    if region_data.view_perspective == "CAMERA":
        return (0.0, 0.0, 0.0)
    return tuple(region_data.view_matrix[2][:3])


def before_drawing():
    """Called when a viewport is drawn. Data must not change now, so a timer sorts right afterwards."""
    context = bpy.context
    scene, region = context.scene, context.region.as_pointer()
    if not has_splats(scene):
        return
    if not blends(context.space_data, scene):
        if _views.pop(region, None) is not None and not _views:
            _want(scene, None)  # spares playback the time
        return
    view = direction(context.region_data)
    if not _near(view, _views.get(region)) or _unsorted(scene):
        _views[region] = view
        _want(scene, view)


def _want(scene, view):
    _wanted[scene.session_uid] = view
    if not bpy.app.timers.is_registered(sort):
        bpy.app.timers.register(sort, first_interval=0)


def _near(view, other):
    if other is None or view == other:
        return view == other
    return sum(a * b for a, b in zip(view, other, strict=True)) > SAME


def _unsorted(scene):
    """Whether there are splats that viewports do not sort, as they have just been imported."""
    from meshsplats.blender.inside import far_to_near

    return any(not far_to_near.modifier_of(obj).show_viewport for obj in far_to_near.sorted_objects(scene))


def sort():
    """Sorts the splats for the views that were drawn last. Returns, for Blender's timer, in how many seconds
    to look again: after as long as it took, so that the window stays responsive."""
    if not _wanted:
        return None
    if bpy.app.is_job_running("RENDER"):
        return 0.5
    from meshsplats.blender.inside import far_to_near

    start = time.perf_counter()
    for scene in bpy.data.scenes:
        if scene.session_uid not in _wanted:
            continue
        _shown[scene.session_uid] = view = _wanted[scene.session_uid]
        for obj in far_to_near.sorted_objects(scene):
            far_to_near.look(far_to_near.modifier_of(obj), view)
    _wanted.clear()
    bpy.context.view_layer.update()
    return max(0.01, time.perf_counter() - start)


@persistent
def after_update(scene, depsgraph):
    if has_splats(scene):
        from meshsplats.blender.inside import far_to_near

        far_to_near.after_update(depsgraph)


@persistent
def after_frame(scene, depsgraph):
    if bpy.app.version < (4, 5, 0) and has_splats(scene):
        from meshsplats.blender.inside import far_to_near

        far_to_near.follow_camera(scene)


@persistent
def drop_copies(*_):
    """Before a file is saved, and when another one was loaded: no sorted copies."""
    _views.clear()
    _shown.clear()
    _drop_copies()


def _drop_copies():
    if any(map(has_splats, bpy.data.scenes)):
        from meshsplats.blender.inside import far_to_near

        far_to_near.drop_copies()


@persistent
def after_undo(*_):
    """When another state of the file was loaded, with copies of then and splats sorted for a view of then:
    they are sorted for that of now before it is drawn. Viewports that have not turned ask for nothing
    more."""
    _drop_copies()
    scenes = [s for s in bpy.data.scenes if _shown.get(s.session_uid) is not None and has_splats(s)]
    if not scenes:
        return
    from meshsplats.blender.inside import far_to_near

    for scene in scenes:
        _want(scene, _shown[scene.session_uid])
        for obj in far_to_near.sorted_objects(scene):  # what follows need not sort
            far_to_near.modifier_of(obj).show_viewport = False
    bpy.context.view_layer.update()  # where objects are is known from here on
    sort()  # leaves it to the timer while an image is rendered


_handle = None
_HANDLERS = {
    "save_pre": drop_copies,
    "load_post": drop_copies,
    "undo_post": after_undo,
    "redo_post": after_undo,
}


def register():
    global _handle
    _handle = bpy.types.SpaceView3D.draw_handler_add(before_drawing, (), "WINDOW", "PRE_VIEW")
    bpy.app.handlers.depsgraph_update_post.append(after_update)
    bpy.app.handlers.frame_change_post.append(after_frame)
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)


def unregister():
    global _handle
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).remove(handler)
    bpy.app.handlers.frame_change_post.remove(after_frame)
    bpy.app.handlers.depsgraph_update_post.remove(after_update)
    bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
    if bpy.app.timers.is_registered(sort):
        bpy.app.timers.unregister(sort)
