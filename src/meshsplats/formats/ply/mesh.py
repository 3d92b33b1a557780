"""Meshes as `.ply`: our own files (binary, float RGBA, lossless) and those of other programs.

Our own files are little endian. Element ``vertex``: float x y z, nx ny nz where the mesh has normals,
red green blue alpha (straight, as programs should show them, 0 to 1; above only where the mesh has neither
harmonics nor plain colours), ``colors:0`` to ``colors:2`` where those of the mesh differ, then
``attribute_NAME`` or ``attribute_NAME:COLUMN`` with the name in percent encoding. Element ``face``: ``list
uchar int vertex_indices``, then int ``face_splat`` and ``depth_group`` where the mesh has them. Element
``splat``, where the mesh has harmonics: float ``f_rest_0``, ... as 3DGS has them, all of red, of green, of
blue, for each splat in the order of its triangles. Comments that begin with ``meshsplats`` hold the rest. For
a mesh with an origin x y z are doubles in the world, and float ``local_x local_y local_z`` the mesh's own
coordinates, which the sums cannot give back to the last bit.
"""

from __future__ import annotations

import shutil
import tempfile
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any, BinaryIO
from urllib.parse import quote, unquote

import numpy as np

from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats._validation import (
    Budget,
    check_attribute_names,
    checked,
    straight_colors,
    warn_of_lost_detail,
)
from meshsplats.formats.mesh_formats import FileSize, MeshCodec
from meshsplats.formats.ply.faces import read_faces
from meshsplats.formats.ply.header import (
    MAX_PROPERTIES,
    Element,
    PlyHeader,
    origin_comments,
    origin_of_comments,
    read_header,
)
from meshsplats.formats.ply.table import POSITION, FloatTable
from meshsplats.scene.joining import check_alike
from meshsplats.scene.mesh import MAX_COLOR, SplatMesh
from meshsplats.scene.origin import choose_origin, zero_origin
from meshsplats.scene.spherical_harmonics import TERMS

_ATTRIBUTE = "attribute_"
_LOCAL = ("local_x", "local_y", "local_z")
_ROUNDING = 1e-15
"""Rounding of the sum of an origin and a local coordinate, as a share of the origin."""
_COLORS = ("colors:0", "colors:1", "colors:2")
_ROWS = 1 << 15
_COLOR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))


# -- writing


def write_mesh_ply(mesh: SplatMesh, path: Path, *, colored: bool = True) -> None:
    """Writes ``mesh`` to ``path`` exactly, its colours only where it is ``colored``. ValueError for more than
    ``MAX_PROPERTIES`` columns per vertex."""
    layout = _Layout(mesh, colored)
    with open(path, "wb") as file:
        rows = 0 if mesh.harmonics is None else len(mesh.harmonics)
        file.write(layout.header(len(mesh.vertices), len(mesh.faces), rows))
        layout.write_vertices(mesh, file)
        layout.write_faces(mesh, file, 0)
        layout.write_splats(mesh, file)


def write_mesh_blocks(parts: Iterable[SplatMesh], path: Path, where: Path) -> tuple[int, int, int]:
    """Writes one mesh that comes in ``parts``, each with vertex indices of its own; the file is that of
    ``write_mesh_ply`` for all of them together. ``where``: its name, for messages.

    Returns counts of vertices, triangles and splats. Raises ValueError if there are no parts, if they are not
    alike (``SplatMesh.joined``) or have depth groups, and for more than a mesh can number.
    """
    vertices = faces = splats = 0
    layout: _Layout | None = None
    empty: SplatMesh | None = None
    with (
        tempfile.TemporaryFile(dir=path.parent) as first,
        tempfile.TemporaryFile(dir=path.parent) as second,
        tempfile.TemporaryFile(dir=path.parent) as third,
        open(path, "wb") as file,
    ):
        for number, part in enumerate(parts):
            layout, empty = layout or _Layout(part), empty or part.take(slice(0))
            check_alike(empty, part, f"parts[{number}]")
            if number and (part.depth_group is not None or empty.depth_group is not None):
                raise ValueError(
                    "depth groups of parts are not told apart: join them first, SplatMesh.joined"
                )
            part = part.relative_to(layout.origin)
            layout.write_vertices(part, first)
            layout.write_faces(part, second, vertices)
            layout.write_splats(part, third)
            vertices, faces = vertices + len(part.vertices), faces + len(part.faces)
            splats += part.splat_count or 0
            if max(vertices, faces) > np.iinfo(np.int32).max:
                raise ValueError(
                    f"{where}: more than 2^31 - 1 vertices or triangles; build a tileset instead"
                )
        if layout is None:
            raise ValueError(f"{where}: no mesh to write: parts is empty")
        file.write(layout.header(vertices, faces, splats))
        for spooled in (first, second, third):
            spooled.seek(0)
            shutil.copyfileobj(spooled, file, 1 << 20)
    return vertices, faces, splats


