"""PlayCanvas compressed .ply: 16 bytes per splat, in chunks of 256 that share the range of their values.

Element ``chunk`` holds the ranges, ``vertex`` four 32-bit words per splat, ``sh`` (optional) one byte for
each f_rest coefficient. Positions and log scales have 11, 10, 11 bits, rotations 2 + 3 x 10, colours and
opacity 8. Specification: developer.playcanvas.com, "Compressed PLY".
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import BinaryIO

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats.content import Content
from meshsplats.formats.ply.header import Element, PlyHeader, origin_of_comments
from meshsplats.formats.ply.notes import is_linear, kernel_of_comments, up_in, up_of
from meshsplats.formats.ply.table import RowReader
from meshsplats.formats.reading import FormatReader, Reading
from meshsplats.formats.splats._cloud_builder import Fill, SplatReader, SplatRows, decode_smallest_three
from meshsplats.scene.gaussians import constant_harmonics
from meshsplats.scene.origin import SAMPLE

_SHARED = 256
"""Splats that share a chunk's ranges."""
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_CHUNKS_AT_ONCE = 128
_TYPES = {"u4": "uint", "f4": "float", "u1": "uchar"}
# A byte of a spherical harmonic means the middle of its step of 1/32 in [-4, 4]; 0 and 255 mean the ends.
_COEFFICIENTS = (np.concatenate([[0], (np.arange(1, 255) + 0.5) / 256, [1]]) * 8 - 4).astype(np.float32)


def is_compressed_splat(header: PlyHeader) -> bool:
    """Whether the vertex element holds packed splats."""
    vertex = header.element("vertex")
    return vertex is not None and "packed_position" in vertex.names


