"""SPZ, versions 1 to 4: splats in about 20 bytes, one attribute after the other, compressed.

Versions 1 to 3 are one gzip stream with a header of 16 bytes; version 4 has a header of 32 bytes, optional
extension records, a table of contents and one Zstandard stream for each attribute. x points right, y up, z
back; a record of the extension SPZ_ADOBE_coordinate_system names other axes. Specification: nianticlabs/spz,
README.
"""

from __future__ import annotations

import importlib
import struct
import warnings
import zlib
from typing import NamedTuple

import numpy as np

from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError
from meshsplats.formats._validation import Budget
from meshsplats.formats.splats._cloud_builder import CloudBuilder, decode_smallest_three
from meshsplats.gaussians import GaussianCloud

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


def read_spz(data: bytes | memoryview, where: object, budget: Budget, *, strict: bool) -> SpzSplats:
    """The splats of a whole SPZ file in memory; errors as ``load_gaussians``."""
    if bytes(data[:4]) == MAGIC:
        header, extensions, streams = _parse_streams(data, where, budget)
    else:
        header, extensions, streams = _parse_gzip(data, where, budget)
    degree = min(header.degree, 3)
    if header.degree > 3:
        warnings.warn(
            f"{where}: spherical harmonics of degree {header.degree}; those beyond degree 3 are left out",
            DataWarning,
            stacklevel=4,
        )
    builder = CloudBuilder(header.splats, 1 + _REST[degree], where)
    for start in range(0, header.splats, _AT_ONCE):
        m = min(_AT_ONCE, header.splats - start)
        part = {name: a.reshape(header.splats, -1)[start : start + m] for name, a in streams.items()}
        rows = builder.next(m)
        rows.means[:] = _positions(part["positions"], header)
        rows.opacities[:] = part["alphas"][:, 0] / np.float32(255)
        rows.sh[:, 0] = (part["colors"] / np.float32(255) - np.float32(0.5)) / np.float32(_COLOR_SCALE)
        rows.scales[:] = np.exp(part["scales"] / np.float32(16) - np.float32(10))
        _fill_rotations(rows.quaternions, part["rotations"])
        if degree:
            rest = part["sh"].reshape(m, -1, 3)[:, : _REST[degree]]
            rows.sh[:, 1:] = (rest - np.float32(128)) / np.float32(128)
        builder.keep(rows)
    cloud = builder.finish("antialiased" if header.flags & _ANTIALIASED else "3dgs", strict=strict)
    return SpzSplats(cloud, _axes(extensions, where))


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
    if len(body) < wanted or not stream.eof:
        problem = "truncated" if len(body) < wanted else "longer than its header says"
        raise FileFormatError(
            f"{where}: {problem}: {header.splats:,} splats take {wanted:,} bytes, the stream gave"
            f" {len(body):,}"
        )
    extensions = body[wanted:]
    if extensions and not header.flags & _EXTENDED:
        what = "; those of Spark's level-of-detail tree, which is not read" if header.flags & _TREE else ""
        raise FileFormatError(f"{where}: {len(extensions):,} bytes follow the {header.splats:,} splats{what}")
    streams, at = {}, 0
    for name, size in sizes.items():
        streams[name] = np.frombuffer(body, np.uint8, size, at)
        at += size
    return header, extensions, streams


def _parse_streams(
    data: bytes | memoryview, where: object, budget: Budget
) -> tuple[_Header, bytes, dict[str, np.ndarray]]:
    """Parses version 4."""
    if len(data) < 32:
        raise FileFormatError(f"{where}: truncated SPZ header of {len(data)} bytes")
    header = _header(bytes(data[:16]), range(4, 5), where)
    sizes = {name: size for name, size in header.sizes().items() if size}
    n_streams = data[15]
    (table,) = struct.unpack_from("<I", data, 16)
    at = table + 16 * n_streams
    if n_streams != len(sizes) or table < 32 or at > len(data):
        raise FileFormatError(
            f"{where}: an SPZ table of {n_streams} streams at byte {table:,}; {len(sizes)} streams are needed"
            f" and the file has {len(data):,} bytes"
        )
    _spend(header, where, budget)
    streams = {}
    for i, (name, size) in enumerate(sizes.items()):
        packed, unpacked = struct.unpack_from("<QQ", data, table + 16 * i)
        if unpacked != size or packed > len(data) - at:
            raise FileFormatError(
                f"{where}: the stream of {name} has {packed:,} bytes for {unpacked:,}; {size:,} are needed,"
                f" {len(data) - at:,} are left in the file"
            )
        streams[name] = np.frombuffer(_unzstd(bytes(data[at : at + packed]), size, name, where), np.uint8)
        at += packed
    if at != len(data):
        raise FileFormatError(f"{where}: {len(data) - at:,} bytes follow the last SPZ stream")
    extensions = bytes(data[32:table]) if header.flags & _EXTENDED else b""
    return header, extensions, {"sh": np.empty(0, np.uint8), **streams}


def _unzstd(packed: bytes, size: int, name: str, where: object) -> bytes:
    """Exactly ``size`` bytes of a Zstandard frame, through Python 3.14 or the package zstandard."""
    error_type: type[Exception]
    try:
        zstd = importlib.import_module("compression.zstd")
    except ImportError:
        try:
            zstandard = importlib.import_module("zstandard")
        except ImportError:
            raise MissingDependencyError(
                f"{where}: SPZ version 4 needs the extra 'formats': pip install zstandard"
            ) from None
        error_type = zstandard.ZstdError
        reader = zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(packed)
    else:
        error_type = zstd.ZstdError
        reader = None
    try:
        if reader is None:
            out = zstd.ZstdDecompressor().decompress(packed, max_length=size + 1)
        else:
            out = reader.read(size + 1)
    except (error_type, MemoryError) as error:
        raise FileFormatError(f"{where}: the stream of {name} is broken: {error}") from None
    if len(out) != size:
        raise FileFormatError(f"{where}: the stream of {name} does not unpack to {size:,} bytes")
    return out


def _positions(stored: np.ndarray, header: _Header) -> np.ndarray:
    """(m, 3) from 24-bit fixed-point numbers, of version 1 from half floats."""
    if header.version == 1:
        return np.ascontiguousarray(stored).view("<f2").astype(np.float32)
    words = np.zeros((len(stored), 3, 4), np.uint8)
    words[..., 1:] = stored.reshape(-1, 3, 3)
    fixed = words.view("<i4")[..., 0] >> 8  # shifted down from the upper bytes, which extends the sign
    return (fixed * 2.0**-header.fraction_bits).astype(np.float32)


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
