"""Meshes that Blender's own importers made of our .glb, .ply and .usd files."""

from __future__ import annotations

import ast
from typing import Any

import numpy as np

from meshsplats.blender.inside import frame, versions
from meshsplats.formats._orientation import Z_UP_FROM_Y_UP
from meshsplats.formats.gltf.view_colors import put_back, stored_colors
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.scene.mesh import Blending, SplatMesh
from meshsplats.scene.spherical_harmonics import moved_harmonics

_OPACITIES = ("displayOpacity",)
"""Attributes that hold opacity apart from colour, as in USD."""
_OWNERS = ("face_splat", "splat")
"""Face attributes that may hold the index of the splat."""
_LONGEST_NOTE = 100_000


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
    faces = versions.corners(data)
    if len(faces) != 3 * len(data.polygons):
        raise ValueError("the object has faces that are not triangles: triangulate it first")
    vertices = versions.positions(data)
    colors = _at_vertices(
        data, data.color_attributes.active_color or data.color_attributes[0], "color", 4, faces
    )
    for name in _OPACITIES:
        if name in data.attributes and data.attributes[name].data_type == "FLOAT":
            colors[:, 3] = _at_vertices(data, data.attributes[name], "value", 1, faces)[:, 0]
    colors = np.nan_to_num(np.clip(colors, 0, 1))
    note = _note(data)
    blending: Blending = "linear" if note.get("blending") == "linear" else "display"
    if blending == "display":
        colors[:, :3] = np.clip(linear_to_srgb(colors[:, :3]), 0, 1)
    arrays = {
        "vertices": vertices,
        "faces": faces.reshape(-1, 3),
        "colors": colors,
        "face_splat": _owner(data),
    }
    arrays |= _view_colors(data, note, arrays)
    return SplatMesh(**arrays, up=frame.up_of(obj), blending=blending)


def _note(data: Any) -> dict[str, Any]:
    """Our note in a .glb; empty without one. Blender keeps it with the mesh: as properties, or, where an
    integer is too large for one, as Python's text of it."""
    note = data.get("meshsplats")
    if isinstance(note, str) and len(note) <= _LONGEST_NOTE:
        try:
            note = ast.literal_eval(note)
        except (ValueError, SyntaxError, RecursionError, MemoryError):
            return {}
    elif hasattr(note, "to_dict"):
        note = note.to_dict()
    return note if isinstance(note, dict) else {}


def _view_colors(data: Any, note: dict[str, Any], arrays: dict[str, Any]) -> dict[str, Any]:
    """The ``arrays`` that colours which depend on the view replace or add, where a .glb held them as texture
    coordinates: Blender's importer drops the attributes that they otherwise are."""
    try:
        stored = stored_colors(note, ValueError)
    except ValueError:
        return {}
    layers = data.uv_layers
    if stored is None or stored.packing != "texcoords" or len(layers) < len(stored.names):
        return {}
    tables = {}
    for name, layer in zip(stored.names, layers, strict=False):
        flat = np.empty(2 * len(data.loops), np.float32)
        layer.uv.foreach_get("vector", flat)
        table = np.zeros((len(arrays["vertices"]), 2), np.float32)
        table[arrays["faces"].ravel()] = flat.reshape(-1, 2)
        table[:, 1] = 1 - table[:, 1]  # Blender's start at the lower edge of the image
        tables[name] = table
    own = {name: arrays[name].copy() for name in ("faces", "colors")}
    own["face_splat"] = _fans(own["faces"]) if arrays["face_splat"] is None else arrays["face_splat"]
    if not put_back(stored, tables, own):
        return {}
    if own.get("harmonics") is not None:  # turned as the importer turns vertices
        own["harmonics"] = moved_harmonics(own["harmonics"], Z_UP_FROM_Y_UP)
    return own


def _fans(faces: np.ndarray) -> np.ndarray:
    """(f,) int32: successive triangles that share a vertex are of one splat."""
    shared = (faces[1:, :, None] == faces[:-1, None, :]).any(axis=(1, 2))
    return np.concatenate([[0], np.cumsum(~shared)]).astype(np.int32)


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
