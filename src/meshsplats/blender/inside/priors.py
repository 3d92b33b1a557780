"""Mesh priors in an open Blender file: the base as an object of its own, and splats that follow it.

The splats are a child of the base, so they go where it goes; when its vertices move against each other (edit
mode, shape keys, an armature, cloth, soft bodies), ``follow`` computes theirs from them, as does
``MeshPrior.pose``. The extension calls it after every change and on every frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from meshsplats.binding import Binding
from meshsplats.blender.inside import meshes, versions
from meshsplats.blender.inside.host import bpy

BASE = "meshsplats_base"
"""Property of the splats' object: the object of their base."""
PROBLEM = "meshsplats_problem"
"""Property of the splats' object: why it could not follow its base; empty if it did."""
LIFT = "meshsplats_lift"
"""Property of the mesh data: distance between layers."""
ATTRIBUTES = {"vertex_face": "splat_base_face", "weights": "splat_base_weights", "layers": "splat_layer"}
"""Attributes of the vertices: the arrays of the binding."""
FACE = ATTRIBUTES["vertex_face"]
_FIELDS = [
    (field, ATTRIBUTES[field.name], *(("FLOAT_VECTOR", "vector") if field.columns else ("INT", "value")))
    for field in Binding.FIELDS
    if field.per == "vertex"
]
"""Each array with the name, the type and the property of its attribute."""


def store(data: Any, binding: Binding) -> None:
    """Keeps ``binding`` with the bpy mesh ``data`` of its splats, but for the base, which is an object."""
    for field, name, kind, key in _FIELDS:
        attribute = data.attributes.new(name, kind, "POINT")
        attribute.data.foreach_set(key, getattr(binding, field.name).ravel())
    data[LIFT] = binding.lift


def give_base(thing: Any, binding: Binding, collection: Any) -> Any:
    """Makes the base of ``thing``, the object of its splats, as an object in ``collection``: drawn as wire,
    left out of pictures, at the splats' place, which hang on it from now on. Returns it."""
    data = meshes.make_plain(f"{thing.name} base", binding.base_vertices, binding.base_faces)
    data.update(calc_edges=True)
    base = bpy.data.objects.new(f"{thing.name} base", data)
    base.display_type = "WIRE"
    base.hide_render = True
    base.matrix_world = thing.matrix_world.copy()
    collection.objects.link(base)
    thing.parent = base
    thing.matrix_parent_inverse.identity()
    thing.matrix_basis.identity()
    thing[BASE] = base
    thing[PROBLEM] = ""
    return base


def base_of(thing: Any) -> Any:
    """The object of the base that ``thing`` follows; None if it follows none, or that has been deleted."""
    base = thing.get(BASE) if thing is not None and thing.type == "MESH" else None
    if base is None or base.type != "MESH" or FACE not in thing.data.attributes:
        return None
    return base


def binding_of(thing: Any) -> Binding:
    """The binding of ``thing`` to its base as that stands without modifiers.

    Raises ValueError if the base has other vertices or faces than the splats were bound to.
    """
    base = base_of(thing)
    if base is None:
        raise ValueError("the object is bound to no base")
    data = thing.data
    arrays = {}
    for field, name, _, key in _FIELDS:
        arrays[field.name] = np.empty(field.shape({"vertex": len(data.vertices)}), field.dtype)
        data.attributes[name].data.foreach_get(key, arrays[field.name].reshape(-1))
    corners = np.empty(len(base.data.loops), np.int32)
    base.data.loops.foreach_get("vertex_index", corners)
    if len(corners) != 3 * len(base.data.polygons):
        raise ValueError("the base has faces that are not triangles: undo that, or bind the splats anew")
    return Binding(_coordinates(base.data), corners.reshape(-1, 3), **arrays, lift=data[LIFT])


def follow(things: Iterable[Any], depsgraph: Any) -> int:
    """Moves the splats ``things`` to where their bases are in ``depsgraph``, modifiers and simulations done;
    returns how many. What went wrong stands in the object's property ``PROBLEM``."""
    moved = 0
    for thing in things:
        problem = ""
        try:
            _move(thing, depsgraph)
            moved += 1
        except ValueError as error:
            problem = str(error)
        if thing.get(PROBLEM) != problem:
            thing[PROBLEM] = problem
    return moved


def followers(scene: Any) -> list[Any]:
    """The objects of ``scene`` that follow a base."""
    return [thing for thing in scene.objects if base_of(thing) is not None]


def _move(thing: Any, depsgraph: Any) -> None:
    binding, base = binding_of(thing), base_of(thing)
    places = _evaluated(base, depsgraph)
    if len(places) != len(binding.base_vertices):
        raise ValueError(
            f"the base has {len(binding.base_vertices):,} vertices, with its modifiers {len(places):,}:"
            " splats follow modifiers that move vertices, not those that add some"
        )
    if not np.isfinite(places).all():
        raise ValueError("the base has vertices at no finite place")
    moved = binding.moved(places, binding.lift)
    data = thing.data
    versions.set_positions(data, moved.positions())
    if meshes.NORMAL in data.attributes:
        normals = moved.normals()
        data.attributes[meshes.NORMAL].data.foreach_set("vector", normals.ravel())
        versions.set_normals(data, normals)
    data.update()


def _evaluated(base: Any, depsgraph: Any) -> np.ndarray:
    """(n, 3) float32 vertices of the object ``base`` in its own frame, as it is drawn."""
    if base.mode == "EDIT":  # what is being edited has no evaluated mesh yet
        import bmesh

        edited = bmesh.from_edit_mesh(base.data)
        return np.array([vertex.co[:] for vertex in edited.verts], np.float32).reshape(-1, 3)
    evaluated = base.evaluated_get(depsgraph)
    mesh = evaluated.to_mesh()
    try:
        return _coordinates(mesh)
    finally:
        evaluated.to_mesh_clear()


def _coordinates(mesh: Any) -> np.ndarray:
    places = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", places)
    return places.reshape(-1, 3)


def after_update(scene: Any, depsgraph: Any) -> None:
    """Follows the bases whose shape has changed, a handler of ``depsgraph_update_post``. Splats that are
    moved change too, but are no bases."""
    waiting = followers(scene)
    if waiting:
        changed = {update.id.original for update in depsgraph.updates if update.is_updated_geometry}
        follow([t for t in waiting if base_of(t) in changed or base_of(t).data in changed], depsgraph)


def after_frame(scene: Any, depsgraph: Any) -> None:
    """Follows all bases, a handler of ``frame_change_post``."""
    follow(followers(scene), depsgraph)
