"""The surface that takes the place of lit splats for light (``blender.stand_in``), as objects of a Blender
file."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from meshsplats.blender.inside import baking, homes, materials, meshes, versions
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.inside.meshes import STAND_IN as STAND_IN
from meshsplats.blender.inside.splat_points import values

SPLATS = ("vertices", "faces", "colors")
"""The mesh of the splats, with linear colours."""
ARRAYS = (
    *("surface_vertices", "surface_faces", "surface_colors", "fine_faces"),
    *("light_points", "light_normals", "light_point_of"),
)
"""Fields of ``StandIn``, as ``subject.lit_subject`` names them."""
OWNER = "meshsplats_splats"
"""Property of the objects made here: the object of the splats that they were made for."""
SURFACE, FINE = "meshsplats_surface", "meshsplats_fine"
"""Properties of lit splats: what was made here, with the points, so that *Append* brings it."""
ROUGH = "meshsplats_rough"
"""Property of the object of lit splats: whether surface and colours for light are those of a preview."""
SHAPE = "meshsplats_shape"
"""Property of lit splats: the ``shape`` that their mesh had when their stand-in was made."""
RAYS = "meshsplats_rays"
"""Property of splats with a stand-in: whether they were visible to shadow rays and to diffuse ones before."""


def add(obj: Any, arrays: Mapping[str, np.ndarray], size: float, *, self_shadow: float, home: Any) -> None:
    """Gives the splats ``obj`` a stand-in: children of ``obj``, in its collections.

    Cameras, mirrors and glass see the splats. Shadows, bounced light and occlusion come from the stand-in.

    Args:
        arrays: those of ``SPLATS`` and ``ARRAYS``, in the frame of the object.
        size: distance of neighbouring points, scene units.
        self_shadow: rays that start within this distance of the fine faces ignore them.
        home: their collection where ``obj`` is in none.
    """
    places = homes.without_physics(homes.of([obj])[obj]) or {home: "INCLUDE"}
    faces, colors, fine = arrays["surface_faces"], arrays["surface_colors"], arrays["fine_faces"]
    rgba = np.column_stack([colors, np.ones(len(colors), np.float32)])
    surface = meshes.make_mesh(f"{obj.name} stand-in", arrays["surface_vertices"], faces, rgba)
    surface.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
    surface.materials.append(materials.stand_in())
    obj[SURFACE] = _child(obj, surface, places)
    if fine.any():
        used, index = np.unique(arrays["faces"][fine], return_inverse=True)
        thin = meshes.make_mesh(
            f"{obj.name} stand-in, fine",
            arrays["vertices"][used],
            index.reshape(-1, 3).astype(np.int32),
            arrays["colors"][used],
        )
        thin.materials.append(materials.stand_in("Stand-in, fine", fine=True, self_shadow=self_shadow))
        obj[FINE] = _child(obj, thin, places)
    points = baking.make_points(
        f"{obj.name} light points", arrays["light_points"], arrays["light_normals"], size
    )
    target = _child(obj, points, places)
    target.visible_diffuse = target.visible_shadow = False
    target.visible_volume_scatter = True  # Cycles leaves out what no ray at all can see
    target.hide_select = False
    target.driver_remove("hide_render")
    target.hide_render = target.hide_viewport = True
    obj[baking.POINTS] = target
    index_of = obj.data.attributes.get(baking.POINT) or obj.data.attributes.new(baking.POINT, "INT", "POINT")
    index_of.data.foreach_set("value", np.ascontiguousarray(arrays["light_point_of"], np.int32))
    obj[RAYS] = [obj.visible_shadow, obj.visible_diffuse]
    obj.visible_shadow = obj.visible_diffuse = False


def _child(obj: Any, mesh: Any, places: homes.Homes) -> Any:
    """A child of ``obj`` at its place and in the collections ``places``, invisible to cameras, mirrors and
    glass."""
    child = bpy.data.objects.new(mesh.name, mesh)
    child[STAND_IN], child[OWNER] = True, obj
    for way in ("camera", "glossy", "transmission", "volume_scatter"):
        setattr(child, f"visible_{way}", False)
    child.parent = obj
    child.display_type = "BOUNDS"  # viewports draw the edges of wires over the splats
    child.hide_select = True
    homes.put(child, {}, places)
    _tie(child)
    return child


def _tie(child: Any) -> None:
    """Has images leave out ``child`` whenever they leave out its splats. A driver works in animations, and
    where the extension is missing; of viewports it does not, as they do not evaluate what is hidden."""
    driver = child.driver_add("hide_render").driver
    driver.type = "SUM"  # no expression, which files from elsewhere may not run
    variable = driver.variables.new()
    variable.targets[0].id = child.parent
    variable.targets[0].data_path = "hide_render"


def has_strays(scene: Any) -> bool:
    """Whether what was made here for splats of ``scene`` lacks these, is not where they are, or not hidden as
    they are. Asked after every change of the scene."""
    made = [obj for obj in scene.objects if STAND_IN in obj]
    return any(obj.parent is None for obj in made) or any(
        mine != wanted or not (_is_points(obj) or _is_hidden_alike(obj, obj.parent))
        for obj, mine, wanted in _places(scene, made)
    )


def follow(scene: Any) -> None:
    """Moves what was made for splats to the collections that they were moved to, so that it is excluded and
    hidden with these, and light linking takes it for them; and hides it in viewports where they are hidden.
    It is no rigid body where they are."""
    for obj, mine, wanted in _places(scene, [obj for obj in scene.objects if obj.get(STAND_IN)]):
        if not wanted:  # they were deleted
            continue
        homes.put(obj, mine, wanted)
        if _is_points(obj):
            continue
        if obj.hide_viewport != obj.parent.hide_viewport:  # each assignment is an update
            obj.hide_viewport = obj.parent.hide_viewport
        if obj.hide_get() != obj.parent.hide_get():
            with suppress(RuntimeError):  # not in this view layer
                obj.hide_set(obj.parent.hide_get())
        if obj.animation_data is None or not obj.animation_data.drivers:  # of an earlier release
            _tie(obj)


def _places(scene: Any, made: Iterable[Any]) -> Iterator[tuple[Any, homes.Homes, homes.Homes]]:
    """Of those that were ``made`` here and have splats: the object, the collections that it is in, and those
    that it belongs in: where its splats are, or that of the ``scene`` where only physics has these."""
    parts = [obj for obj in made if obj.parent is not None]
    if parts:
        found = homes.of([*parts, *(part.parent for part in parts)])
        for part in parts:
            theirs = found[part.parent]
            last = {scene.collection: "INCLUDE"} if theirs else {}
            yield part, found[part], homes.without_physics(theirs) or last


def _is_points(obj: Any) -> bool:
    """Whether ``obj``, made for its parent, is the points of its light, which are always hidden."""
    return bool(obj.parent.get(baking.POINTS) == obj)


def _is_hidden_alike(obj: Any, owner: Any) -> bool:
    return bool(obj.hide_viewport == owner.hide_viewport and obj.hide_get() == owner.hide_get())


def shape(data: Any) -> str:
    """Counts and a checksum of the mesh ``data``, or of a point cloud, which edits change."""
    if not hasattr(data, "vertices"):
        places = np.concatenate([values(data, name) for name in ("position", "scale", "rotation")], axis=1)
        return f"{_counts(data)}{zlib.crc32(places.tobytes()):08x}"
    checksum = zlib.crc32(versions.corners(data).tobytes(), zlib.crc32(versions.positions(data).tobytes()))
    return f"{_counts(data)}{checksum:08x}"


def _counts(data: Any) -> str:
    """How a ``shape`` begins."""
    if not hasattr(data, "vertices"):
        return f"{len(data.points)} "
    return f"{len(data.vertices)} {len(data.polygons)} "


def is_current(obj: Any, *, counts_only: bool = False) -> bool:
    """Whether the lit splats ``obj`` have a stand-in of their own that was made for their mesh as it is now,
    or were found to have none. ``counts_only``: at once, but without noticing moved vertices."""
    if baking.POINTS in obj:
        points = baking.points_of(obj)
        if points is None or points.get(OWNER) != obj:
            return False
        # Files of an earlier release may have lost it when they were appended. Blender finds children by
        # looking at all objects, which the panel cannot wait for.
        made = [part for part in (obj.get(SURFACE), obj.get(FINE)) if part is not None and part.parent == obj]
        if not made and not any(child.get(STAND_IN) and child != points for child in obj.children):
            return False
    before, data = obj.get(SHAPE, ""), obj.data
    if counts_only:
        return before.startswith(_counts(data))
    return bool(before == shape(data))


def remove_strays(scene: Any) -> None:
    """Removes what was made here for splats of ``scene`` that were deleted, or joined with others. The rest
    goes where its splats are (``follow``)."""
    for obj in [o for o in scene.objects if o.get(STAND_IN)]:
        owner = obj.get(OWNER, obj.parent)
        if owner is None or obj.parent != owner or not owner.users_collection:
            _delete(obj)
    follow(scene)


def _delete(obj: Any) -> None:
    mesh = obj.data
    bpy.data.objects.remove(obj)
    if mesh.users == 0:
        bpy.data.meshes.remove(mesh)


def remove(obj: Any) -> None:
    """Removes the stand-in of ``obj``, which then casts its own shadow, if it did so before."""
    for child in [c for c in obj.children if c.get(STAND_IN)]:
        _delete(child)
    if baking.POINTS in obj:
        obj.visible_shadow, obj.visible_diffuse = map(bool, obj.get(RAYS, (True, True)))
    for name in (baking.POINTS, SURFACE, FINE, RAYS):
        obj.pop(name, None)
