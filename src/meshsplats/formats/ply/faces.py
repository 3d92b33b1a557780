"""The faces of a PLY file as triangles. Files of triangles alone, the usual case, need no loop over faces."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats._polygons import corner_places, cut_polygons
from meshsplats.formats._validation import Budget
from meshsplats.formats.ply.header import Element, PlyHeader, Property

if TYPE_CHECKING:
    from numpy.typing import DTypeLike

_INDEX_NAMES = ("vertex_indices", "vertex_index")


def read_faces(
    file: BinaryIO,
    header: PlyHeader,
    face: Element,
    names: tuple[str, ...],
    points: np.ndarray,
    budget: Budget,
    path: Path,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Triangles (f, 3) of the element ``face``, and its integer properties among ``names``, each (f,)
    int64.

    Polygons are cut by the positions ``points`` (v, 3) of the vertices; points and lines are dropped. Raises
    FileFormatError.
    """
    index = _index(face)
    if face.count == 0:
        return np.empty((0, 3), np.int64), {p.name: np.empty(0, np.int64) for p in _integers(face, names)}
    if index is None or index.dtype.kind not in "iu":
        raise FileFormatError(f"{path}: element 'face' has no list of integers 'vertex_indices'")
    keep = _integers(face, names)
    size = file.seek(0, io.SEEK_END) - header.data_offset
    if face.count > max(size, 0):
        raise FileFormatError(f"{path}: {face.count:,} faces do not fit {max(size, 0):,} bytes (truncated)")
    # Offsets, lengths and corners of mixed polygons take 8 bytes per value.
    budget.spend(size * 8 + 64 * face.count, "the faces")
    file.seek(header.data_offset)
    data = file.read()
    polygons = (_ascii if header.encoding == "ascii" else _binary)(data, header, face, index, keep, path)
    lengths, corners, values = polygons
    cut, owner = cut_polygons(lengths, None if (lengths == 3).all() else corner_places(points, corners))
    return corners[cut], {p.name: v[owner] for p, v in zip(keep, values, strict=True)}


def read_corner_values(
    file: BinaryIO, header: PlyHeader, face: Element, name: str, others: tuple[str, ...], path: Path
) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
    """(f, k) values of the list ``name`` of each triangle, in the order of ``read_faces``, and its integer
    properties among ``others``, each (f,) int64. None unless all faces are triangles with lists of one
    length, in binary. Raises FileFormatError."""
    index = _index(face)
    if header.encoding == "ascii" or face.count == 0 or index is None:
        return None
    file.seek(header.data_offset)
    data = file.read()
    at = _begin(data, header, face, path)
    row = _uniform(data, face, at)
    if row is None:
        return None
    table = np.frombuffer(data, row, face.count, at)
    column = {p.name: table[f"f{i}"] for i, p in enumerate(face.properties)}
    if column[index.name]["items"].shape[1] != 3:
        return None
    numbers = {p.name: column[p.name].astype(np.int64) for p in _integers(face, others)}
    return column[name]["items"], numbers


def _index(face: Element) -> Property | None:
    """The list of the vertices of each face."""
    return next((p for p in face.properties if p.name in _INDEX_NAMES and p.is_list), None)


def _integers(face: Element, names: tuple[str, ...]) -> list[Property]:
    """The integer properties among ``names``."""
    return [p for p in face.properties if p.name in names and not p.is_list and p.dtype.kind in "iu"]


# -- binary


