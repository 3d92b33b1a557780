"""Wavefront `.obj` meshes: vertices, polygons, and colours after the positions, as many programs write
them.

Readers of these files take +y for up. Ours are turned so, and a comment has the up direction from before, by
which they are turned back; the name of the object, too, which editors keep. Older ones of ours are not
turned, with their up direction in another comment.
"""

from __future__ import annotations

import warnings
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats._orientation import up_rotation
from meshsplats.formats._polygons import corner_places, cut_polygons
from meshsplats.formats._validation import checked, local_positions, straight_colors
from meshsplats.formats.mesh_formats import FileSize, MeshCodec
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.origin import in_words, zero_origin

_TURNED_COMMENT = "# meshsplats turned"
_UP_COMMENT = "# meshsplats up"
_ORIGIN_COMMENT = "# meshsplats origin"
_NAME = "meshsplats_up_"
_ROWS = 1 << 14


def write_obj(mesh: SplatMesh, path: Path, *, colored: bool = True) -> None:
    """Writes positions, display colours after them (those for programs without harmonics) where the mesh is
    ``colored``, and triangles as text; nine digits keep float32 exactly.

    The format has no opacity: a DataWarning counts translucent vertices. Positions are in the world, turned
    until +y is up; doubles where the mesh has an origin or its up direction is along no axis. The up
    direction and the origin are in comments, by which ``load_mesh`` gives the same mesh. ValueError for a
    mesh without triangles, which readers take for none.
    """
    if not len(mesh.faces):
        raise ValueError("OBJ cannot hold a mesh without triangles; save it as .npz or .ply")
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
    corner = "%d" if mesh.normals is None else "%d//%d"
    with open(path, "wb") as file:
        file.write(b"# x y z, then red green blue as display values\n" if colored else b"")
        file.write(comments(mesh))
        wide = mesh.origin.any() or not _along_axes(_turn(mesh.up))
        xyz = "%r %r %r" if wide else "%.9g %.9g %.9g"
        line, colors = (f"v {xyz} %.9g %.9g %.9g\n", [rgb]) if colored else (f"v {xyz}\n", [])
        write_rows(file, line, turned_positions(mesh), *colors)
        if mesh.normals is not None:
            write_rows(file, "vn %.9g %.9g %.9g\n", turned_directions(mesh, mesh.normals))
        faces = mesh.faces + 1
        columns = [faces[:, k, None] for k in range(3) for _ in range(corner.count("%"))]
        write_rows(file, f"f {corner} {corner} {corner}\n", *columns)


def comments(mesh: SplatMesh | BaseMesh) -> bytes:
    """Lines by which ``read_obj`` puts a mesh back in its place."""
    lines = [f"{_TURNED_COMMENT} {' '.join(repr(float(u)) for u in mesh.up)}\n"]
    if mesh.origin.any():
        lines.append(f"{_ORIGIN_COMMENT} {in_words(mesh.origin)}\n")
    lines.append(f"o {_NAME}{'_'.join(f'{u:.9g}' for u in mesh.up)}_to_y\n")
    return "".join(lines).encode()


def turned_positions(mesh: SplatMesh | BaseMesh) -> np.ndarray:
    """(v, 3) float64 vertices in the world, turned until +y is up."""
    return np.asarray((mesh.vertices + mesh.origin) @ _turn(mesh.up).T + 0.0)


def turned_directions(mesh: SplatMesh | BaseMesh, directions: np.ndarray) -> np.ndarray:
    """(n, 3) float64 ``directions`` (n, 3) of the mesh, turned with its vertices."""
    return np.asarray(directions @ _turn(mesh.up).T + 0.0)


def _turn(up: np.ndarray) -> np.ndarray:
    """(3, 3) float64 ``up_rotation``; between axes without rounding errors, so that no digit is lost."""
    turn = up_rotation(up)
    return np.round(turn) if _along_axes(turn) else turn


def _along_axes(turn: np.ndarray) -> bool:
    return bool(np.abs(turn - np.round(turn)).max() < 1e-12)


def write_rows(file: BinaryIO, line: str, *columns: np.ndarray) -> None:
    """Writes the (n, c) arrays ``columns`` side by side, each row by the pattern ``line``."""
    for start in range(0, len(columns[0]), _ROWS):
        rows = np.concatenate([c[start : start + _ROWS] for c in columns], axis=1)
        file.write((line * len(rows) % tuple(rows.ravel().tolist())).encode())


def read_obj(path: Path, origin: np.ndarray | None = None) -> SplatMesh:
    """The polygons of all objects and groups as one opaque mesh, cut into triangles.

    Positions are relative to ``origin``; by default to that of our files, or to one that suits those of
    others.

    Up is +y, as usual for these files, unless a note of ours says that they were turned or never were.
    Colours are those of lines ``v x y z r g b``, display values in [0, 1], if all vertices have them; else
    the mesh is grey, with a DataWarning. Texture coordinates, normals and materials are ignored. Raises
    FileFormatError that names the line.
    """
    up, turn, own = np.array([0.0, 1.0, 0.0]), None, None
    positions, colors, lengths, corners = array("d"), array("d"), array("q"), array("q")
    with open(path, "rb") as file:
        for number, words in statements(file.read()):
            try:
                if words[:3] == _TURNED_COMMENT.encode().split():
                    up, turn = _turned(words[3:6])
                    own = zero_origin() if own is None else own
                elif turn is None and words[0] == b"o" and words[-1].startswith(_NAME.encode()):
                    up, turn = _turned(words[-1].removeprefix(_NAME.encode()).split(b"_")[:3])
                elif words[:3] == _UP_COMMENT.encode().split():
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
                    corners.extend(corner(word, count) for word in words[1:])
            except (ValueError, OverflowError):
                text = b" ".join(words)[:60].decode("latin-1")
                raise FileFormatError(f"{path}: line {number:,} cannot be read: {text!r}") from None
    if not lengths:
        raise FileFormatError(f"{path}: holds no faces")
    points, polygons = np.array(positions).reshape(-1, 3), np.array(corners)
    faces = polygons[cut_polygons(np.array(lengths), corner_places(points, polygons))[0]]
    if turn is not None:
        with np.errstate(invalid="ignore", over="ignore"):
            points = points @ turn
    vertices, at = local_positions(points, own if origin is None else origin, path)
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


def _turned(words: list[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """The up direction of a mesh, and the turn that its file has. ValueError for none."""
    x, y, z = map(float, words)
    up = np.array([x, y, z])
    if not (np.isfinite(up).all() and up.any()):
        raise ValueError
    return up, _turn(up)


def statements(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """The words of each line with its line number; a backslash at the end joins the next line."""
    joined: list[bytes] = []
    for number, line in enumerate(data.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n"), 1):
        if line.endswith(b"\\"):
            joined.append(line[:-1])
            continue
        words = b" ".join((*joined, line)).split() if joined else line.split()
        joined = []
        if words:
            yield number, words


def corner(word: bytes, count: int) -> int:
    """0-based vertex index of ``v``, ``v/vt`` or ``v/vt/vn``, which count from 1, or from -1 back."""
    stored = int(word.partition(b"/")[0])
    index = stored - 1 if stored > 0 else stored + count
    if word[:1] == b"0" or index < 0:
        raise ValueError
    return index


def _bytes(size: FileSize) -> int:
    return 75 * len(size.mesh.vertices) + (26 if size.mesh.normals is None else 50) * len(size.mesh.faces)


CODEC = MeshCodec(lambda content: content.is_obj, read_obj, write_obj, _bytes)
