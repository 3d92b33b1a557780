"""Mesh files: the reader is chosen by content, the writer by suffix."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from meshsplats.errors import FileFormatError
from meshsplats.formats.atomic import atomic_path
from meshsplats.formats.glb import ColorType, write_glb
from meshsplats.formats.gltf_reader import read_gltf
from meshsplats.formats.mesh_ply import read_mesh_ply, write_mesh_ply
from meshsplats.formats.npz import read_npz, write_npz
from meshsplats.formats.obj import read_obj
from meshsplats.mesh import SplatMesh

_WRITERS = {".npz": write_npz, ".ply": write_mesh_ply, ".glb": write_glb}

MESH_SUFFIXES = tuple(_WRITERS)
"""Suffixes that ``save_mesh`` knows."""


def load_mesh(path: str | os.PathLike[str]) -> SplatMesh:
    """The mesh in a file: `.npz`, `.ply`, `.glb`, `.gltf` or `.obj`, recognised by what it holds.

    A file that ``save_mesh`` wrote comes back with its positions, faces and extra arrays exactly; colours
    are exact from `.npz` and `.ply` and within 1/2000 from `.glb`. Meshes of other programs are read as far
    as triangles and vertex colours go: polygons are cut into triangles, textures left out with a
    DataWarning.

    Raises FileNotFoundError or IsADirectoryError, and FileFormatError for a file that is broken, of
    another kind or holds no mesh; the message says what is wrong and where.
    """
    source = Path(path)
    with open(source, "rb") as file:
        head = file.read(4096)
    if not head:
        raise FileFormatError(f"{source}: the file is empty")
    if head[:4] in (b"PK\x03\x04", b"PK\x05\x06"):
        return read_npz(source)
    if re.match(rb"ply[ \t]*[\r\n]", head):
        return read_mesh_ply(source)
    if head[:4] == b"glTF" or re.match(rb"(\xef\xbb\xbf)?\s*\{", head):
        return read_gltf(source)
    if b"\0" not in head and (
        source.suffix.lower() == ".obj" or re.search(rb"(^|\n)v[ \t]+[-+.\d]", head) is not None
    ):
        return read_obj(source)
    raise FileFormatError(
        f"{source}: not a mesh file that is known here, it begins with {head[:8]!r};"
        " expected .npz, .ply, .glb, .gltf or .obj"
    )


def save_mesh(
    mesh: SplatMesh,
    path: str | os.PathLike[str],
    *,
    lit: bool | None = None,
    color_type: ColorType | None = None,
) -> None:
    """Writes ``mesh`` in the format that the suffix of ``path`` names, whole or not at all; an older
    file is replaced.

    `.npz` and `.ply` keep everything exactly. `.glb` keeps colours as linear values of 16 bits (within
    1/2000 as display values), everything else exactly; it alone takes options: ``lit`` (default False) for
    a material that scene lights shade instead of one that shows the colours as they are, ``color_type``
    (default 'uint16', or 'float32') for how colours are stored.

    Raises ValueError for an unknown suffix, an option that the format does not have, or a mesh that the
    format cannot hold, and OSError for a place that cannot be written, all before an older file is
    touched.
    """
    target = Path(path)
    suffix = target.suffix.lower()
    writer = _WRITERS.get(suffix)
    if writer is None:
        known = ", ".join(_WRITERS)
        raise ValueError(f"{target.name!r} does not name a mesh format; choose a name that ends in {known}")
    given = {"lit": lit, "color_type": color_type}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if options and suffix != ".glb":
        raise ValueError(f"the option {next(iter(options))} applies to .glb only, not to {suffix}")
    with atomic_path(target) as temporary:
        writer(mesh, temporary, **options)