class _Layout:
    """Elements and properties of the file of a mesh, and of others with the same optional arrays."""

    def __init__(self, mesh: SplatMesh, colored: bool = True) -> None:
        check_attribute_names(mesh)
        up = " ".join(repr(float(u)) for u in mesh.up)
        self._head = [
            "ply",
            "format binary_little_endian 1.0",
            "comment meshsplats 1",
            f"comment meshsplats up {up}",
            f"comment meshsplats blending {mesh.blending}",
            *origin_comments(mesh.origin),
        ]
        self.origin = mesh.origin
        if mesh.filter_px2:
            self._head.append(f"comment meshsplats filter_px2 {mesh.filter_px2!r}")
        if mesh.order != "fragment":
            self._head.append(f"comment meshsplats order {mesh.order}")
        self._names = [*(_LOCAL if mesh.origin.any() else POSITION)]
        if mesh.normals is not None:
            self._names += ["nx", "ny", "nz"]
        self._colored = colored
        self._names += ["red", "green", "blue", "alpha"] if colored else []
        self._terms = 0 if mesh.harmonics is None else mesh.harmonics.shape[1]
        self._two_colors = bool(self._terms) or mesh.plain_colors is not None
        if self._two_colors:
            self._names += _COLORS
        if mesh.plain_colors is not None:
            self._head.append("comment meshsplats plain_colors")
        for name, values in mesh.attributes.items():
            width = "-" if values.ndim == 1 else values.shape[1]
            self._head.append(f"comment meshsplats attribute {_stored(name)} {width}")
        for stored, values in _tables(mesh).items():
            self._names += _properties(stored, None if values.ndim == 1 else values.shape[1])
        if len(self._names) > MAX_PROPERTIES:
            count = len(self._names)
            raise ValueError(f"{count} columns per vertex are more than {MAX_PROPERTIES}; save as .npz")
        self._numbers = [field.name for field, _ in mesh.extras().items() if field.per == "face"]

    def header(self, vertices: int, faces: int, splats: int) -> bytes:
        lines = [*self._head, f"element vertex {vertices}"]
        if self.origin.any():
            lines += [f"property double {name}" for name in POSITION]
        lines += [f"property float {name}" for name in self._names]
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
        lines += [f"property int {name}" for name in self._numbers]
        if self._terms:
            lines += [f"element splat {splats}"]
            lines += [f"property float {name}" for name in _rest(self._terms)]
        return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")

    def write_vertices(self, mesh: SplatMesh, file: IO[bytes]) -> None:
        columns = [mesh.vertices, *([] if mesh.normals is None else [mesh.normals])]
        if self._colored:
            columns += [mesh.plain.colors, mesh.colors[:, :3]] if self._two_colors else [mesh.colors]
        for values in _tables(mesh).values():
            columns.append(values.reshape(len(values), -1) if values.size else values.reshape(len(values), 0))
        for start in range(0, len(mesh.vertices), _ROWS):
            part = slice(start, start + _ROWS)
            rows = np.concatenate([c[part] for c in columns], axis=1).astype("<f4", copy=False)
            if self.origin.any():
                local, own = rows, np.dtype([("world", "<f8", 3), ("rest", "<f4", rows.shape[1])])
                rows = np.empty(len(local), own)
                rows["world"], rows["rest"] = local[:, :3] + self.origin, local
            file.write(rows.data)

    def write_faces(self, mesh: SplatMesh, file: IO[bytes], first: int) -> None:
        """``first``: index of the mesh's first vertex in the file."""
        fields: list[tuple[str, str] | tuple[str, str, int]] = [("n", "u1"), ("corners", "<i4", 3)]
        fields += [(name, "<i4") for name in self._numbers]
        for start in range(0, len(mesh.faces), _ROWS):
            part = slice(start, start + _ROWS)
            faces = np.empty(len(mesh.faces[part]), np.dtype(fields))
            faces["n"] = 3
            faces["corners"] = mesh.faces[part] + np.int32(first)
            for name in self._numbers:
                faces[name] = getattr(mesh, name)[part]
            file.write(faces.data)

    def write_splats(self, mesh: SplatMesh, file: IO[bytes]) -> None:
        if mesh.harmonics is not None:
            for start in range(0, len(mesh.harmonics), _ROWS):
                rows = mesh.harmonics[start : start + _ROWS].transpose(0, 2, 1)
                file.write(np.ascontiguousarray(rows, "<f4").data)


def _rest(terms: int) -> tuple[str, ...]:
    """Names of the harmonics of a splat, ``terms`` of each colour, without the constant ones."""
    return tuple(f"f_rest_{i}" for i in range(3 * terms))


