"""SPZ, versions 1 to 4: splats in about 20 bytes, one attribute after the other, compressed.

Versions 1 to 3 are one gzip stream with a header of 16 bytes; version 4 has a header of 32 bytes, optional
extension records, a table of contents and one Zstandard stream for each attribute. x points right, y up, z
back; a record of the extension SPZ_ADOBE_coordinate_system names other axes. Specification: nianticlabs/spz,
README.
"""

from __future__ import annotations

import importlib
import io
import struct
import sys
import warnings
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from meshsplats._origin import SAMPLE
from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError
from meshsplats.formats._validation import Budget
from meshsplats.formats.splats._cloud_builder import (
    Chunks,
    Fill,
    SplatReader,
    SplatRows,
    decode_smallest_three,
)
from meshsplats.gaussians import GaussianCloud, Kernel

MAGIC = b"NGSP"
_COLOR_SCALE = 0.15
"""Colours are stored as 0.5 + 0.15 f_dc, which leaves room beyond [0, 1]."""
_REST = (0, 3, 8, 15, 24)
"""Coefficients per channel beyond the first, by degree."""
_ANTIALIASED, _EXTENDED, _TREE = 1, 2, 128
_COORDINATE_SYSTEM = 0xADBE0003
_SYSTEMS = ["RUB", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"]
_SYSTEMS += ["LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"]
"""Directions of x, y and z by the code in the extension; 0 keeps the default of the format."""
_DIRECTIONS = {
    "R": (1, 0, 0),
    "L": (-1, 0, 0),
    "D": (0, 1, 0),
    "U": (0, -1, 0),
    "F": (0, 0, 1),
    "B": (0, 0, -1),
}
_MAX_EXTENSION_BYTES = 1 << 20
_MAX_HEAD = 32 + _MAX_EXTENSION_BYTES + 16 * 255
"""Bytes before the streams of version 4."""
_PIECE = 1 << 18
"""Bytes of a file that are unpacked at a time."""
_AT_ONCE = 1 << 16


class SpzSplats(NamedTuple):
    """The splats in the axes of the file."""

    cloud: GaussianCloud
    to_y_down: np.ndarray
    """(3, 3) map from the file's axes to x right, y down, z forward; a mirror where the file is left-handed.
    """


class _Header(NamedTuple):
    version: int
    splats: int
    degree: int
    fraction_bits: int
    flags: int

    def sizes(self) -> dict[str, int]:
        """Bytes of each attribute, in file order."""
        position = 6 if self.version == 1 else 9
        rotation = 4 if self.version >= 3 else 3
        per_splat = {"positions": position, "alphas": 1, "colors": 3, "scales": 3, "rotations": rotation}
        per_splat["sh"] = 3 * _REST[self.degree]
        return {name: size * self.splats for name, size in per_splat.items()}


def is_spz(head: bytes) -> bool:
    """Whether a file that begins with these bytes is SPZ; looks into a gzip stream."""
    if head[:2] != b"\x1f\x8b":
        return head[:4] == MAGIC
    try:
        return zlib.decompressobj(31).decompress(head, 4) == MAGIC
    except zlib.error:
        return False


def read_spz(
    data: bytes | memoryview,
    where: object,
    budget: Budget,
    *,
    strict: bool,
    origin: np.ndarray | None = None,
) -> SpzSplats:
    """The splats of a whole SPZ file in memory, relative to ``origin``, by default one that suits them;
    errors as ``load_gaussians``. Origins are in the axes that the arrays of the result have."""
    if bytes(data[:4]) == MAGIC:
        header, extensions, streams = _parse_streams(data, where, budget)
    else:
        header, extensions, streams = _parse_gzip(data, where, budget)
    _warn_of_degree(header, where)

    def chunks(origin: np.ndarray) -> Iterator[tuple[int, Fill]]:
        for start in range(0, header.splats, _AT_ONCE):
            m = min(_AT_ONCE, header.splats - start)
            part = {name: a.reshape(header.splats, -1)[start : start + m] for name, a in streams.items()}
            yield m, partial(_fill, header, part, origin)

    def positions() -> np.ndarray:
        rows = streams["positions"].reshape(header.splats, -1)[:: max(1, header.splats // SAMPLE)]
        return _positions(rows, header)

    cloud = _reader(header, where, chunks, positions).read(strict=strict, origin=origin)
    return SpzSplats(cloud, _axes(extensions, where))


def _reader(
    header: _Header, where: object, chunks: Chunks, positions: Callable[[], np.ndarray]
) -> SplatReader:
    kernel: Kernel = "antialiased" if header.flags & _ANTIALIASED else "3dgs"
    coefficients = 1 + _REST[min(header.degree, 3)]
    return SplatReader(header.splats, coefficients, kernel, where, chunks, positions, float32=False)


def _fill(header: _Header, part: dict[str, np.ndarray], origin: np.ndarray, rows: SplatRows) -> None:
    """Writes m splats of ``part``, (m, bytes) of each attribute."""
    rows.means[:] = _positions(part["positions"], header) - origin
    rows.opacities[:] = part["alphas"][:, 0] / np.float32(255)
    rows.sh[:, 0] = (part["colors"] / np.float32(255) - np.float32(0.5)) / np.float32(_COLOR_SCALE)
    rows.scales[:] = np.exp(part["scales"] / np.float32(16) - np.float32(10))
    _fill_rotations(rows.quaternions, part["rotations"])
    degree = min(header.degree, 3)
    if degree:
        rest = part["sh"].reshape(len(rows.means), -1, 3)[:, : _REST[degree]]
        rows.sh[:, 1:] = (rest - np.float32(128)) / np.float32(128)


class OpenedSpz(NamedTuple):
    """An SPZ file whose splats are read in the axes of the file, and its ``SpzSplats.to_y_down``."""

    reader: SplatReader
    to_y_down: np.ndarray
    close: Callable[[], None]
    """Closes the file, where the splats are not read."""


def open_spz(path: Path) -> OpenedSpz:
    """The splats of the SPZ file ``path`` without the file in memory; errors as ``load_gaussians``.

    Its attributes lie one after the other, each of all splats: they are unpacked side by side. Versions 1 to
    3 are one stream, which is unpacked twice: the first time to find where the attributes begin.
    """
    with open(path, "rb") as file:
        plain = file.read(4) == MAGIC
        file.seek(0)
        if not plain:
            header, extensions, streams = _gzip_streams(path, file)
        else:
            length = file.seek(0, io.SEEK_END)
            file.seek(0)
            header, extensions, table = _contents(file.read(_MAX_HEAD), length, path)
            streams = {name: _zstd_stream(path, at, packed) for name, (at, packed, _) in table.items()}
    _warn_of_degree(header, path)
    if not header.degree and "sh" in streams:
        streams.pop("sh").close()
    again = streams["positions"].again if not plain else partial(_zstd_stream, path, *table["positions"][:2])
    chunks = partial(_side_by_side, header, streams, path)
    reader = _reader(header, path, chunks, partial(_sample, header, again, path))
    return OpenedSpz(reader, _axes(extensions, path), partial(_close, streams))


def _sample(header: _Header, open_positions: Callable[[], Any], where: object) -> np.ndarray:
    """Every so many-th position, as of ``read_spz``, by a pass over the stream of positions alone."""
    width, step = header.sizes()["positions"] // max(header.splats, 1), max(1, header.splats // SAMPLE)
    found = [np.empty((0, width), np.uint8)]
    stream = open_positions()
    try:
        for start in range(0, header.splats, _AT_ONCE):
            m = min(_AT_ONCE, header.splats - start)
            rows = np.frombuffer(_exactly(stream, m * width, "positions", where), np.uint8).reshape(m, width)
            found.append(rows[-start % step :: step].copy())
    finally:
        stream.close()
    return _positions(np.concatenate(found), header)


def _side_by_side(
    header: _Header, streams: dict[str, Any], where: object, origin: np.ndarray
) -> Iterator[tuple[int, Fill]]:
    width = {name: size // max(header.splats, 1) for name, size in header.sizes().items()}
    try:
        for start in range(0, header.splats, _AT_ONCE):
            m = min(_AT_ONCE, header.splats - start)
            part = {
                name: np.frombuffer(_exactly(stream, m * width[name], name, where), np.uint8).reshape(m, -1)
                for name, stream in streams.items()
            }
            yield m, partial(_fill, header, part, origin)
        for name, stream in streams.items():
            # At the end of a Zstandard frame stands its checksum; gzip's was checked by the first pass.
            if isinstance(stream, _Inflater):
                continue
            if _exactly(stream, 1, name, where, optional=True):
                raise FileFormatError(f"{where}: the stream of {name} is longer than its header says")
    finally:
        _close(streams)


class _Inflater:
    """A gzip stream that begins somewhere in a file: unpacks as much as is read."""

    def __init__(self, file: BinaryIO, decompressor: Any, rest: bytes = b"") -> None:
        self._file, self._decompressor, self._rest = file, decompressor, rest

    def read(self, most: int) -> bytes:
        """Up to ``most`` bytes; none at the end. zlib.error for a broken stream."""
        found = b""
        while not found and not self._decompressor.eof:
            packed = self._rest or self._file.read(_PIECE)
            found = self._decompressor.decompress(packed, most)
            self._rest = self._decompressor.unconsumed_tail
            if not packed:
                break
        return found

    @property
    def complete(self) -> bool:
        return bool(self._decompressor.eof)

    def again(self) -> _Inflater:
        """Another reader of the same file that goes on from here."""
        file = open(self._file.name, "rb")  # noqa: SIM115 (closed by close)
        file.seek(self._file.tell())
        return _Inflater(file, self._decompressor.copy(), self._rest)

    def close(self) -> None:
        self._file.close()


class _Frame(io.RawIOBase):
    """The packed bytes of one Zstandard frame of a file."""

    def __init__(self, path: Path, at: int, length: int) -> None:
        self._file, self._left = open(path, "rb"), length  # noqa: SIM115 (closed by close)
        self._file.seek(at)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        found = self._file.read(min(len(buffer), self._left))
        self._left -= len(found)
        buffer[: len(found)] = found
        return len(found)

    def close(self) -> None:
        self._file.close()
        super().close()


def _exactly(stream: Any, count: int, name: str, where: object, *, optional: bool = False) -> bytes:
    """``count`` bytes of the unpacked ``stream`` of an attribute; none at its end, if ``optional``."""
    parts, missing = [], count
    errors: tuple[type[BaseException], ...] = (EOFError, MemoryError, *_unpacking_errors())
    while missing:
        try:
            found = stream.read(min(missing, _PIECE))
        except errors as error:
            raise FileFormatError(f"{where}: the stream of {name} is broken: {str(error)[:100]}") from None
        if not found and optional:
            break
        if not found:
            raise FileFormatError(f"{where}: the stream of {name} is truncated")
        parts.append(found)
        missing -= len(found)
    return b"".join(parts)


def _gzip_streams(path: Path, file: BinaryIO) -> tuple[_Header, bytes, dict[str, Any]]:
    """Unpacks versions 1 to 3 once, without keeping them: header, extensions, and a stream for each
    attribute."""
    source = _Inflater(file, zlib.decompressobj(31))
    streams: dict[str, Any] = {}
    try:
        raw = b""
        while len(raw) < 16 and (more := source.read(16 - len(raw))):
            raw += more
        if len(raw) < 16:
            raise FileFormatError(f"{path}: truncated SPZ header of {len(raw)} bytes")
        header = _header(raw, range(1, 4), path)
        done = 0
        for name, size in header.sizes().items():
            streams[name] = source.again()
            left = size
            while left and (more := source.read(min(left, _PIECE))):
                left -= len(more)
            done += size - left
        extensions = b""
        while len(extensions) <= _MAX_EXTENSION_BYTES and (more := source.read(_PIECE)):
            extensions += more
        _check_end(header, done, extensions, source.complete, path)
    except BaseException as error:
        _close(streams)
        if isinstance(error, zlib.error):
            raise FileFormatError(f"{path}: the gzip stream is broken: {error}") from None
        raise
    return header, extensions, streams


def _close(streams: dict[str, Any]) -> None:
    for stream in streams.values():
        stream.close()


def _check_end(header: _Header, found: int, extensions: bytes, complete: bool, where: object) -> None:
    """Refuses a stream that does not have the length that the header promises."""
    wanted = sum(header.sizes().values())
    if found < wanted or not complete:
        problem = "truncated" if found < wanted else "longer than its header says"
        raise FileFormatError(
            f"{where}: {problem}: {header.splats:,} splats take {wanted:,} bytes, the stream gave"
            f" {found + len(extensions):,}"
        )
    if extensions and not header.flags & _EXTENDED:
        what = "; those of Spark's level-of-detail tree, which is not read" if header.flags & _TREE else ""
        raise FileFormatError(f"{where}: {len(extensions):,} bytes follow the {header.splats:,} splats{what}")


def _header(raw: bytes, versions: range, where: object) -> _Header:
    magic, version, count, degree, fraction_bits, flags, _ = struct.unpack("<4sIIBBBB", raw)
    if magic != MAGIC:
        raise FileFormatError(f"{where}: no SPZ header, it begins with {magic!r}")
    if version not in versions:
        known = f"{versions[0]} to {versions[-1]}" if len(versions) > 1 else str(versions[0])
        if versions[0] == 4 and version in range(1, 4):
            raise FileFormatError(f"{where}: SPZ of version {version} that is not gzipped, as it must be")
        raise FileFormatError(f"{where}: SPZ version {version} in a container of version {known}")
    if degree >= len(_REST):
        raise FileFormatError(f"{where}: SPZ harmonics of degree {degree}, expected 0 to 4")
    if fraction_bits > 30:
        raise FileFormatError(
            f"{where}: SPZ positions with {fraction_bits} fractional bits, expected 0 to 30"
        )
    return _Header(version, count, degree, fraction_bits, flags)


def _warn_of_degree(header: _Header, where: object) -> None:
    if header.degree > 3:
        warnings.warn(
            f"{where}: spherical harmonics of degree {header.degree}; those beyond degree 3 are left out",
            DataWarning,
            stacklevel=5,
        )


def _spend(header: _Header, where: object, budget: Budget) -> None:
    memory = 4 * (11 + 3 * (1 + _REST[min(header.degree, 3)]))
    budget.spend(sum(header.sizes().values()) + header.splats * memory, f"its {header.splats:,} splats")


def _parse_gzip(
    data: bytes | memoryview, where: object, budget: Budget
) -> tuple[_Header, bytes, dict[str, np.ndarray]]:
    """Parses versions 1 to 3. Unpacks no more than the header promises."""
    stream = zlib.decompressobj(31)
    try:
        raw = stream.decompress(data, 16)
        if len(raw) < 16:
            raise FileFormatError(f"{where}: truncated SPZ header of {len(raw)} bytes")
        header = _header(raw, range(1, 4), where)
        _spend(header, where, budget)
        sizes = header.sizes()
        wanted = sum(sizes.values())
        body = stream.decompress(stream.unconsumed_tail, wanted + _MAX_EXTENSION_BYTES)
    except zlib.error as error:
        raise FileFormatError(f"{where}: the gzip stream is broken: {error}") from None
    extensions = body[wanted:]
    _check_end(header, min(len(body), wanted), extensions, stream.eof, where)
    streams, at = {}, 0
    for name, size in sizes.items():
        streams[name] = np.frombuffer(body, np.uint8, size, at)
        at += size
    return header, extensions, streams


def _parse_streams(
    data: bytes | memoryview, where: object, budget: Budget
) -> tuple[_Header, bytes, dict[str, np.ndarray]]:
    """Parses version 4."""
    header, extensions, table = _contents(data[:_MAX_HEAD], len(data), where, budget)
    streams = {}
    for name, (at, packed, size) in table.items():
        streams[name] = np.frombuffer(_unzstd(bytes(data[at : at + packed]), size, name, where), np.uint8)
    return header, extensions, {"sh": np.empty(0, np.uint8), **streams}


def _contents(
    head: bytes | memoryview, length: int, where: object, budget: Budget | None = None
) -> tuple[_Header, bytes, dict[str, tuple[int, int, int]]]:
    """Header, extensions, and place, length and unpacked length of each stream of a file of ``length`` bytes
    that begins with ``head``. The splats are taken from the ``budget`` before the streams are looked at."""
    if len(head) < 32:
        raise FileFormatError(f"{where}: truncated SPZ header of {len(head)} bytes")
    header = _header(bytes(head[:16]), range(4, 5), where)
    sizes = {name: size for name, size in header.sizes().items() if size}
    n_streams = head[15]
    (table,) = struct.unpack_from("<I", head, 16)
    at = table + 16 * n_streams
    if n_streams != len(sizes) or table < 32 or at > len(head):
        raise FileFormatError(
            f"{where}: an SPZ table of {n_streams} streams at byte {table:,}; {len(sizes)} streams are needed"
            f" and the file has {length:,} bytes"
        )
    if budget is not None:
        _spend(header, where, budget)
    found = {}
    for i, (name, size) in enumerate(sizes.items()):
        packed, unpacked = struct.unpack_from("<QQ", head, table + 16 * i)
        if unpacked != size or packed > length - at:
            raise FileFormatError(
                f"{where}: the stream of {name} has {packed:,} bytes for {unpacked:,}; {size:,} are needed,"
                f" {length - at:,} are left in the file"
            )
        found[name] = (at, packed, size)
        at += packed
    if at != length:
        raise FileFormatError(f"{where}: {length - at:,} bytes follow the last SPZ stream")
    extensions = bytes(head[32:table]) if header.flags & _EXTENDED else b""
    return header, extensions, found


def _zstd_stream(path: Path, at: int, length: int) -> Any:
    """The unpacked bytes of the Zstandard frame at a place of the file, as a file to be read."""
    own, package = _zstandard(path)
    if own is not None:
        return own.ZstdFile(_Frame(path, at, length))
    decompressor = package.ZstdDecompressor(max_window_size=1 << 27)
    return decompressor.stream_reader(_Frame(path, at, length), closefd=True)


def _zstandard(where: object) -> tuple[Any, Any]:
    """The module of Python 3.14 and None, or else None and the package. MissingDependencyError without."""
    try:
        return importlib.import_module("compression.zstd"), None
    except ImportError:
        pass
    try:
        return None, importlib.import_module("zstandard")
    except ImportError:
        raise MissingDependencyError(
            f"{where}: SPZ version 4 needs the extra 'formats': pip install zstandard"
        ) from None


def _unpacking_errors() -> tuple[type[Exception], ...]:
    """The errors of zlib, and of the modules for Zstandard that have been imported."""
    loaded = [sys.modules.get(name) for name in ("compression.zstd", "zstandard")]
    return (zlib.error, *(module.ZstdError for module in loaded if module is not None))


def _unzstd(packed: bytes, size: int, name: str, where: object) -> bytes:
    """Exactly ``size`` bytes of a Zstandard frame."""
    own, package = _zstandard(where)
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


def _positions(stored: np.ndarray, header: _Header) -> np.ndarray:
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


def _axes(extensions: bytes, where: object) -> np.ndarray:
    """Map from the axes that an extension names, or the format's own, to x right, y down, z forward."""
    system, at = 0, 0
    while at + 8 <= len(extensions):
        kind, length = struct.unpack_from("<II", extensions, at)
        if kind == _COORDINATE_SYSTEM and length >= 4 and at + 12 <= len(extensions):
            (system,) = struct.unpack_from("<I", extensions, at + 8)
            if system >= len(_SYSTEMS):
                raise FileFormatError(f"{where}: unknown SPZ coordinate system {system}")
        at += 8 + length
    return np.array([_DIRECTIONS[letter] for letter in _SYSTEMS[system]], np.float64).T
