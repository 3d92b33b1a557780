"""Wavefront `.obj` meshes: vertices, polygons, and colours behind the positions as many programs write
them."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats.mesh_checks import checked_mesh, straight_colors
from meshsplats.formats.ply_faces import cut_polygons
from meshsplats.mesh import SplatMesh


def read_obj(path: Path) -> SplatMesh:
    """The polygons of all objects and groups as one opaque mesh, cut into triangles; up is +y, the
    custom of these files.

    Colours are taken from lines ``v x y z r g b``, display values in [0, 1], if all vertices have them;
    else the mesh is grey, with a DataWarning. Texture coordinates, normals and materials are left out.
    Raises FileFormatError naming the line.
    """
    positions, colors, lengths, corners = array("d"), array("d"), array("q"), array("q")
    with open(path, "rb") as file:
        for number, words in _statements(file.read()):
            try:
                if words[0] == b"v":
                    x, y, z = map(float, words[1:4])
                    positions.extend((x, y, z))
                    if len(words) >= 7:
                        colors.extend(map(float, words[4:7]))
                elif words[0] == b"f":
                    count = len(positions) // 3
                    lengths.append(len(words) - 1)
                    corners.extend(_corner(word, count) for word in words[1:])
            except (ValueError, OverflowError):
                text = b" ".join(words)[:60].decode("latin-1")
                raise FileFormatError(f"{path}: line {number:,} cannot be read: {text!r}") from None
    if not lengths:
        raise FileFormatError(f"{path}: holds no faces")
    faces, _ = cut_polygons(np.array(lengths), np.array(corners), {})
    vertices = np.array(positions).reshape(-1, 3)
    stored = np.array(colors).reshape(-1, 3)
    return checked_mesh(
        path,
        vertices=vertices,
        faces=faces,
        colors=straight_colors(
            stored if len(stored) == len(vertices) else np.empty((len(vertices), 0)), path
        ),
        up=(0, 1, 0),
    )


def _statements(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """The words of each line with its number; a backslash at the end joins the next line."""
    joined = b""
    for number, line in enumerate(data.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n"), 1):
        if line.endswith(b"\\"):
            joined += line[:-1] + b" "
            continue
        words = (joined + line).split() if joined else line.split()
        joined = b""
        if words:
            yield number, words


def _corner(word: bytes, count: int) -> int:
    """Vertex number, from 0, of ``v``, ``v/vt`` or ``v/vt/vn``; stored from 1, or negative from the
    latest back."""
    number = int(word.partition(b"/")[0])
    number = number - 1 if number > 0 else number + count
    if word[:1] == b"0" or number < 0:
        raise ValueError
    return number
