"""Meshes as `.npz`: NumPy arrays in a zip archive, nothing lost and nothing pickled.

Arrays: ``vertices`` (v, 3) float32, ``faces`` (f, 3) int32, ``vertex_colors`` (v, 4) float32 straight RGBA;
where the mesh has them ``normals``, ``face_splat``, ``depth_group``, ``harmonics`` (s, k, 3),
``plain_colors`` (v, 3) and one ``attribute_NAME`` for each attribute; ``up`` (3,), ``blending`` (a text) and,
if they are not 0, ``filter_px2`` and the float64 ``origin`` (3,) that positions are relative to; ``order`` (a
text), if it is that by the splat; for a mesh prior its ``binding_base_vertices`` (n, 3),
``binding_base_faces`` (m, 3), ``binding_vertex_face`` (v,), ``binding_weights`` (v, 3), ``binding_layers``
(v,), ``binding_lift`` and, where it has one, ``binding_stretch`` (n,), as ``Binding`` names them. The first
three names are those of the published MeshSplats code, whose files are read as well.
"""

from __future__ import annotations

import ast
import re
import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from meshsplats._common.foreign import BROKEN_ZIP
from meshsplats.errors import FileFormatError
from meshsplats.formats._validation import (
    Budget,
    check_attribute_names,
    checked,
    local_positions,
    straight_colors,
)
from meshsplats.formats._zipped import BoundedReader
from meshsplats.formats.mesh_formats import FileSize, MeshCodec
from meshsplats.scene.binding import Binding
from meshsplats.scene.mesh import MAX_COLOR, SplatMesh
from meshsplats.scene.spherical_harmonics import TERMS

_ATTRIBUTE = "attribute_"
_MAX_HEADER = 10_000
_BLOCK = 1 << 20
_BROKEN = (*BROKEN_ZIP, struct.error, OverflowError)
"""Errors for broken archives; the zip reader's own checks do not cover every field."""
_DEFAULTS = {"up": np.array([0, -1, 0], np.float32), "blending": np.array("display")}
"""For files of the published MeshSplats code, which lack them."""


_TEXTS = ("blending", "order")


def _stored(name: str) -> str:
    """The name in the file of one of the arrays of ``SplatMesh.arrays``."""
    return "vertex_colors" if name == "colors" else name.replace(".", "_", 1)


_NAMES = {
    _stored(name): name
    for name in (
        *(f.name for f in SplatMesh.FIELDS),
        *("blending", "order", "filter_px2", "origin", "binding.lift"),
        *(f"binding.{f.name}" for f in Binding.FIELDS),
    )
}
"""Names of ``SplatMesh.arrays`` by those in the file, without the attributes."""


