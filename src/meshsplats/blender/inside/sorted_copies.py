"""Copies of splat meshes whose triangles lie far to near for a viewport.

Where a mesh is made of whole splats and nothing else changes it, NumPy sorts these, not their triangles, in a
fraction of the time that nodes take. The modifier *Far to near* then shows a copy whose triangles are in that
order. It shares all other data with the mesh. Copies live only while a viewport needs them, in no scene and
no file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from meshsplats.blender.inside import meshes, versions
from meshsplats.blender.inside.host import bpy

CENTER = "splat_center"
"""Face attribute: centre of the splat that each face was made from, the mean of its triangles' corners; from
the middle of the mesh, and in such units that whole numbers tell two depths apart (``far_to_near``)."""
SORTED = "Sorted"
"""Input of the modifier's node group: the object whose mesh viewports show."""
VIEW = "View"
"""Input of the modifier's node group: the direction to the viewer of a viewport, in Blender's world. Zero:
the active camera's. A copy needs it only when it is dropped: Blender 5.3 counts each new value of an input as
an edit of the mesh."""
OWNER = "meshsplats_copy_of"
"""Property of a copy, the object and its mesh: the session's number of the object that it was made for."""
_AXES = "meshsplats_axes"
"""Property of a copy: the axes of its owner in Blender's world when it was sorted."""
_VIEW = "meshsplats_view"
"""Property of a copy: the direction to the viewer for which it was sorted."""
_NEW = "meshsplats_new"
"""Property of a copy until Blender has evaluated it."""
_CORNERS = (".corner_vert", ".corner_edge")
"""Attributes of corners that are sorted; the names are internal to Blender."""
_FACES = (meshes.SPLAT, CENTER, ".select_poly")
"""Attributes of faces that no viewport shows."""


def show(modifier: Any, direction: Sequence[float]) -> bool:
    """Has viewports show the splats of ``modifier`` in their order for a viewer in ``direction`` (3,),
    Blender's world. Returns False, and shows no copy, where one would look different from the mesh."""
    obj = modifier.id_data
    each = _triangles_each(obj, modifier)
    copy = of(modifier)
    if not each or (copy is not None and copy.get(OWNER) != obj.session_uid):
        drop(modifier)
        copy = None
    if not each:
        return False
    if copy is None:
        copy = _make(obj)
        versions.set_input(modifier, SORTED, copy)
        obj.update_tag(refresh={"DATA"})
    data, count = obj.data, len(obj.data.polygons)
    centers = np.empty(3 * count, np.float32)
    data.attributes[CENTER].data.foreach_get("vector", centers)
    axes = np.array(obj.matrix_world)[:3, :3]
    copy[_AXES], copy[_VIEW] = axes.ravel().tolist(), [float(x) for x in direction]
    local = np.asarray(direction, np.float64) @ axes
    local /= max(float(np.linalg.norm(local)), 1e-300)
    order = far_to_near(centers.reshape(-1, 3)[::each] @ local.astype(np.float32))
    values = np.empty(3 * count, np.int32)
    for name in _CORNERS:
        if name in data.attributes:
            data.attributes[name].data.foreach_get("value", values)
            ranked = values.reshape(-1, 3 * each)[order]
            copy.data.attributes[name].data.foreach_set("value", ranked.ravel())
    copy.data.update()
    return True


def far_to_near(nearness: np.ndarray) -> np.ndarray:
    """(n,) int64 indices that sort ``nearness`` (n,), rounded to whole numbers that differ by less than 2^32,
    ascending; equal ones keep their order. A radix sort: NumPy sorts 16 bits in linear time."""
    steps = np.rint(nearness).astype(np.int64)
    steps -= steps.min()
    order = np.argsort((steps & 0xFFFF).astype(np.uint16), kind="stable")
    return order[np.argsort((steps >> 16).astype(np.uint16)[order], kind="stable")]


def of(modifier: Any) -> Any:
    """The copy that viewports show instead of the mesh of ``modifier``, or None."""
    found = versions.input_of(modifier, SORTED)
    return found if found is not None and OWNER in found else None


def drop(modifier: Any) -> None:
    """Has the nodes of ``modifier`` sort."""
    copy = of(modifier)
    if copy is None:
        return
    versions.set_input(modifier, SORTED, None)
    versions.set_input(modifier, VIEW, tuple(copy.get(_VIEW, (0, 0, 0))))
    if copy.get(OWNER) == modifier.id_data.session_uid or not copy.users:
        _delete(copy)
    modifier.id_data.update_tag(refresh={"DATA"})


def is_stale(modifier: Any) -> bool:
    """Whether there is a copy that was made before the update of the mesh that Blender reports now: it
    reports one for the modifier's new input, too."""
    copy = of(modifier)
    return copy is not None and not copy.pop(_NEW, False)


def has_turned(modifier: Any) -> bool:
    """Whether the object of ``modifier`` has turned, or changed its proportions, since its copy was
    sorted."""
    copy = of(modifier)
    if copy is None:
        return False
    axes = np.array(modifier.id_data.matrix_world)[:3, :3].ravel()
    return not np.allclose(axes, copy[_AXES], rtol=1e-4, atol=1e-4 * float(np.abs(axes).max()))


def drop_strays() -> None:
    """Removes the copies whose objects were deleted."""
    for copy in [obj for obj in bpy.data.objects if OWNER in obj and not obj.users]:
        _delete(copy)


def _delete(copy: Any) -> None:
    data = copy.data
    bpy.data.objects.remove(copy)
    if not data.users:
        bpy.data.meshes.remove(data)


def _triangles_each(obj: Any, modifier: Any) -> int:
    """Triangles of each splat of ``obj``, where all have as many and nothing but their order must change;
    else 0."""
    data = obj.data
    first = next((m for m in obj.modifiers if m.show_viewport), None)
    if obj.mode != "OBJECT" or first != modifier or data.shape_keys is not None or len(data.materials) > 1:
        return 0
    if not {meshes.SPLAT, CENTER} <= set(data.attributes.keys()) or not len(data.edges):
        return 0
    for attribute in data.attributes:
        known = {"CORNER": _CORNERS, "FACE": (*_FACES, "sharp_face", "material_index")}.get(attribute.domain)
        if known is not None and attribute.name not in known:
            return 0
    owner = meshes.owners(data)
    if not len(owner) or len(data.loops) != 3 * len(owner):
        return 0
    ends = np.flatnonzero(np.diff(owner))
    each = int(ends[0]) + 1 if len(ends) else len(owner)
    whole = len(owner) % each == 0 and len(ends) == len(owner) // each - 1
    if not whole or ((ends + 1) % each).any() or _differs(data, "sharp_face"):
        return 0
    return each


def _differs(data: Any, name: str) -> bool:
    """Whether faces of ``data`` differ in their attribute ``name``, a yes or no."""
    if name not in data.attributes:
        return False
    values = np.empty(len(data.polygons), bool)
    data.attributes[name].data.foreach_get("value", values)
    return bool(values.any() and not values.all())


def _make(obj: Any) -> Any:
    drop_strays()
    data = obj.data.copy()
    for name in _FACES:
        if name in data.attributes:
            data.attributes.remove(data.attributes[name])
    copy = bpy.data.objects.new(f"{obj.name}, far to near", data)
    copy[OWNER] = data[OWNER] = obj.session_uid
    copy[_NEW] = True
    return copy
