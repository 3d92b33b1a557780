# SPDX-License-Identifier: GPL-3.0-or-later
"""What keeps operators from changing splats, as Blender's tooltips say it; and what was lost."""

from .settings import is_blenders, is_splat_mesh


def can_change(operator, objs):
    """Whether ``objs`` can be changed: in object mode, and of this file; if not, the tooltip of ``operator``
    says why. Loads no library of ours: the panel asks whenever it is drawn."""
    for obj in objs:
        file = _library(obj)
        if obj.mode != "OBJECT":
            operator.poll_message_set("Only in Object Mode")
        elif file:
            operator.poll_message_set(f"{obj.name} is linked from {file}: Object > Relations > Make Local")
        else:
            continue
        return False
    return True


def can_change_all(operator, scene):
    """As ``can_change``, for all splats of ``scene``."""
    return can_change(operator, (obj for obj in scene.objects if is_splat_mesh(obj) or is_blenders(obj)))


def can_edit(operator, context):
    """As ``can_change``, for the active object, which must be a splat mesh, and the other selected ones."""
    if not is_splat_mesh(context.object):
        operator.poll_message_set("The active object is no splat mesh")
        return False
    others = (obj for obj in context.selected_objects if is_splat_mesh(obj))
    return can_change(operator, [context.object, *others])


def _library(obj):
    """Name of the file that ``obj`` or its data is linked from, also with a library override, or ''."""
    override = obj.override_library
    library = obj.library or obj.data.library or (override and override.reference.library)
    return library.name if library else ""


def report_lost(operator, lost):
    """Warns of what artists had added to meshes that others took the place of: by the name of the object, the
    kinds of it."""
    for name, kinds in lost.items():
        if kinds:
            operator.report(
                {"WARNING"}, f"MeshSplats: {name} has other triangles now, and lost its {', '.join(kinds)}"
            )
