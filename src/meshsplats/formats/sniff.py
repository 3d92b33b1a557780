"""What kind of thing a file holds, by its content."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Literal

from meshsplats.errors import FileFormatError
from meshsplats.formats.gaussians import splat_format
from meshsplats.formats.gltf.splats import has_splats
from meshsplats.formats.ply.header import read_header
from meshsplats.formats.ply.splats import is_float_splat
from meshsplats.formats.usd.reader import is_usd


def identify(path: Path) -> Literal["splats", "mesh", "cameras"]:
    """What kind of thing ``path`` is, by its content. Raises FileFormatError if it is none of them.

    Four kinds of file may hold either splats or a mesh: .ply, .glb and .gltf, and zip archives (.sog, .npz).
    """
    if path.is_dir():
        return "splats"
    with open(path, "rb") as file:
        start = file.read(4096)
        file.seek(0)
        found = splat_format(path)
        if found == "ply":
            return "splats" if is_float_splat(read_header(file, path)) else "mesh"
    if is_usd(start):
        return "mesh"
    if found == "sog" and start.startswith(b"PK"):
        return "mesh" if _holds_arrays(path) else "splats"
    if found == "gltf":
        return "splats" if has_splats(path) else "mesh"
    text = b"\0" not in start
    if text and (path.suffix.lower() == ".obj" or re.search(rb"(^|\n)v[ \t]+[-+.\d]", start)):
        return "mesh"
    if found is not None:
        return "splats"
    if text and re.match(rb"(\xef\xbb\xbf)?\s*[\[{]", start):
        return "cameras"
    if not start:
        raise FileFormatError(f"{path}: the file is empty")
    raise FileFormatError(
        f"{path}: neither splats, a mesh nor cameras as known here; it begins with {start[:8]!r}"
    )


def _holds_arrays(path: Path) -> bool:
    """Whether a zip archive is an .npz."""
    if path.suffix.lower() == ".usdz":  # its reader says what to do
        return True
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except (zipfile.BadZipFile, ValueError, OSError):
        # Broken: the name decides which reader says so.
        return path.suffix.lower() == ".npz"
