"""Writes several parts of a scene as one binary glTF file: each as its own writer makes it, joined here.

Splats lie in the axes of other splat files; their node turns them to where meshes of the same world are. The
collider is a mesh that no viewer draws, as its material lets nothing of it pass the alpha test.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.errors import MissingDependencyError
from meshsplats.formats._scene import SceneParts
from meshsplats.formats.gltf.binary_chunk import BinaryChunk, placed_node, write_binary
from meshsplats.formats.gltf.scene_parts import COLLIDES, INVISIBLE
from meshsplats.formats.gltf.splats_writer import splats_part
from meshsplats.formats.gltf.writer import mesh_part
from meshsplats.formats.surfaces.corners import normal_file, smooth_normals
from meshsplats.formats.surfaces.tangents import corner_frames
from meshsplats.scene.base_mesh import BaseMesh, Texture
from meshsplats.scene.colors import srgb_to_linear

COLLIDER = "collider-colonly"
"""Godot's suffix for a mesh that becomes a collider and is not drawn."""
_WRAPS = {"repeat": 10497, "mirror": 33648, "clamp": 33071}
_REFERS = {
    "bufferView": "bufferViews",
    "indices": "accessors",
    "mesh": "meshes",
    "material": "materials",
    "index": "textures",
    "source": "images",
    "sampler": "samplers",
}
"""Keys of numbers that are indices, and of what."""
_LISTS = ("nodes", "accessors", "bufferViews", "meshes", "materials", "textures", "images", "samplers")

Part = tuple[dict[str, Any], BinaryChunk]


def write_scene_glb(parts: SceneParts, path: Path, *, lit: bool) -> None:
    """Writes ``parts``; see ``save_scene``. ValueError for more than the 4 GiB that a file can hold."""
    made: list[Part] = []
    if parts.splats is not None:
        made.append(splats_part(parts.splats, beside_meshes=True))
    if parts.mesh is not None:
        made.append(mesh_part(parts.mesh, lit=lit))
    if parts.surface is not None:
        made.append(_surface_part(parts.surface, lit))
    if parts.collider is not None:
        made.append(_collider_part(parts.collider))
    document, chunk = _joined(made)
    write_binary(path, document, chunk, what="the scene", advice="; write its parts apart")


def _joined(parts: list[Part]) -> Part:
    """One file of all parts: indices in the later ones are moved behind those of the earlier ones."""
    whole: dict[str, list[Any]] = {name: [] for name in _LISTS}
    chunk = BinaryChunk()
    roots: list[int] = []
    used: set[str] = set()
    for document, own in parts:
        first = {name: len(entries) for name, entries in whole.items()}
        for view in own.views:
            view["byteOffset"] += chunk.length
        for name in _LISTS:
            whole[name] += [_moved(entry, first) for entry in document.get(name, [])]
        roots += [root + first["nodes"] for root in document["scenes"][0]["nodes"]]
        used |= set(document.get("extensionsUsed", []))
        chunk.parts += own.parts
        chunk.length += own.length
    joined = {"asset": parts[0][0]["asset"], "scene": 0, "scenes": [{"nodes": roots}]}
    joined |= {name: entries for name, entries in whole.items() if entries}
    if used:
        joined["extensionsUsed"] = sorted(used)
    return joined | {"buffers": [{"byteLength": chunk.length}]}, chunk


def _moved(value: Any, first: dict[str, int]) -> Any:
    """``value`` of a document with its indices moved."""
    if isinstance(value, list):
        return [_moved(entry, first) for entry in value]
    if not isinstance(value, dict):
        return value
    found: dict[str, Any] = {}
    for key, entry in value.items():
        if key in _REFERS and isinstance(entry, int):
            found[key] = entry + first[_REFERS[key]]
        elif key == "attributes" and isinstance(entry, dict):
            found[key] = {name: index + first["accessors"] for name, index in entry.items()}
        elif key == "children":
            found[key] = [index + first["nodes"] for index in entry]
        else:
            found[key] = _moved(entry, first)
    return found


def _collider_part(collider: BaseMesh) -> Part:
    chunk = BinaryChunk()
    primitive = _triangles(chunk, collider.vertices, collider.faces)
    meshes = [{"name": COLLIDER, "primitives": [primitive], "extras": COLLIDES}]
    return chunk.document([placed_node(COLLIDER, collider, mesh=0)], meshes, [dict(INVISIBLE)]), chunk


