"""Surfaces as binary glTF 2.0: one opaque primitive, with its texture inside; colliders beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.formats.gltf.binary_chunk import BinaryChunk, placed_node, write_binary
from meshsplats.formats.gltf.cameras import camera_node, lens_of
from meshsplats.formats.gltf.scene_parts import COLLIDES, INVISIBLE
from meshsplats.formats.surfaces.convex import convex_parts
from meshsplats.formats.surfaces.corners import corners_of, normal_file, texture_file
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import srgb_to_linear

_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp"}
_WRAPS = {"repeat": 10497, "mirror": 33648, "clamp": 33071}
_LINEAR, _MIPMAPS = 9729, 9987
_WEBP = "EXT_texture_webp"
_NAMES = {None: "surface", "drawn": "surface-col", "only": "surface-colonly", "convex": "surface"}
"""By the suffixes Godot makes a collider; with the second it leaves out the mesh."""
_UNREAL = "UCX_surface_{:02d}"
"""By this prefix Unreal makes a mesh a convex collider of the one whose name follows."""


def write_surface_glb(
    base: BaseMesh,
    path: Path,
    *,
    unlit: bool,
    image: str | None,
    collision: str | None = None,
    cameras: Sequence[Camera] = (),
) -> None:
    """Writes ``base`` to ``path``: see ``save_base``."""
    chunk, shape = BinaryChunk(), corners_of(base)
    attributes = {"POSITION": chunk.positions(shape.vertices), "NORMAL": chunk.attribute(shape.normals)}
    pbr: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
    material: dict[str, Any] = {"name": "surface", "pbrMetallicRoughness": pbr}
    more: dict[str, Any] = {}
    used: list[str] = []
    linear = shape.tints
    if shape.uv is not None:
        attributes["TEXCOORD_0"] = chunk.attribute(shape.uv)
        suffix, content = texture_file(base, image)
        wrap_s, wrap_t = (_WRAPS[mode] for mode in base.textures[0].wrap)
        pbr["baseColorTexture"] = {"index": 0}
        pictures = [("surface", suffix, content)]
        if shape.tangents is not None and not unlit:
            attributes["TANGENT"] = chunk.attribute(shape.tangents)
            material["normalTexture"] = {"index": 1}
            pictures.append(("normals", *normal_file(base, image)))
        if suffix == ".webp":
            used.append(_WEBP)
            more["extensionsRequired"] = [_WEBP]
        more |= {
            "textures": [_texture(number, kind) for number, (_, kind, _) in enumerate(pictures)],
            "images": [
                {
                    "bufferView": chunk.view(np.frombuffer(data, np.uint8)),
                    "mimeType": _TYPES[kind],
                    "name": name,
                }
                for name, kind, data in pictures
            ],
            "samplers": [
                {"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": wrap_s, "wrapT": wrap_t},
            ],
        }
    elif shape.colors is not None:
        linear = shape.colors.copy()
        linear[:, :3] = srgb_to_linear(linear[:, :3])
    if linear is not None:
        attributes["COLOR_0"] = chunk.attribute(
            (linear * np.float32(65535) + np.float32(0.5)).astype(np.uint16)
        )
    if unlit:
        material["extensions"] = {"KHR_materials_unlit": {}}
        used.append("KHR_materials_unlit")
    if used:
        more["extensionsUsed"] = used
    note = {"version": 1, "blending": "display", "up": [float(u) for u in base.up]}
    if base.origin.any():
        note["origin"] = base.origin.tolist()
    indices = chunk.indices(shape.faces, len(shape.vertices))
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    name = _NAMES[collision]
    mesh = {"name": name, "primitives": [primitive], "extras": {"meshsplats": note}}
    nodes, meshes, materials = [placed_node(name, base, mesh=0)], [mesh], [material]
    if collision == "convex":
        parts = convex_parts(base.vertices, base.faces)
        nodes[0]["children"] = list(range(1, 1 + len(parts)))
        materials.append(INVISIBLE)
        for number, (points, triangles) in enumerate(parts):
            primitive = {
                "attributes": {"POSITION": chunk.positions(points)},
                "indices": chunk.indices(triangles, len(points)),
                "material": 1,
            }
            own = _UNREAL.format(number)
            meshes.append({"name": own, "primitives": [primitive], "extras": COLLIDES})
            nodes.append({"name": own, "mesh": 1 + number})
    if cameras:
        nodes[0]["children"] = [*nodes[0].get("children", ()), *range(len(nodes), len(nodes) + len(cameras))]
        nodes += [camera_node(camera, number) for number, camera in enumerate(cameras)]
        more["cameras"] = [lens_of(camera, base.vertices) for camera in cameras]
    document = chunk.document(nodes, meshes, materials) | more
    write_binary(path, document, chunk, what="the surface", advice="; choose fewer faces")


def _texture(source: int, suffix: str) -> dict[str, Any]:
    """The texture of an image of this kind."""
    if suffix == ".webp":
        return {"sampler": 0, "extensions": {_WEBP: {"source": source}}}
    return {"sampler": 0, "source": source}