def _stored(name: str) -> str:
    """Name in the file of an attribute."""
    return _ATTRIBUTE + quote(name, safe="")


def _tables(mesh: SplatMesh) -> dict[str, np.ndarray]:
    """Arrays of vertices that only this project reads, by their names in the file."""
    return {_stored(name): values for name, values in mesh.attributes.items()}


def _properties(name: str, columns: Any) -> tuple[str, ...]:
    """Names of the properties that hold an array of ``columns``, None for (v,)."""
    return (name,) if columns is None else tuple(f"{name}:{i}" for i in range(columns))


# -- reading


def read_mesh_ply(path: Path, origin: np.ndarray | None = None) -> SplatMesh:
    """The mesh in a `.ply` file of any encoding and byte order; polygons are cut into triangles.

    Positions are relative to ``origin``; by default to that of our files, or to one that suits those of
    others.

    Colours: red, green, blue and alpha as floats in [0, 1] or unsigned integers; without alpha the mesh is
    opaque, without colours it is mid grey, with a DataWarning. Raises FileFormatError.
    """
    with open(path, "rb") as file:
        header = read_header(file, path)
        vertex, face = header.element("vertex"), header.element("face")
        names = () if vertex is None else vertex.names
        if face is None and any(n.startswith(("f_dc_", "packed_")) for n in names):
            raise FileFormatError(f"{path}: holds Gaussian splats, not a mesh; read it with load_gaussians")
        if vertex is None or any(n not in names for n in "xyz"):
            raise FileFormatError(f"{path}: not a mesh: no element 'vertex' with x, y and z")
        if face is None:
            raise FileFormatError(
                f"{path}: not a mesh but points: it has no element 'face'; nor splats, whose vertices have"
                " f_dc_0 to f_dc_2, opacity, scale_0 to scale_2 and rot_0 to rot_3"
            )
        return _read(file, header, vertex, face, path, origin)


def _read(
    file: BinaryIO,
    header: PlyHeader,
    vertex: Element,
    face: Element,
    path: Path,
    origin: np.ndarray | None,
) -> SplatMesh:
    rgb = next((c for c in _COLOR_NAMES if all(n in vertex.names for n in c)), ())
    alpha = tuple(n for n in ("alpha", "diffuse_alpha", "a") if rgb and n in vertex.names)[:1]
    groups: dict[str, tuple[str, ...]] = {"vertices": ("x", "y", "z"), "colors": (*rgb, *alpha)}
    if all(n in vertex.names for n in ("nx", "ny", "nz")):
        groups["normals"] = ("nx", "ny", "nz")
    attributes, settings = _notes(header, vertex, path)
    for name, (_, columns) in attributes.items():
        groups[f"attribute {name}"] = columns
    own = "up" in settings  # written by this project
    if own and all(n in vertex.names for n in _COLORS):
        groups["view"] = _COLORS
    if own and all(n in vertex.names for n in _LOCAL):
        groups["local"] = _LOCAL
    wanted = tuple(dict.fromkeys(n for columns in groups.values() for n in columns))
    table = FloatTable(file, header, vertex, wanted, path)
    if own:
        named = origin_of_comments(header.comments, path)
        table.origin = zero_origin() if named is None else named
    else:
        table.origin = _chosen(table, path) if origin is None else origin
    settings["origin"] = table.origin
    v = len(table)
    budget = Budget(path)
    budget.spend(4 * v * (sum(len(c) for c in groups.values()) + 4), "the vertices")
    place = {n: i for i, n in enumerate(table.names)}
    arrays = {key: np.empty((v, len(columns)), np.float32) for key, columns in groups.items()}
    done = 0
    for chunk in table.chunks():
        for key, columns in groups.items():
            arrays[key][done : done + len(chunk)] = chunk[:, [place[n] for n in columns]]
        done += len(chunk)
    if "local" in arrays:  # unless another program has moved the vertices, and left the local ones
        moved = np.abs(arrays["local"] - arrays["vertices"]) > _ROUNDING * np.abs(table.origin)
        if not moved.any():
            arrays["vertices"] = arrays["local"]
    types = {p.name: p.dtype for p in vertex.properties}
    for i, name in enumerate(groups["colors"]):
        if types[name].kind == "u":
            arrays["colors"][:, i] /= np.float32(np.iinfo(types[name]).max)
        elif types[name].kind == "i" and arrays["colors"][:, i].max(initial=0) > 1:
            # Bytes in a wider type: no program writes white as the largest signed integer.
            arrays["colors"][:, i] /= np.float32(255)
    of_faces = tuple(field.name for field in SplatMesh.EXTRAS if field.per == "face")
    faces, numbers = read_faces(file, header, face, of_faces, arrays["vertices"], budget, path)
    plain = settings.pop("plain_colors", False)
    if own:
        settings["harmonics"] = _harmonics(file, header, budget, path)
    if "face_splat" not in numbers:
        lost = [
            what
            for name, what in (
                ("filter_px2", "the filter of its splats"),
                ("order", "their order"),
                ("harmonics", "their harmonics"),
            )
            if settings.pop(name, None) is not None
        ]
        if lost:
            warnings.warn(
                f"{path}: another program has changed the file, so this is ignored: {', '.join(lost)}",
                DataWarning,
                stacklevel=3,
            )
    colors = straight_colors(arrays["colors"], path, MAX_COLOR if own else 1)
    if plain:
        settings["plain_colors"] = colors[:, :3].copy()
    if "view" in arrays:
        rgba = np.concatenate([arrays["view"], colors[:, 3:]], axis=1)
        colors = straight_colors(rgba, path, MAX_COLOR)
    return checked(
        path,
        SplatMesh,
        vertices=arrays["vertices"],
        faces=faces,
        colors=colors,
        normals=arrays.get("normals"),
        attributes={
            name: arrays[f"attribute {name}"][:, 0] if flat else arrays[f"attribute {name}"]
            for name, (flat, _) in attributes.items()
        },
        **settings,
        **numbers,
    )