def _surface_part(base: BaseMesh, lit: bool) -> Part:
    """A primitive for the faces of each texture, and one for those without."""
    chunk = BinaryChunk()
    of_face = np.full(len(base.faces), -1) if base.face_texture is None else base.face_texture
    primitives, samplers = [], []
    materials: list[dict[str, Any]] = []
    images: list[dict[str, Any]] = []
    normals = smooth_normals(base) if lit else None
    relief: dict[str, Any] = {}
    if lit and base.normal_map is not None and base.textured and base.uv is not None:
        tangents = corner_frames(base.vertices, base.faces, base.uv, base.up).signed
        relief = {"normalTexture": {"index": 0}}
        images.append(_image(chunk, normal_file(base)[1]))
        samplers.append(_sampler(base.textures[0]))
    for texture in np.unique(of_face):
        chosen = of_face == texture
        corners, factor = base.faces[chosen].reshape(-1), None
        if texture < 0 or base.uv is None:
            used, faces = np.unique(corners, return_inverse=True)
            extra = {}
        else:
            rows = np.concatenate([corners[:, None], base.uv[chosen].reshape(-1, 2)], axis=1)
            rows, first, faces = np.unique(rows, axis=0, return_index=True, return_inverse=True)
            used, extra = rows[:, 0].astype(np.int64), {"TEXCOORD_0": rows[:, 1:].astype(np.float32)}
            if relief:
                extra["TANGENT"] = tangents[chosen].reshape(-1, 4)[first]
        if normals is not None:
            extra["NORMAL"] = normals[used]
        if texture < 0 and base.colors is not None:
            linear = base.colors[used].copy()
            linear[:, :3] = srgb_to_linear(linear[:, :3])
            extra["COLOR_0"] = linear
        elif texture >= 0 and base.tints is not None:
            extra["COLOR_0"] = base.tints[used]
        if texture >= 0:
            source = base.textures[texture]
            factor = {"baseColorFactor": list(source.factor), "baseColorTexture": {"index": len(images)}}
            images.append(_image(chunk, png_of(source.pixels)))
            samplers.append(_sampler(source))
        primitive = _triangles(chunk, base.vertices[used], faces.reshape(-1, 3).astype(np.int32), extra)
        primitives.append(primitive | {"material": len(materials)})
        mode = "OPAQUE" if texture < 0 else alpha_mode(base.textures[texture])
        if texture >= 0 and base.tints is not None and (base.tints[used, 3] < 1).any():
            mode = "BLEND"
        material = _material(factor or {}, mode, lit)
        materials.append(material if factor is None else material | relief)
    meshes = [{"name": "surface", "primitives": primitives}]
    document = chunk.document([placed_node("surface", base, mesh=0)], meshes, materials)
    if images:
        listed = [{"source": i, "sampler": i} for i in range(len(images))]
        document |= {"images": images, "samplers": samplers, "textures": listed}
    if not lit:
        document["extensionsUsed"] = ["KHR_materials_unlit"]
    return document, chunk


def alpha_mode(texture: Texture) -> str:
    """That of glTF: BLEND where any pixel is translucent."""
    opacities = texture.pixels[..., 3]
    if texture.factor[3] < 1 or bool(((opacities > 0) & (opacities < 255)).any()):
        return "BLEND"
    return "MASK" if bool((opacities == 0).any()) else "OPAQUE"


def _material(base: dict[str, Any], alpha_mode: str, lit: bool) -> dict[str, Any]:
    material: dict[str, Any] = {
        "name": "surface",
        "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1, **base},
        "doubleSided": True,
        "alphaMode": alpha_mode,
    }
    return material if lit else material | {"extensions": {"KHR_materials_unlit": {}}}


def png_of(pixels: np.ndarray) -> bytes:
    """The image (h, w, 4) uint8 as PNG; without alpha where all is opaque. MissingDependencyError without
    Pillow."""
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise MissingDependencyError("textures need the package pillow: pip install pillow") from error
    opaque = (pixels[..., 3] == 255).all()
    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels[..., :3] if opaque else pixels)).save(out, "PNG")
    return out.getvalue()


def _image(chunk: BinaryChunk, png: bytes) -> dict[str, Any]:
    return {"mimeType": "image/png", "bufferView": chunk.view(np.frombuffer(png, np.uint8))}


def _sampler(texture: Texture) -> dict[str, int]:
    return {"wrapS": _WRAPS[texture.wrap[0]], "wrapT": _WRAPS[texture.wrap[1]]}


def _triangles(
    chunk: BinaryChunk, vertices: np.ndarray, faces: np.ndarray, extra: dict[str, np.ndarray] | None = None
) -> dict[str, Any]:
    attributes = {"POSITION": chunk.positions(vertices)}
    attributes |= {name: chunk.attribute(array) for name, array in (extra or {}).items()}
    return {"attributes": attributes, "indices": chunk.indices(faces), "material": 0}