def write_npz(mesh: SplatMesh, path: Path, *, colored: bool = True) -> None:
    """Writes every array of the mesh, its colours only where it is ``colored``, uncompressed: 15 to 20 times
    as fast as compressed."""
    check_attribute_names(mesh)
    arrays = {name: array for name, array in mesh.arrays().items() if colored or name != "colors"}
    # Like np.savez, whose older versions leave the archive open when the disk is full.
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{_stored(name)}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def read_npz(path: Path, origin: np.ndarray | None = None) -> SplatMesh:
    """The mesh in an `.npz` file, ours or one of the published MeshSplats code (colours (v, 3) or (v, 4),
    float in [0, 1] or 8-bit; without alpha the mesh is opaque). Other arrays are ignored. Positions are
    relative to ``origin``; by default to that of our files, or to one that suits those of others.

    Shapes are read, compared with each other and with the archive's own sizes before any array is allocated.
    Raises FileFormatError.
    """
    with BoundedReader(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                return _read(archive, path, origin)
        except FileFormatError:
            raise
        except _BROKEN as error:
            raise FileFormatError(f"{path}: not a readable .npz file: {error}") from None


@dataclass(frozen=True)
class _Member:
    """An array of the archive of which only the header has been read."""

    info: zipfile.ZipInfo
    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool
    header_bytes: int


def _read(archive: zipfile.ZipFile, path: Path, origin: np.ndarray | None) -> SplatMesh:
    members: dict[str, _Member] = {}
    for info in archive.infolist():
        name = info.filename.removesuffix(".npy")
        if name in _NAMES or name.startswith(_ATTRIBUTE):
            if name in members:
                raise FileFormatError(f"{path}: array {name!r} is stored twice")
            members[name] = _parse_member(archive, info, name, path)
    own = "blending" in members or "origin" in members  # not of another program
    needed = ("vertices", "faces") if own else ("vertices", "faces", "vertex_colors")
    missing = [n for n in needed if n not in members]
    if missing:
        have = ", ".join(i.filename.removesuffix(".npy")[:40] for i in archive.infolist()[:12]) or "nothing"
        raise FileFormatError(f"{path}: not a mesh: array {missing[0]!r} is missing (the file holds {have})")
    _check_shapes(members, path)
    budget = Budget(path)
    for name, member in members.items():
        budget.spend(member.info.file_size, f"array {name!r}")
    arrays = {name: _load(archive, member, name, path) for name, member in members.items()}
    stored = arrays.get("vertex_colors", np.empty((len(arrays["vertices"]), 0)))
    arrays["vertex_colors"] = straight_colors(stored, path, MAX_COLOR if own else 1)
    if not own:
        arrays["vertices"], arrays["origin"] = local_positions(arrays["vertices"], origin, path)
    named = {_NAMES.get(name) or name.replace("_", ".", 1): array for name, array in arrays.items()}
    try:
        return checked(path, SplatMesh.from_arrays, _DEFAULTS | named)
    except KeyError as error:
        lost = _stored(error.args[0])
        raise FileFormatError(f"{path}: the binding to a base is not whole: {lost} is missing") from None


def _parse_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str, path: Path) -> _Member:
    """Shape and type of one array from the .npy header at the start of its member."""
    at = f"{path}: array {name!r}"
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        # LZMA may claim gigabytes for its dictionary.
        raise FileFormatError(f"{at} is compressed by method {info.compress_type}, which NumPy never uses")
    with archive.open(info) as file:
        shape, dtype, fortran, start = read_npy_header(file, name, at)
    size = start + dtype.itemsize * _product(shape)
    if size != info.file_size:
        raise FileFormatError(
            f"{at} of shape {shape} and type {dtype} should take {size:,} bytes,"
            f" the archive holds {info.file_size:,}"
        )
    return _Member(info, shape, dtype, fortran, start)


def read_npy_header(file: IO[bytes], name: str, at: str) -> tuple[tuple[int, ...], np.dtype, bool, int]:
    """Shape, type, whether the first index runs fastest, and where the values begin, of the array ``name`` in
    an opened .npy file. Nothing is allocated for it. FileFormatError, which begins with ``at``."""
    magic = file.read(8)
    if magic[:6] != b"\x93NUMPY" or magic[6:] not in (b"\x01\0", b"\x02\0"):
        raise FileFormatError(f"{at} is not in .npy format 1 or 2")
    width = 2 if magic[6] == 1 else 4
    raw = file.read(width)
    length = int.from_bytes(raw, "little")
    text = file.read(length) if length <= _MAX_HEADER else b""
    if len(raw) < width or len(text) < length:
        raise FileFormatError(f"{at} has a broken header")
    return (*_parse_header(text, name, at), 8 + width + length)


