"""Meshes that Blender's own importers made of our .glb, .ply and .usd files."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshsplats.blender.inside import frame
from meshsplats.colors import linear_to_srgb
from meshsplats.mesh import Blending, SplatMesh

_OPACITIES = ("displayOpacity",)
"""Attributes that hold opacity apart from colour, as in USD."""
_OWNERS = ("face_splat", "splat")
"""Face attributes that may hold the index of the splat."""


def splat_mesh(obj: Any) -> SplatMesh:
    """The mesh of ``obj``, an object with vertex colours from another importer, in its own frame.

    Blender keeps colours as linear light: .glb and .usd store them so, and the .ply importer converts them by
    default. They are returned as display colours, unless a .glb says that its mesh was made for blending in
    linear light. Colours that differ between the corners of a vertex are averaged.

    Raises:
        ValueError: the object has no triangles or no colours.
    """
    data: Any = obj.data if obj is not None and obj.type == "MESH" else None
    if data is None or not len(data.color_attributes):
        raise ValueError("the object has no vertex colours")
    faces = np.empty(len(data.loops), np.int32)
    data.loops.foreach_get("vertex_index", faces)
    if len(faces) != 3 * len(data.polygons):
        raise ValueError("the object has faces that are not triangles: triangulate it first")
    vertices = np.empty(3 * len(data.vertices), np.float32)
    data.vertices.foreach_get("co", vertices)
    colors = _at_vertices(
        data, data.color_attributes.active_color or data.color_attributes[0], "color", 4, faces
    )
    for name in _OPACITIES:
        if name in data.attributes and data.attributes[name].data_type == "FLOAT":
            colors[:, 3] = _at_vertices(data, data.attributes[name], "value", 1, faces)[:, 0]
    colors = np.nan_to_num(np.clip(colors, 0, 1))
    blending = _blending(data)
    if blending == "display":
        colors[:, :3] = np.clip(linear_to_srgb(colors[:, :3]), 0, 1)
    return SplatMesh(
        vertices.reshape(-1, 3),
        faces.reshape(-1, 3),
        colors,
        face_splat=_owner(data),
        up=frame.up_of(obj),
        blending=blending,
    )


def _blending(data: Any) -> Blending:
    """Blending as noted in our .glb files. Blender keeps the note with the mesh: as properties, or, where an
    integer is too large for one, as Python's text of it."""
    note = data.get("meshsplats")
    if isinstance(note, str):
        return "linear" if "'blending': 'linear'" in note else "display"
    return "linear" if hasattr(note, "get") and note.get("blending") == "linear" else "display"


def _at_vertices(data: Any, attribute: Any, name: str, width: int, corners: np.ndarray) -> np.ndarray:
    """(v, width) float32 values of a point or corner attribute."""
    flat = np.empty(width * len(attribute.data), np.float32)
    attribute.data.foreach_get(name, flat)
    values = flat.reshape(-1, width)
    if attribute.domain == "POINT":
        return values
    if attribute.domain != "CORNER":
        raise ValueError(
            f"{attribute.name}: colours must belong to vertices or corners, not {attribute.domain}"
        )
    count = len(data.vertices)
    uses = np.maximum(np.bincount(corners, minlength=count), 1)
    sums = [np.bincount(corners, values[:, k], count) for k in range(width)]
    return (np.stack(sums, axis=1) / uses[:, None]).astype(np.float32)


def _owner(data: Any) -> np.ndarray | None:
    """(f,) int32 index of each face's splat, where the file held it."""
    for name in _OWNERS:
        attribute = data.attributes.get(name)
        if attribute is not None and (attribute.domain, attribute.data_type) == ("FACE", "INT"):
            owner = np.empty(len(data.polygons), np.int32)
            attribute.data.foreach_get("value", owner)
            if len(owner) and owner[0] >= 0 and (np.diff(owner) >= 0).all():
                return owner
    return None
