"""What an SPZ file says before and behind its splats: header, table of streams, extensions; and how to unpack
it."""

from __future__ import annotations

import importlib
import struct
import sys
import warnings
import zlib
from typing import Any, NamedTuple

import numpy as np

from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError
from meshsplats.formats._validation import Budget

MAGIC = b"NGSP"
REST = (0, 3, 8, 15, 24)
"""Coefficients per channel beyond the first, by degree."""
COLOR_SCALE = 0.15
"""Colours are stored as 0.5 + 0.15 f_dc, which leaves room beyond [0, 1]."""
ANTIALIASED, EXTENDED, _TREE = 1, 2, 128
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
MAX_EXTENSION_BYTES = 1 << 20
MAX_HEAD = 32 + MAX_EXTENSION_BYTES + 16 * 255
"""Bytes before the streams of version 4."""


class Header(NamedTuple):
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
        per_splat["sh"] = 3 * REST[self.degree]
        return {name: size * self.splats for name, size in per_splat.items()}


def parse_header(raw: bytes, versions: range, where: object) -> Header:
    magic, version, count, degree, fraction_bits, flags, _ = struct.unpack("<4sIIBBBB", raw)
    if magic != MAGIC:
        raise FileFormatError(f"{where}: no SPZ header, it begins with {magic!r}")
    if version not in versions:
        known = f"{versions[0]} to {versions[-1]}" if len(versions) > 1 else str(versions[0])
        if versions[0] == 4 and version in range(1, 4):
            raise FileFormatError(f"{where}: SPZ of version {version} that is not gzipped, as it must be")
        raise FileFormatError(f"{where}: SPZ version {version} in a container of version {known}")
    if degree >= len(REST):
        raise FileFormatError(f"{where}: SPZ harmonics of degree {degree}, expected 0 to 4")
    if fraction_bits > 30:
        raise FileFormatError(
            f"{where}: SPZ positions with {fraction_bits} fractional bits, expected 0 to 30"
        )
    return Header(version, count, degree, fraction_bits, flags)


def contents(
    head: bytes | memoryview, length: int, where: object, budget: Budget | None = None
) -> tuple[Header, bytes, dict[str, tuple[int, int, int]]]:
    """Header, extensions, and place, length and unpacked length of each stream of a file of ``length`` bytes
    that begins with ``head``. The splats are taken from the ``budget`` before the streams are looked at."""
    if len(head) < 32:
        raise FileFormatError(f"{where}: truncated SPZ header of {len(head)} bytes")
    header = parse_header(bytes(head[:16]), range(4, 5), where)
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
        spend(header, where, budget)
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
    extensions = bytes(head[32:table]) if header.flags & EXTENDED else b""
    return header, extensions, found


def check_end(header: Header, found: int, extensions: bytes, complete: bool, where: object) -> None:
    """Refuses a stream that does not have the length that the header promises."""
    wanted = sum(header.sizes().values())
    if found < wanted or not complete:
        problem = "truncated" if found < wanted else "longer than its header says"
        raise FileFormatError(
            f"{where}: {problem}: {header.splats:,} splats take {wanted:,} bytes, the stream gave"
            f" {found + len(extensions):,}"
        )
    if extensions and not header.flags & EXTENDED:
        what = "; those of Spark's level-of-detail tree, which is not read" if header.flags & _TREE else ""
        raise FileFormatError(f"{where}: {len(extensions):,} bytes follow the {header.splats:,} splats{what}")


def warn_of_degree(header: Header, where: object) -> None:
    if header.degree > 3:
        warnings.warn(
            f"{where}: spherical harmonics of degree {header.degree}; those beyond degree 3 are left out",
            DataWarning,
            stacklevel=5,
        )


def spend(header: Header, where: object, budget: Budget) -> None:
    memory = 4 * (11 + 3 * (1 + REST[min(header.degree, 3)]))
    budget.spend(sum(header.sizes().values()) + header.splats * memory, f"its {header.splats:,} splats")


def axes(extensions: bytes, where: object) -> np.ndarray:
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


def zstandard_modules(where: object) -> tuple[Any, Any]:
    """The module of Python 3.14 and None, or else None and the package. MissingDependencyError without."""
    try:
        return importlib.import_module("compression.zstd"), None
    except ImportError:
        pass
    try:
        return None, importlib.import_module("zstandard")
    except ModuleNotFoundError:
        raise MissingDependencyError(
            f"{where}: SPZ version 4 needs the extra 'formats': pip install zstandard"
        ) from None


def unpacking_errors() -> tuple[type[Exception], ...]:
    """The errors of zlib, and of the modules for Zstandard that have been imported."""
    loaded = [sys.modules.get(name) for name in ("compression.zstd", "zstandard")]
    return (zlib.error, *(module.ZstdError for module in loaded if module is not None))
