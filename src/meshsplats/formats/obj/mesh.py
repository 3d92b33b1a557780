"""Wavefront `.obj` meshes: vertices, polygons, and colours after the positions, as many programs write
them."""

from __future__ import annotations

import warnings
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from meshsplats._origin import in_words, zero_origin
from meshsplats.colors import linear_to_srgb
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats._validation import checked, local_positions, straight_colors
from meshsplats.formats.mesh_formats import FileSize, MeshCodec
from meshsplats.formats.ply.faces import cut_polygons
from meshsplats.mesh import SplatMesh

_UP_COMMENT = "# meshsplats up"
_ORIGIN_COMMENT = "# meshsplats origin"
_ROWS = 1 << 14


def write_obj(mesh: SplatMesh, path: Path) -> None:
    """Writes positions, display colours after them (those for programs without harmonics) and triangles as
    text; nine digits keep float32 exactly.

    The format has no opacity: a DataWarning counts translucent vertices. Positions are in the world, doubles
    where the mesh has an origin; the up direction and the origin are in comments, which ``load_mesh`` reads
    and other programs ignore.
    """
    lost = [f.name for f in mesh.extras() if f.per == "face"] + list(mesh.attributes)
    translucent = int((mesh.colors[:, 3] < 1).sum())
    if translucent:
        more = f"; also left out: {', '.join(n[:40] for n in lost[:8])}" if lost else ""
        warnings.warn(
            f"{path.suffix} files have no opacity: {translucent:,} of {len(mesh.vertices):,} vertices are"
            f" translucent and will look solid{more}. Save as .glb, .ply or .usdc to keep it",
            DataWarning,
            stacklevel=3,
        )
    rgb = mesh.plain.colors[:, :3]
    rgb = linear_to_srgb(rgb) if mesh.blending == "linear" else rgb
    up = " ".join(repr(float(u)) for u in mesh.up)
    corner = "%d" if mesh.normals is None else "%d//%d"
    with open(path, "wb") as file:
        file.write(b"# x y z, then red green blue as display values\n")
        file.write(f"{_UP_COMMENT} {up}\n".encode())
        if mesh.origin.any():
            file.write(f"{_ORIGIN_COMMENT} {in_words(mesh.origin)}\n".encode())
            write_rows(file, "v %r %r %r %.9g %.9g %.9g\n", mesh.vertices, rgb, plus=mesh.origin)
        else:
            write_rows(file, "v %.9g %.9g %.9g %.9g %.9g %.9g\n", mesh.vertices, rgb)
        if mesh.normals is not None:
            write_rows(file, "vn %.9g %.9g %.9g\n", mesh.normals)
        faces = mesh.faces + 1
        columns = [faces[:, k, None] for k in range(3) for _ in range(corner.count("%"))]
        write_rows(file, f"f {corner} {corner} {corner}\n", *columns)


def write_rows(file: BinaryIO, line: str, *columns: np.ndarray, plus: np.ndarray | None = None) -> None:
    """Writes the (n, c) arrays ``columns`` side by side, each row by the pattern ``line``; ``plus``, float64,
    is added to the first of them."""
    for start in range(0, len(columns[0]), _ROWS):
        parts = [c[start : start + _ROWS] for c in columns]
        if plus is not None:
            parts[0] = parts[0] + plus
        rows = np.concatenate(parts, axis=1)
        file.write((line * len(rows) % tuple(rows.ravel().tolist())).encode())


def read_obj(path: Path, origin: np.ndarray | None = None) -> SplatMesh:
    """The polygons of all objects and groups as one opaque mesh, cut into triangles.

    Positions are relative to ``origin``; by default to that of our files, or to one that suits those of
    others.

    Up is +y, as usual for these files, unless a comment of ours says otherwise. Colours are those of lines
    ``v x y z r g b``, display values in [0, 1], if all vertices have them; else the mesh is grey, with a
    DataWarning. Texture coordinates, normals and materials are ignored. Raises FileFormatError that names the
    line.
    """
    up, own = np.array([0.0, 1.0, 0.0]), None
    positions, colors, lengths, corners = array("d"), array("d"), array("q"), array("q")
    with open(path, "rb") as file:
        for number, words in statements(file.read()):
            try:
                if words[:3] == _UP_COMMENT.encode().split():
                    up = np.array([float(u) for u in words[3:6]])
                    own = zero_origin() if own is None else own
                elif words[:3] == _ORIGIN_COMMENT.encode().split():
                    x, y, z = map(float, words[3:6])
                    own = np.array([x, y, z])
                elif words[0] == b"v":
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
    vertices, at = local_positions(
        np.array(positions).reshape(-1, 3), own if origin is None else origin, path
    )
    stored = np.array(colors).reshape(-1, 3)
    return checked(
        path,
        SplatMesh,
        vertices=vertices,
        faces=faces,
        colors=straight_colors(
            stored if len(stored) == len(vertices) else np.empty((len(vertices), 0)), path
        ),
        up=up,
        origin=at,
    )


def statements(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """The words of each line with its line number; a backslash at the end joins the next line."""
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
    """0-based vertex index of ``v``, ``v/vt`` or ``v/vt/vn``, which count from 1, or from -1 back."""
    stored = int(word.partition(b"/")[0])
    index = stored - 1 if stored > 0 else stored + count
    if word[:1] == b"0" or index < 0:
        raise ValueError
    return index


def _bytes(size: FileSize) -> int:
    return 75 * len(size.mesh.vertices) + (26 if size.mesh.normals is None else 50) * len(size.mesh.faces)


CODEC = MeshCodec(lambda content: content.is_obj, read_obj, write_obj, _bytes)