def _parse_header(text: bytes, name: str, at: str) -> tuple[tuple[int, ...], np.dtype, bool]:
    """Shape, type and whether the first index runs fastest, from the dictionary that a .npy header is."""
    try:
        header = ast.literal_eval(text.decode("latin-1"))
        descr, fortran, shape = header["descr"], header["fortran_order"], header["shape"]
    except (ValueError, TypeError, SyntaxError, KeyError, RecursionError, MemoryError) as error:
        raise FileFormatError(f"{at} has a broken header: {str(error)[:100]}") from None
    if isinstance(descr, str) and "O" in descr:
        raise FileFormatError(f"{at} holds pickled Python objects, which can run code; refused")
    wanted = r"[<>=|]?U\d{1,2}" if name in _TEXTS else r"[<>=|]?(f[248]|[iu][1248])"
    if not isinstance(descr, str) or not re.fullmatch(wanted, descr, re.ASCII):
        kind = "text" if name in _TEXTS else "numbers"
        raise FileFormatError(f"{at} must hold {kind}, got dtype {str(descr)[:60]}")
    if not isinstance(shape, tuple) or not all(type(s) is int and s >= 0 for s in shape):
        raise FileFormatError(f"{at} has a broken shape: {str(shape)[:60]}")
    return shape, np.dtype(descr), bool(fortran)


def _product(shape: tuple[int, ...]) -> int:
    result = 1
    for s in shape:
        result *= s
    return result


def _check_shapes(members: dict[str, _Member], path: Path) -> None:
    """FileFormatError unless the shapes of the arrays fit each other; before any is allocated."""
    shapes = {name: member.shape for name, member in members.items()}

    def rows_of(name: str) -> int:
        return shapes[name][0] if shapes.get(name) else 0

    v = rows_of("vertices")
    counts = {
        "vertex": v,
        "face": rows_of("faces"),
        "base vertex": rows_of("binding_base_vertices"),
        "base face": rows_of("binding_base_faces"),
    }
    wanted: dict[str, tuple[tuple[int, ...], ...]] = {
        "vertex_colors": ((v, 4), (v, 3)),
        "blending": ((), (1,)),
        "order": ((), (1,)),
        "filter_px2": ((),),
        "origin": ((3,),),
        "binding_lift": ((),),
    }
    for prefix, fields in (("", SplatMesh.FIELDS), ("binding_", Binding.FIELDS)):
        wanted |= {prefix + field.name: (field.shape(counts),) for field in fields}
    for field in SplatMesh.FIELDS:
        if field.per == "splat":  # how many there are is in face_splat, which is not read yet
            rows = min(rows_of(field.name), rows_of("face_splat"))
            wanted[field.name] = (field.shape({"splat": rows}),)
            if field.name == "harmonics":
                wanted[field.name] = tuple((rows, k, 3) for k in TERMS)
    for name, shape in shapes.items():
        if name.startswith(_ATTRIBUTE):
            fits = len(shape) in (1, 2) and shape[0] == v
            expected = f"({v},) or ({v}, c)"
        else:
            fits = shape in wanted[name]
            expected = " or ".join(str(w) for w in wanted[name])
        if not fits:
            raise FileFormatError(f"{path}: array {name!r} has shape {shape}, expected {expected}")


def _load(archive: zipfile.ZipFile, member: _Member, name: str, path: Path) -> np.ndarray:
    array = np.empty(member.shape[::-1] if member.fortran else member.shape, member.dtype)
    view = memoryview(array.reshape(-1).view(np.uint8).data) if array.size else memoryview(b"")
    with archive.open(member.info) as file:
        file.read(member.header_bytes)
        done = 0
        while done < len(view):
            block = file.read(min(_BLOCK, len(view) - done))
            if not block:
                raise FileFormatError(f"{path}: array {name!r} ends after {done:,} of {len(view):,} bytes")
            view[done : done + len(block)] = block
            done += len(block)
    return array.T if member.fortran else array


def _bytes(size: FileSize) -> int:
    return 28 * len(size.mesh.vertices) + 12 * len(size.mesh.faces) + size.held


CODEC = MeshCodec(lambda content: content.is_archive and not content.is_usd, read_npz, write_npz, _bytes)
