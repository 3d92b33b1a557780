"""Levels of detail in an open Blender file: a collection per chain, with a collection for each level.

One level is visible at a time, in the viewport and in renders. The collections say by custom properties which
level they hold and for which size on the screen it was made, so saved files keep working.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from meshsplats.blender.inside.host import bpy
from meshsplats.blender.inside.meshes import world_points
from meshsplats.cameras.trajectories import distance_of, dome

CHAIN = "meshsplats_levels"
"""Property of a chain's collection: count of its levels."""
LEVEL = "meshsplats_level"
"""Property of the collection and of the object of a level: its index, 0 for the finest."""
SCREEN_SIZE = "meshsplats_screen_size"
"""Property of a level's collection: side in pixels of the images for which it was made."""

_FOV = 45.0
"""Degrees that images which just hold the subject span, as ``dome`` makes them."""


def add_collections(name: str, screen_sizes: Sequence[int], parent: Any) -> list[Any]:
    """New collections for the levels of a chain, the finest first, inside a new one called ``name`` in the
    collection ``parent``. The finest is visible."""
    chain = bpy.data.collections.new(name)
    chain[CHAIN] = len(screen_sizes)
    parent.children.link(chain)
    made = []
    for level, size in enumerate(screen_sizes):
        child = bpy.data.collections.new(f"{chain.name} level {level}")
        child[LEVEL], child[SCREEN_SIZE] = level, int(size)
        chain.children.link(child)
        made.append(child)
    _set_visible(made, 0)
    return made


def tie(objs: Sequence[Any]) -> None:
    """Makes ``objs``, one per level with the finest first, the levels of one subject: the coarser ones become
    children of the finest, at its place."""
    for level, obj in enumerate(objs):
        obj[LEVEL] = level
        if level > 0 and obj.parent is None:
            obj.parent = objs[0]
            obj.matrix_parent_inverse.identity()
            obj.matrix_basis.identity()


def chains(scene: Any) -> list[Any]:
    """The collections of the chains in ``scene``."""
    return [found for found in scene.collection.children_recursive if CHAIN in found]


def chain_of(obj: Any) -> Any:
    """The collection of the chain that ``obj`` belongs to, or None."""
    own = {child for child in obj.users_collection if LEVEL in child} if obj is not None else set()
    return next((c for c in bpy.data.collections if CHAIN in c and own.intersection(c.children)), None)


def collections(chain: Any) -> list[Any]:
    """The collections of the levels of ``chain``, the finest first."""
    return sorted((child for child in chain.children if LEVEL in child), key=lambda child: child[LEVEL])


def objects_of(chain: Any) -> list[Any]:
    """The splat meshes of ``chain``, the finest first."""
    found = [obj for child in collections(chain) for obj in child.objects if LEVEL in obj]
    return sorted(found, key=lambda obj: obj[LEVEL])


def with_levels(obj: Any) -> list[Any]:
    """``obj`` and, if it is a level of a chain, the other levels."""
    chain = chain_of(obj) if LEVEL in obj else None
    return [obj] if chain is None else objects_of(chain)


def visible_level(chain: Any, where: str = "render") -> int | None:
    """Index of the level of ``chain`` that images show, or viewports ('view'); None if they show none."""
    hidden = "hide_viewport" if where == "view" else "hide_render"
    return next((child[LEVEL] for child in collections(chain) if not getattr(child, hidden)), None)


def show(chain: Any, level: int, where: str = "both") -> None:
    """Makes ``level`` the one level of ``chain`` that is visible: in viewports ('view'), in images
    ('render'), or in both.

    A coarser level that was moved by hand takes the others to its place. Selection and the active object pass
    to the new level.

    Raises:
        ValueError: the chain has no such level.
    """
    children = collections(chain)
    if level not in [child[LEVEL] for child in children]:
        raise ValueError(f"{chain.name} has the levels 0 to {len(children) - 1}, got {level}")
    if where == "render":
        _set_visible(children, level, where)
        return
    objs = {obj[LEVEL]: obj for obj in objects_of(chain)}
    before: Any = objs.get(visible_level(chain, "view"))
    finest: Any = objs.get(0)
    after: Any = objs.get(level)
    tied = before is not None and finest is not None and before.parent == finest
    if tied and not before.matrix_basis.is_identity:
        bpy.context.view_layer.update()
        finest.matrix_world = before.matrix_world.copy()
        before.matrix_basis.identity()
    layer = bpy.context.view_layer
    selected = before is not None and before.name in layer.objects and before.select_get()
    _set_visible(children, level, where)
    layer.update()
    if after is None or after.name not in layer.objects:
        return
    if layer.objects.active in objs.values():
        layer.objects.active = after
    if selected:  # hiding an object deselects it
        after.select_set(True)


def _set_visible(children: Iterable[Any], level: int, where: str = "both") -> None:
    for child in children:
        if where != "render":
            child.hide_viewport = child[LEVEL] != level
        if where != "view":
            child.hide_render = child[LEVEL] != level


def screen_size(chain: Any, scene: Any) -> float:
    """Size of the subject of ``chain`` for the active camera of ``scene``: side in pixels of the image that
    just holds it at that distance and focal length, at the render resolution. Comparable with the sizes for
    which levels are made; does not depend on where the camera looks.

    Raises:
        ValueError: no active camera, a panoramic one, or a chain without visible vertices.
    """
    camera = scene.camera
    if camera is None or camera.type != "CAMERA":
        raise ValueError("the scene has no active camera")
    if camera.data.type == "PANO":
        raise ValueError(f"{camera.name} is panoramic: levels fit perspective and orthographic cameras")
    bpy.context.view_layer.update()
    target, away = _framing(chain)
    scale = scene.render.resolution_percentage / 100
    width, height = scene.render.resolution_x * scale, scene.render.resolution_y * scale
    projection = camera.calc_matrix_camera(
        bpy.context.evaluated_depsgraph_get(),
        x=max(1, round(width)),
        y=max(1, round(height)),
        scale_x=scene.render.pixel_aspect_x,
        scale_y=scene.render.pixel_aspect_y,
    )
    # Pixels per unit of length at the distance 1, along the axis that has more of them.
    focal = max(projection[0][0] * width, projection[1][1] * height) / 2
    side = 2 * np.tan(np.radians(_FOV / 2)) * away
    if camera.data.type == "ORTHO":
        return float(side * focal)
    distance = float(np.linalg.norm(np.array(camera.matrix_world.translation) - target))
    return float(side * focal / max(distance, 1e-9 * away))


def fitting_level(chain: Any, size: float) -> int:
    """Index of the level of ``chain`` made for the screen size nearest to ``size``, as a ratio; pixels."""
    return min(collections(chain), key=lambda child: abs(np.log(size / child[SCREEN_SIZE])))[LEVEL]


def _framing(chain: Any) -> tuple[np.ndarray, float]:
    """(3,) the centre of the subject, and the distance from which images just hold it; Blender's world."""
    objs = objects_of(chain)
    points = world_points(objs[0]) if objs else np.zeros((0, 3))
    if not len(points):
        raise ValueError(f"{chain.name} has no visible vertices")
    camera = dome(points, 32, up=(0.0, 0.0, 1.0), width=100, height=100, fov=_FOV)[0]
    away = distance_of(camera)
    return camera.center + away * camera.world_to_camera[2, :3], away