def _binary(
    data: bytes, header: PlyHeader, face: Element, index: Property, keep: list[Property], path: Path
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Length of each polygon, all corners concatenated, and the values of ``keep``."""
    at = _begin(data, header, face, path)
    uniform = _uniform(data, face, at)
    if uniform is not None:
        table = np.frombuffer(data, uniform, face.count, at)
        column = {p.name: table[f"f{i}"] for i, p in enumerate(face.properties)}
        corners = column[index.name]["items"]
        lengths = np.full(face.count, corners.shape[1], np.int64)
        return lengths, corners.reshape(-1), [column[p.name].astype(np.int64) for p in keep]
    starts = np.fromiter(_rows(data, face, at, _order(header), path), np.int64, face.count + 1)
    raw = np.frombuffer(data, np.uint8)
    place = starts[:-1].copy()
    lengths, items, values = np.zeros(face.count, np.int64), np.empty(0, index.dtype), []
    for p in face.properties:
        if p.count_dtype is None:
            if p in keep:
                values.append(_gather(raw, place, p.dtype)[:, 0].astype(np.int64))
            place += p.dtype.itemsize
            continue
        counts = _gather(raw, place, p.count_dtype)[:, 0].astype(np.int64)
        place += p.count_dtype.itemsize
        if p is index:
            lengths = counts
            first = np.cumsum(counts) - counts
            inside = np.arange(int(counts.sum())) - np.repeat(first, counts)
            items = _gather(raw, np.repeat(place, counts) + inside * p.dtype.itemsize, p.dtype)[:, 0]
        place += counts * p.dtype.itemsize
    return lengths, items, values


def _order(header: PlyHeader) -> str:
    """Of bytes, as struct names it."""
    return "<" if header.encoding == "binary_little_endian" else ">"


def _begin(data: bytes, header: PlyHeader, face: Element, path: Path) -> int:
    """Offset of the rows of ``face`` in the data of a binary file."""
    at = 0
    for element in header.elements:
        if element is face:
            break
        if element.has_lists:
            *_, at = _rows(data, element, at, _order(header), path)
        else:
            at += element.count * element.minimum_row_bytes
    return at


def _gather(raw: np.ndarray, places: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """(n, 1) values of ``dtype`` at the byte offsets ``places``."""
    return raw[places[:, None] + np.arange(dtype.itemsize)].view(dtype)


def _uniform(data: bytes, element: Element, at: int) -> np.dtype | None:
    """Row type if the lists of all rows have the lengths of the first row's; None if rows differ or data
    end."""
    fields: list[tuple[str, DTypeLike]] = []
    offset = at
    for i, p in enumerate(element.properties):
        if p.count_dtype is None:
            fields.append((f"f{i}", p.dtype))
            offset += p.dtype.itemsize
            continue
        head = data[offset : offset + p.count_dtype.itemsize]
        count = int(np.frombuffer(head, p.count_dtype)[0]) if len(head) == p.count_dtype.itemsize else -1
        offset += len(head) + count * p.dtype.itemsize
        if count < 0 or offset > len(data):
            return None
        fields.append((f"f{i}", [("count", p.count_dtype), ("items", p.dtype, (count,))]))
    if at + (offset - at) * element.count > len(data) or offset - at > 1 << 30:
        return None
    row = np.dtype(fields)
    table = np.frombuffer(data, row, element.count, at)
    for i, p in enumerate(element.properties):
        if p.is_list and (table[f"f{i}"]["count"] != table[f"f{i}"]["count"][0]).any():
            return None
    return row


def _rows(data: bytes, element: Element, at: int, order: str, path: Path) -> Iterator[int]:
    """Byte offset of each row of ``element``, then the offset after the last one."""
    codes = {("i", 1): "b", ("u", 1): "B", ("i", 2): "h", ("u", 2): "H", ("i", 4): "i", ("u", 4): "I"}
    codes |= {("i", 8): "q", ("u", 8): "Q"}
    steps: list[tuple[int, struct.Struct | None, int]] = []
    for p in element.properties:
        if p.count_dtype is None:
            steps.append((p.dtype.itemsize, None, 0))
        else:
            length = struct.Struct(order + codes[p.count_dtype.kind, p.count_dtype.itemsize])
            steps.append((length.size, length, p.dtype.itemsize))
    end = len(data)
    for row in range(element.count):
        yield at
        for size, code, item in steps:
            if code is not None and at + size <= end:
                count = code.unpack_from(data, at)[0]
                if count < 0:
                    raise FileFormatError(f"{path}: {element.name} {row:,} has a list of length {count}")
                at += count * item
            at += size
        if at > end:
            raise FileFormatError(
                f"{path}: {element.name} {row:,} of {element.count:,} runs past the end of the file"
                " (truncated, or a wrong list length)"
            )
    yield at


# -- ASCII


def _ascii(
    data: bytes, header: PlyHeader, face: Element, index: Property, keep: list[Property], path: Path
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """As ``_binary``: one face per line; blank lines are skipped."""
    lines = [x for x in data.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n") if x.strip()]
    before = header.elements[: header.elements.index(face)]
    first = sum(e.count for e in before)
    lines = lines[first : first + face.count]
    if len(lines) < face.count:
        raise FileFormatError(
            f"{path}: the file ends after {len(lines):,} of {face.count:,} faces (truncated or count wrong)"
        )
    lengths: list[int] = []
    corners: list[int] = []
    values: list[list[int]] = [[] for _ in keep]
    for row, line in enumerate(lines):
        words, at = line.split(), 0
        try:
            for p in face.properties:
                if p.count_dtype is None:
                    if p in keep:
                        values[keep.index(p)].append(int(words[at]))
                    at += 1
                    continue
                count = int(words[at])
                if count < 0 or at + count >= len(words):
                    raise IndexError
                if p is index:
                    lengths.append(count)
                    corners += map(int, words[at + 1 : at + 1 + count])
                at += 1 + count
            if at != len(words):
                raise IndexError
        except (ValueError, IndexError):
            raise FileFormatError(f"{path}: face {row:,} cannot be read: {line[:60]!r}") from None
    limit = np.iinfo(np.int64)
    if any(not limit.min <= x <= limit.max for x in corners) or any(
        not limit.min <= x <= limit.max for v in values for x in v
    ):
        raise FileFormatError(f"{path}: a face holds a number beyond 64 bits")
    return (
        np.array(lengths, np.int64),
        np.array(corners, np.int64),
        [np.array(v, np.int64) for v in values],
    )
