"""glTF as a format of meshes: see ``reader`` and ``writer``."""

from __future__ import annotations

from meshsplats.formats.gltf.reader import read_gltf
from meshsplats.formats.gltf.view_colors import stored_bytes
from meshsplats.formats.gltf.writer import write_glb
from meshsplats.formats.mesh_formats import FileSize, MeshCodec


def _bytes(size: FileSize) -> int:
    v, f = len(size.mesh.vertices), len(size.mesh.faces)
    held = size.held + stored_bytes(size.mesh)
    whole = 20 * v + (1 + size.copies) * (12 if v > 0xFFFF else 6) * f + held
    return 3 * whole // 10 if size.compressed else whole


CODEC = MeshCodec(lambda content: content.container in ("glb", "json"), read_gltf, write_glb, _bytes)