def _harmonics(file: BinaryIO, header: PlyHeader, budget: Budget, path: Path) -> np.ndarray | None:
    """(s, k, 3) those of the element ``splat``, None without any."""
    element = header.element("splat")
    if element is None:
        return None
    count = len(element.names)
    if count not in [3 * terms for terms in TERMS] or set(element.names) != set(_rest(count // 3)):
        raise FileFormatError(
            f"{path}: element 'splat' must have f_rest_0 to f_rest_8, f_rest_23 or f_rest_44, of degree 1, 2"
            f" or 3, got {count} properties"
        )
    names = _rest(count // 3)
    table = FloatTable(file, header, element, names, path)
    budget.spend(4 * len(table) * count, "the harmonics")
    place = [table.names.index(name) for name in names]
    rows = np.empty((len(table), count), np.float32)
    done = 0
    for chunk in table.chunks():
        rows[done : done + len(chunk)] = chunk[:, place]
        done += len(chunk)
    return rows.reshape(-1, 3, count // 3).transpose(0, 2, 1)


def _chosen(table: FloatTable, path: Path) -> np.ndarray:
    """The origin that suits the positions of a file of another program."""
    sample = table.sample()
    if table.positions_are_float32:
        warn_of_lost_detail(sample, path)
    return choose_origin(sample)


def _notes(
    header: PlyHeader, vertex: Element, path: Path
) -> tuple[dict[str, tuple[bool, tuple[str, ...]]], dict[str, Any]]:
    """Contents of our comments: for each attribute (whether it is (v,), its properties), and settings."""
    attributes: dict[str, tuple[bool, tuple[str, ...]]] = {}
    settings: dict[str, Any] = {}
    for comment in header.comments:
        words = comment.split(" ")
        if words[0] != "meshsplats":
            continue
        match words[1:]:
            case ["up", x, y, z]:
                try:
                    settings["up"] = [float(x), float(y), float(z)]
                except ValueError:
                    raise FileFormatError(
                        f"{path}: the up direction must be 3 numbers: {comment[:60]}"
                    ) from None
            case ["blending", space]:
                settings["blending"] = space
            case ["order", order]:
                settings["order"] = order
            case ["plain_colors"]:
                settings["plain_colors"] = True
            case ["filter_px2", variance]:
                try:
                    settings["filter_px2"] = float(variance)
                except ValueError:
                    raise FileFormatError(f"{path}: filter_px2 must be a number: {comment[:60]}") from None
            case ["attribute", name, width]:
                counted = width.isascii() and width.isdecimal() and len(width) <= 4
                names = _properties(name, int(width) if counted else None)
                missing = [n for n in names if n not in vertex.names]
                if missing:
                    raise FileFormatError(f"{path}: property {missing[0][:60]!r} of an attribute is missing")
                attributes[unquote(name.removeprefix(_ATTRIBUTE))] = (width == "-", names)
            case _:
                pass  # the version, or a note of a later version
    return attributes, settings


def _bytes(size: FileSize) -> int:
    mesh, held = size.mesh, size.held
    held += 12 * len(mesh.vertices) if mesh.harmonics is not None and mesh.plain_colors is None else 0
    return (52 if mesh.origin.any() else 28) * len(mesh.vertices) + 13 * len(mesh.faces) + held


CODEC = MeshCodec(lambda content: content.container == "ply", read_mesh_ply, write_mesh_ply, _bytes)
