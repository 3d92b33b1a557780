"""What differs between Blender 4.2 and 5.x, and nowhere else."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshsplats.blender.inside.host import bpy

OLDEST = (4, 2, 0)


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


def set_normals(mesh: Any, normals: np.ndarray) -> None:
    """Gives each vertex of a bpy mesh its (v, 3) normal; the faces must wind so that their own agree with
    it."""
    normals = np.ascontiguousarray(normals, np.float32)
    if bpy.app.version < (4, 5, 0):
        mesh.normals_split_custom_set_from_vertices(normals)
        return
    attribute = mesh.attributes.new("custom_normal", "FLOAT_VECTOR", "POINT")
    attribute.data.foreach_set("vector", normals.ravel())
    mesh.update()


def set_if_there(owner: Any, **values: Any) -> None:
    """Sets those properties that this version of Blender has."""
    for name, value in values.items():
        if hasattr(owner, name):
            setattr(owner, name, value)


def enable_cycles() -> None:
    """Cycles is an add-on; with a bare user configuration it may be off."""
    import addon_utils

    if not hasattr(bpy.types.Scene, "cycles"):
        addon_utils.enable("cycles", default_set=False, persistent=False)
