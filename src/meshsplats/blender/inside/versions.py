"""The differences between Blender 4.2 and 5.x, all in one place."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from meshsplats.blender.inside.host import bpy

OLDEST = (4, 2, 0)

CUSTOM_NORMAL = "custom_normal"
"""Blender's own name for the attribute that replaces a mesh's normals, from 4.5 on."""


def engine_name(engine: str) -> str:
    """Blender's identifier of 'cycles' or 'eevee'."""
    if engine == "cycles":
        return "CYCLES"
    return "BLENDER_EEVEE_NEXT" if bpy.app.version < (5, 0, 0) else "BLENDER_EEVEE"


def node_tree(owner: Any) -> Any:
    """The empty shader node tree of a material or world. (From 5.0 on, they always have one.)"""
    if bpy.app.version < (5, 0, 0):
        owner.use_nodes = True
    owner.node_tree.nodes.clear()
    return owner.node_tree


def socket(sockets: Any, *names: str) -> Any:
    """The first of ``names`` that a node's inputs or outputs have: sockets are renamed now and then."""
    for name in names:
        if name in sockets:
            return sockets[name]
    raise KeyError(f"none of the sockets {', '.join(names)}; there are {', '.join(s.name for s in sockets)}")


def set_positions(mesh: Any, vertices: np.ndarray) -> None:
    """Gives the vertices of a bpy mesh their (v, 3) positions."""
    flat = np.ascontiguousarray(vertices, np.float32).ravel()
    # One copy fills the attribute, in a hundredth of the time that ``vertices`` takes value by value.
    if "position" in mesh.attributes:
        mesh.attributes["position"].data.foreach_set("vector", flat)
    else:
        mesh.vertices.foreach_set("co", flat)


def set_corners(mesh: Any, faces: np.ndarray) -> None:
    """Gives the corners of a bpy mesh of triangles their vertices, (f, 3)."""
    flat = np.ascontiguousarray(faces, np.int32).ravel()
    if ".corner_vert" in mesh.attributes:  # as above; the name is internal to Blender
        mesh.attributes[".corner_vert"].data.foreach_set("value", flat)
    else:
        mesh.loops.foreach_set("vertex_index", flat)


def positions(mesh: Any) -> np.ndarray:
    """(v, 3) float32 positions of the vertices of a bpy mesh, read as ``set_positions`` writes them."""
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    attribute = mesh.attributes.get("position")
    if attribute is not None and len(attribute.data) == len(mesh.vertices):  # none in edit mode
        attribute.data.foreach_get("vector", flat)
    else:
        mesh.vertices.foreach_get("co", flat)
    return flat.reshape(-1, 3)


def corners(mesh: Any) -> np.ndarray:
    """(l,) int32 vertices of the corners of a bpy mesh, read as ``set_corners`` writes them."""
    found = np.empty(len(mesh.loops), np.int32)
    attribute = mesh.attributes.get(".corner_vert")
    if attribute is not None and len(attribute.data) == len(found):
        attribute.data.foreach_get("value", found)
    else:
        mesh.loops.foreach_get("vertex_index", found)
    return found


def shade_flat(mesh: Any) -> None:
    """Shades each face of a bpy mesh flat, so that no vertex normals are computed and stored."""
    flat = mesh.attributes.new("sharp_face", "BOOLEAN", "FACE")
    flat.data.foreach_set("value", np.ones(len(mesh.polygons), bool))


def set_normals(mesh: Any, normals: np.ndarray) -> None:
    """Gives each vertex of a bpy mesh its (v, 3) normal; the winding of the faces must agree with it."""
    normals = np.ascontiguousarray(normals, np.float32)
    if bpy.app.version < (4, 5, 0):
        if not len(mesh.edges):  # Blender reads them here
            mesh.update(calc_edges=True)
        mesh.normals_split_custom_set_from_vertices(normals)
        return
    attribute = mesh.attributes.get(CUSTOM_NORMAL)
    if attribute is None or (attribute.data_type, attribute.domain) != ("FLOAT_VECTOR", "POINT"):
        if attribute is not None:
            mesh.attributes.remove(attribute)
        attribute = mesh.attributes.new(CUSTOM_NORMAL, "FLOAT_VECTOR", "POINT")
    attribute.data.foreach_set("vector", normals.ravel())
    if len(mesh.edges):  # else they would be made
        mesh.update()


def set_if_there(owner: Any, **values: Any) -> None:
    """Sets the properties that this version of Blender has."""
    for name, value in values.items():
        if hasattr(owner, name):
            setattr(owner, name, value)


def integer_math() -> str:
    """The node that calculates with whole numbers; before 4.3, those beyond 2^24 are rounded."""
    exact = "FunctionNodeIntegerMath"
    return exact if hasattr(bpy.types, exact) else "ShaderNodeMath"


def shows(depsgraph: Any, objs: Collection[Any]) -> bool:
    """Whether ``depsgraph`` shows any of ``objs``, also as an instance, and so has evaluated it. From Blender
    5 on, the evaluated mesh does not tell, where modifiers do nothing."""
    return any(one.object.original in objs for one in depsgraph.object_instances)


def enable_cycles() -> None:
    """Enables the add-on Cycles, which may be off in a bare user configuration."""
    import addon_utils

    if not hasattr(bpy.types.Scene, "cycles"):
        addon_utils.enable("cycles", default_set=False, persistent=False)


def can_denoise() -> bool:
    """Whether this Blender has OpenImageDenoise. Some Linux distributions leave it out, and Cycles then fails
    when it is to denoise. Needs Cycles."""
    import _cycles

    return bool(_cycles.with_openimagedenoise)


def set_input(modifier: Any, name: str, value: Any) -> None:
    """Gives the input ``name`` of a Geometry Nodes ``modifier`` a value."""
    key = _key(modifier, name)
    if hasattr(modifier, "properties"):  # since 5.2
        getattr(modifier.properties.inputs, key).value = value
    else:
        modifier[key] = value


def input_of(modifier: Any, name: str) -> Any:
    """The value of the input ``name`` of a Geometry Nodes ``modifier``; None where its group, from an older
    file, has no such input."""
    key = _key(modifier, name)
    if not key:
        return None
    if hasattr(modifier, "properties"):
        return getattr(modifier.properties.inputs, key).value
    return modifier.get(key)


def _key(modifier: Any, name: str) -> str:
    sockets = modifier.node_group.interface.items_tree if modifier.node_group is not None else ()
    return next((s.identifier for s in sockets if s.name == name and s.in_out == "INPUT"), "")
