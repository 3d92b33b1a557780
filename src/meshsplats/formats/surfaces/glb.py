"""Surfaces as binary glTF 2.0: one opaque primitive, with its texture inside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.base_mesh import BaseMesh
from meshsplats.colors import srgb_to_linear
from meshsplats.formats._orientation import turned_origin, up_quaternion
from meshsplats.formats.gltf.binary_chunk import BinaryChunk, write_binary
from meshsplats.formats.surfaces.corners import corners_of, texture_file

_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp"}
_CLAMP, _LINEAR, _MIPMAPS = 33071, 9729, 9987
_WEBP = "EXT_texture_webp"


_NAMES = {None: "surface", "drawn": "surface-col", "only": "surface-colonly"}
"""By the suffixes Godot makes a collider; with the second it leaves out the mesh."""


def write_surface_glb(
    base: BaseMesh, path: Path, *, unlit: bool, image: str | None, collision: str | None = None
) -> None:
    """Writes ``base`` to ``path``: see ``save_base``."""
    from meshsplats import __version__

    buffer, shape = BinaryChunk(), corners_of(base)
    low, high = shape.vertices.min(axis=0).tolist(), shape.vertices.max(axis=0).tolist()
    attributes = {
        "POSITION": buffer.accessor(shape.vertices, _FLOAT, _ARRAY_BUFFER, min=low, max=high),
        "NORMAL": buffer.accessor(shape.normals, _FLOAT, _ARRAY_BUFFER),
    }
    pbr: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
    material: dict[str, Any] = {"name": "surface", "pbrMetallicRoughness": pbr}
    used: list[str] = []
    document: dict[str, Any] = {"materials": [material]}
    if shape.uv is not None:
        attributes["TEXCOORD_0"] = buffer.accessor(shape.uv, _FLOAT, _ARRAY_BUFFER)
        suffix, content = texture_file(base, image)
        view = buffer.view(np.frombuffer(content, np.uint8))
        pbr["baseColorTexture"] = {"index": 0}
        texture: dict[str, Any] = {"sampler": 0, "source": 0}
        if suffix == ".webp":
            texture = {"sampler": 0, "extensions": {_WEBP: {"source": 0}}}
            used.append(_WEBP)
            document["extensionsRequired"] = [_WEBP]
        document |= {
            "textures": [texture],
            "images": [{"bufferView": view, "mimeType": _TYPES[suffix], "name": "surface"}],
            "samplers": [
                {"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP},
            ],
        }
    elif shape.colors is not None:
        linear = shape.colors.copy()
        linear[:, :3] = srgb_to_linear(linear[:, :3])
        stored = (linear * np.float32(65535) + np.float32(0.5)).astype(np.uint16)
        attributes["COLOR_0"] = buffer.accessor(stored, _UINT16, _ARRAY_BUFFER, normalized=True)
    small = len(shape.vertices) <= 0xFFFF  # the largest index is kept free: it is a restart mark
    indices = shape.faces.ravel().astype(np.uint16 if small else np.uint32)
    index = buffer.accessor(indices, _UINT16 if small else _UINT32, _ELEMENT_ARRAY_BUFFER)
    if unlit:
        material["extensions"] = {"KHR_materials_unlit": {}}
        used.append("KHR_materials_unlit")
    note = {"version": 1, "blending": "display", "up": [float(u) for u in base.up]}
    name = _NAMES[collision]
    node: dict[str, Any] = {"name": name, "mesh": 0, "rotation": up_quaternion(base.up)}
    if base.origin.any():
        note["origin"] = base.origin.tolist()
        node["translation"] = turned_origin(base).tolist()
    primitive = {"attributes": attributes, "indices": index, "material": 0}
    document |= {
        "asset": {"version": "2.0", "generator": f"MeshSplats {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"name": name, "primitives": [primitive], "extras": {"meshsplats": note}}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": buffer.length}],
    }
    if used:
        document["extensionsUsed"] = used
    write_binary(path, document, buffer, what="the surface", advice="; choose fewer faces")
