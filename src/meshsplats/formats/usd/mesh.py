"""USD as a format of meshes: see ``reader`` and ``writer``."""

from __future__ import annotations

from meshsplats.formats.mesh_formats import FileSize, MeshCodec
from meshsplats.formats.usd.reader import read_usd
from meshsplats.formats.usd.writer import write_usd


def _bytes(size: FileSize) -> int:
    v, f = len(size.mesh.vertices), len(size.mesh.faces)
    return 85 * v + 24 * f + 3 * size.held if size.suffix == ".usda" else 28 * v + 6 * f + size.held


CODEC = MeshCodec(lambda content: content.is_usd, read_usd, write_usd, _bytes)
