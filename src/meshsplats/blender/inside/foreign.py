"""Meshes that Blender's own importers made of our .glb, .ply and .usd files."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshsplats.colors import linear_to_srgb
from meshsplats.mesh import Blending, SplatMesh

_OPACITIES = ("displayOpacity",)
"""Attributes that hold the opacity apart from the colour, as USD has it."""
_OWNERS = ("face_splat", "splat")
"""Attributes of the faces that may hold the number of the splat."""


def splat_mesh(thing: Any) -> SplatMesh:
    """The mesh of ``thing``, an object with vertex colours that Blender or another add-on made, in its own
    frame.

    The colours are taken for linear light, as Blender keeps colours: .glb and .usd hold it so, and a .ply
    comes in so with the importer's default, sRGB. They come back as display colours, unless a .glb says that
    its mesh was made for blending in linear light. Of colours that differ at the corners of a vertex, the
    mean is taken. Raises ValueError for an object without triangles or colours.
    """
    data: Any = thing.data if thing is not None and thing.type == "MESH" else None
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
    # Up in Blender's world, as the object lies in it.
    up = np.array(thing.matrix_world.to_3x3().inverted_safe())[:, 2]
    return SplatMesh(
        vertices.reshape(-1, 3),
        faces.reshape(-1, 3),
        colors,
        face_splat=_owner(data),
        up=up if np.linalg.norm(up) > 0 else np.array([0, 0, 1]),
        blending=blending,
    )


def _blending(data: Any) -> Blending:
    """What our .glb files say of themselves. Blender keeps it with the mesh: as properties, or, where a
    number is too large for one, as Python would print it."""
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
    """(f,) int32 number of each face's splat, where the file held it."""
    for name in _OWNERS:
        attribute = data.attributes.get(name)
        if attribute is not None and (attribute.domain, attribute.data_type) == ("FACE", "INT"):
            owner = np.empty(len(data.polygons), np.int32)
            attribute.data.foreach_get("value", owner)
            if len(owner) and owner[0] >= 0 and (np.diff(owner) >= 0).all():
                return owner
    return None