def _open(content: Content, file: BinaryIO, _: Reading) -> SplatReader:
    """The splats of an opened compressed .ply; errors as ``load_gaussians``."""
    header, where = content.ply_header, content.path
    if header.encoding == "ascii":
        raise FileFormatError(f"{where}: compressed splats must be binary, this .ply is ASCII")
    vertex, chunk, sh = header.element("vertex"), header.element("chunk"), header.element("sh")
    if vertex is None or chunk is None:
        raise FileFormatError(f"{where}: packed splats without the element 'chunk' that holds their ranges")
    _require(vertex, _PACKED, "u4", where)
    names = [f"{end}_{kind}{axis}" for kind in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    colored = "min_r" in chunk.names
    if colored:
        names += [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
    _require(chunk, names, "f4", where)
    if chunk.count != -(-vertex.count // _SHARED):
        raise FileFormatError(
            f"{where}: {vertex.count:,} splats need {-(-vertex.count // _SHARED):,} chunks of {_SHARED},"
            f" the header declares {chunk.count:,}"
        )
    rest = 0
    if sh is not None:
        rest = len(sh.properties)
        if rest not in (0, 9, 24, 45):
            raise FileFormatError(f"{where}: element 'sh' has {rest} properties, expected 0, 9, 24 or 45")
        _require(sh, [f"f_rest_{i}" for i in range(rest)], "u1", where)
        if sh.count != vertex.count:
            raise FileFormatError(f"{where}: {sh.count:,} rows of element 'sh' for {vertex.count:,} splats")
    if not rest:
        sh = None  # gsplat's exporter names the element without properties for splats of degree 0
    readers = {e.name: RowReader(file, header, e, where) for e in (vertex, chunk, sh) if e is not None}
    kernel = kernel_of_comments(header.comments)
    return SplatReader(
        vertex.count,
        1 + rest // 3,
        kernel,
        where,
        partial(_chunks, readers, chunk.count, vertex.count),
        partial(_corners, readers["chunk"]),
        origin=origin_of_comments(header.comments, where),
        up=up_of(file, header, where),
        linear=is_linear(file, header, where),
    )


def _corners(chunks: RowReader) -> np.ndarray:
    """(k, 3) float64: the least and the greatest corner of every so many-th chunk."""
    step = max(1, 2 * len(chunks) // SAMPLE)
    starts = range(0, len(chunks), _CHUNKS_AT_ONCE)
    parts = [chunks.rows(start, min(_CHUNKS_AT_ONCE, len(chunks) - start))[::step] for start in starts]
    ends = [np.stack([p[f"{end}_{axis}"] for axis in "xyz"], axis=1) for p in parts for end in ("min", "max")]
    return np.concatenate([np.empty((0, 3)), *ends])


def _chunks(
    readers: dict[str, RowReader], chunks: int, count: int, origin: np.ndarray
) -> Iterator[tuple[int, Fill]]:
    for first in range(0, chunks, _CHUNKS_AT_ONCE):
        n_chunks = min(_CHUNKS_AT_ONCE, chunks - first)
        start = first * _SHARED
        m = min(n_chunks * _SHARED, count - start)
        ranges = readers["chunk"].rows(first, n_chunks)
        packed = readers["vertex"].rows(start, m)
        table = readers["sh"].rows(start, m) if "sh" in readers else None
        yield m, partial(_fill, ranges, packed, table, origin)


def _fill(
    ranges: np.ndarray, packed: np.ndarray, table: np.ndarray | None, origin: np.ndarray, rows: SplatRows
) -> None:
    m = len(packed)
    of_splat = np.arange(m) // _SHARED

    def end(name: str, axes: str) -> np.ndarray:
        return np.stack([ranges[name + axis] for axis in axes], axis=1).astype(np.float32)

    def between(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
        return a[of_splat] * (1 - t) + b[of_splat] * t

    def lerp(low: str, axes: str, t: np.ndarray) -> np.ndarray:
        return between(end("min_" + low, axes), end("max_" + low, axes), t)

    color = _unpacked(packed["packed_color"], (8, 8, 8, 8))
    colored = "min_r" in (ranges.dtype.names or ())
    with np.errstate(over="ignore", invalid="ignore"):
        corners = end("min_", "xyz"), end("max_", "xyz")
        if origin.any():
            corners = corners[0] - origin, corners[1] - origin
        rows.means[:] = between(*corners, _unpacked(packed["packed_position"], (11, 10, 11)))
        rows.scales[:] = np.exp(lerp("scale_", "xyz", _unpacked(packed["packed_scale"], (11, 10, 11))))
        rgb = lerp("", "rgb", color[:, :3]) if colored else color[:, :3]
        rows.sh[:, 0] = constant_harmonics(rgb)
    rows.opacities[:] = color[:, 3]
    turns = packed["packed_rotation"]
    small = (_unpacked(turns << np.uint32(2), (10, 10, 10)) - np.float32(0.5)) * np.float32(np.sqrt(2))
    decode_smallest_three(rows.quaternions, small, turns >> np.uint32(30))
    if table is not None:
        stored = np.stack([table[f"f_rest_{i}"] for i in range(len(table.dtype.names or ()))], axis=1)
        rows.sh[:, 1:] = _COEFFICIENTS[stored].reshape(m, 3, -1).transpose(0, 2, 1)


def _unpacked(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """(m, len(bits)) float32 in [0, 1]: fields of 32-bit words, the highest bits first."""
    out = np.empty((len(words), len(bits)), np.float32)
    left = 32
    for i, width in enumerate(bits):
        left -= width
        largest = (1 << width) - 1
        out[:, i] = ((words >> np.uint32(left)) & np.uint32(largest)) / np.float32(largest)
    return out


def _require(element: Element, names: Sequence[str], kind: str, where: object) -> None:
    """Raises FileFormatError unless ``element`` has properties ``names``, single values of type ``kind``."""
    found = {p.name: p.dtype for p in element.properties if not p.is_list}
    for name in names:
        if name not in found or found[name].newbyteorder("=") != np.dtype(kind):
            raise FileFormatError(
                f"{where}: compressed splats need the property {name!r} of type {_TYPES[kind]} in element"
                f" {element.name!r}"
            )


def _matches(content: Content) -> bool:
    return content.is_ply and is_compressed_splat(content.ply_header)


READER = FormatReader(_matches, _open, up=up_in)
