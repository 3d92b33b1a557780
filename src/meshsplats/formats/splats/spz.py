"""SPZ, versions 1 to 4: splats in about 20 bytes, one attribute after the other, compressed.

Versions 1 to 3 are one gzip stream with a header of 16 bytes; version 4 has a header of 32 bytes, optional
extension records, a table of contents and one Zstandard stream for each attribute. x points right, y up, z
back; a record of the extension SPZ_ADOBE_coordinate_system names other axes. Specification: nianticlabs/spz,
README.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import BinaryIO

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats._validation import Budget
from meshsplats.formats.content import Content
from meshsplats.formats.reading import FormatReader, Reading
from meshsplats.formats.splats._cloud_builder import (
    Chunks,
    Fill,
    SplatReader,
    SplatRows,
    decode_smallest_three,
)
from meshsplats.formats.splats._spz_layout import (
    ANTIALIASED,
    COLOR_SCALE,
    MAGIC,
    MAX_EXTENSION_BYTES,
    MAX_HEAD,
    REST,
    Header,
    axes,
    check_end,
    contents,
    parse_header,
    spend,
    warn_of_degree,
    zstandard_modules,
)
from meshsplats.formats.splats._spz_streams import open_streams
from meshsplats.scene.gaussians import Kernel
from meshsplats.scene.origin import SAMPLE

_AT_ONCE = 1 << 16


def _matches(content: Content) -> bool:
    """Whether it begins as SPZ; looks into a gzip stream."""
    head = content.head
    if head[:2] != b"\x1f\x8b":
        return head[:4] == MAGIC
    try:
        return zlib.decompressobj(31).decompress(head, 4) == MAGIC
    except zlib.error:
        return False


def _open(content: Content, file: BinaryIO, reading: Reading) -> SplatReader:
    """The splats of an SPZ file, in blocks without the file in memory; errors as ``load_gaussians``."""
    if not reading.in_blocks or content.member is not None:  # streams are not apart in a zip archive
        return spz_in_memory(file.read(), content.path, Budget(content.path))
    streams = open_streams(content.path)
    header = streams.header
    warn_of_degree(header, content.path)

    def chunks(origin: np.ndarray) -> Iterator[tuple[int, Fill]]:
        for m, part in streams.rows(_AT_ONCE):
            yield m, partial(_fill, header, part, origin)

    def positions() -> np.ndarray:
        return _positions(streams.positions(_AT_ONCE), header)

    return _reader(header, streams.extensions, content.path, chunks, positions, streams.close)


def spz_in_memory(data: bytes | memoryview, where: object, budget: Budget) -> SplatReader:
    """The splats of a whole SPZ file in memory; errors as ``load_gaussians``."""
    if bytes(data[:4]) == MAGIC:
        header, extensions, streams = _parse_streams(data, where, budget)
    else:
        header, extensions, streams = _parse_gzip(data, where, budget)
    warn_of_degree(header, where)

    def chunks(origin: np.ndarray) -> Iterator[tuple[int, Fill]]:
        for start in range(0, header.splats, _AT_ONCE):
            m = min(_AT_ONCE, header.splats - start)
            part = {name: a.reshape(header.splats, -1)[start : start + m] for name, a in streams.items()}
            yield m, partial(_fill, header, part, origin)

    def positions() -> np.ndarray:
        rows = streams["positions"].reshape(header.splats, -1)[:: max(1, header.splats // SAMPLE)]
        return _positions(rows, header)

    return _reader(header, extensions, where, chunks, positions)


def _reader(
    header: Header,
    extensions: bytes,
    where: object,
    chunks: Chunks,
    positions: Callable[[], np.ndarray],
    close: Callable[[], None] = lambda: None,
) -> SplatReader:
    kernel: Kernel = "antialiased" if header.flags & ANTIALIASED else "3dgs"
    return SplatReader(
        header.splats,
        1 + REST[min(header.degree, 3)],
        kernel,
        where,
        chunks,
        positions,
        float32=False,
        to_y_down=axes(extensions, where),
        close_files=close,
    )


def _fill(header: Header, part: dict[str, np.ndarray], origin: np.ndarray, rows: SplatRows) -> None:
    """Writes m splats of ``part``, (m, bytes) of each attribute."""
    rows.means[:] = _positions(part["positions"], header) - origin
    rows.opacities[:] = part["alphas"][:, 0] / np.float32(255)
    rows.sh[:, 0] = (part["colors"] / np.float32(255) - np.float32(0.5)) / np.float32(COLOR_SCALE)
    rows.scales[:] = np.exp(part["scales"] / np.float32(16) - np.float32(10))
    _fill_rotations(rows.quaternions, part["rotations"])
    degree = min(header.degree, 3)
    if degree:
        rest = part["sh"].reshape(len(rows.means), -1, 3)[:, : REST[degree]]
        rows.sh[:, 1:] = (rest - np.float32(128)) / np.float32(128)


def _parse_gzip(
    data: bytes | memoryview, where: object, budget: Budget
) -> tuple[Header, bytes, dict[str, np.ndarray]]:
    """Parses versions 1 to 3. Unpacks no more than the header promises."""
    stream = zlib.decompressobj(31)
    try:
        raw = stream.decompress(data, 16)
        if len(raw) < 16:
            raise FileFormatError(f"{where}: truncated SPZ header of {len(raw)} bytes")
        header = parse_header(raw, range(1, 4), where)
        spend(header, where, budget)
        sizes = header.sizes()
        wanted = sum(sizes.values())
        body = stream.decompress(stream.unconsumed_tail, wanted + MAX_EXTENSION_BYTES)
    except zlib.error as error:
        raise FileFormatError(f"{where}: the gzip stream is broken: {error}") from None
    extensions = body[wanted:]
    check_end(header, min(len(body), wanted), extensions, stream.eof, where)
    streams, at = {}, 0
    for name, size in sizes.items():
        streams[name] = np.frombuffer(body, np.uint8, size, at)
        at += size
    return header, extensions, streams


def _parse_streams(
    data: bytes | memoryview, where: object, budget: Budget
) -> tuple[Header, bytes, dict[str, np.ndarray]]:
    """Parses version 4."""
    header, extensions, table = contents(data[:MAX_HEAD], len(data), where, budget)
    streams = {}
    for name, (at, packed, size) in table.items():
        streams[name] = np.frombuffer(_unzstd(bytes(data[at : at + packed]), size, name, where), np.uint8)
    return header, extensions, {"sh": np.empty(0, np.uint8), **streams}


def _unzstd(packed: bytes, size: int, name: str, where: object) -> bytes:
    """Exactly ``size`` bytes of a Zstandard frame."""
    own, package = zstandard_modules(where)
    try:
        if own is not None:
            out = own.ZstdDecompressor().decompress(packed, max_length=size + 1)
        else:
            out = package.ZstdDecompressor(max_window_size=1 << 27).stream_reader(packed).read(size + 1)
    except ((own or package).ZstdError, MemoryError) as error:
        raise FileFormatError(f"{where}: the stream of {name} is broken: {error}") from None
    if len(out) != size:
        raise FileFormatError(f"{where}: the stream of {name} does not unpack to {size:,} bytes")
    return out


def _positions(stored: np.ndarray, header: Header) -> np.ndarray:
    """(m, 3) float64 from 24-bit fixed-point numbers, of version 1 from half floats."""
    if header.version == 1:
        return np.ascontiguousarray(stored).view("<f2").astype(np.float64)
    words = np.zeros((len(stored), 3, 4), np.uint8)
    words[..., 1:] = stored.reshape(-1, 3, 3)
    fixed = words.view("<i4")[..., 0] >> 8  # shifted down from the upper bytes, which extends the sign
    return np.asarray(fixed * 2.0**-header.fraction_bits)


def _fill_rotations(out: np.ndarray, stored: np.ndarray) -> None:
    """Quaternions w, x, y, z from x, y, z in bytes, or from the smallest three in 10 bits each (versions 3
    and 4).
    """
    if stored.shape[1] == 3:
        xyz = stored / np.float32(127.5) - 1
        out[:, 1:] = xyz
        out[:, 0] = np.sqrt(np.maximum(0, 1 - np.einsum("ij,ij->i", xyz, xyz)))
        return
    words = np.ascontiguousarray(stored).view("<u4")[:, 0]
    small = np.empty((len(words), 3), np.float32)
    for i in range(3):
        field = words >> np.uint32(10 * (2 - i))
        small[:, i] = (field & 511) / np.float32(511 * np.sqrt(2))
        np.negative(small[:, i], out=small[:, i], where=(field & 512) > 0)
    xyzw = np.empty((len(words), 4), np.float32)
    decode_smallest_three(xyzw, small, words >> np.uint32(30))
    out[:] = xyzw[:, [3, 0, 1, 2]]


READER = FormatReader(_matches, _open)
