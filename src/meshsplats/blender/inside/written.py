"""Checks that files are whole: Blender does not report a full disk, and leaves a truncated file."""

from __future__ import annotations

import errno
import os
import shutil
import struct
from pathlib import Path

_SEEKABLE = 0x8F92EAB1
"""Last number of a Zstandard file with a seek table (Zstandard's seekable format)."""


def check_image(path: Path, pixels: int) -> None:
    """Raises OSError for a missing or truncated .png or .exr of so many ``pixels``."""
    try:
        if path.suffix == ".png":
            with open(path, "rb") as file:
                whole = file.read()[-8:-4] == b"IEND"
        else:
            whole = _whole_exr(path.read_bytes())
    except FileNotFoundError:
        whole = False
    if not whole:
        raise _fault(path, "image", 16 * pixels)


def check_blend(path: Path) -> None:
    """Raises OSError for a truncated or damaged .blend that was saved compressed."""
    if not _whole_zstandard(path):
        raise _fault(path, "complete file", 1 << 20)


def _fault(path: Path, kind: str, needed: int) -> OSError:
    if shutil.disk_usage(path.parent).free < needed:
        return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fspath(path))
    return OSError(f"{path}: Blender wrote no {kind}")


def _whole_zstandard(path: Path) -> bool:
    """Whether the parts of a compressed .blend have the sizes that its seek table, written last, says."""
    try:
        with open(path, "rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - 9, 0))
            count, descriptor, magic = struct.unpack("<IBI", file.read(9))
            entry = 12 if descriptor & 0x80 else 8
            table = entry * count + 9
            if magic != _SEEKABLE or size < table + 8:
                return False
            file.seek(size - table)
            entries = file.read(entry * count)
    except (FileNotFoundError, struct.error):
        return False
    return sum(length for (length,) in struct.iter_unpack(f"<I{entry - 4}x", entries)) + table + 8 == size


def _whole_exr(data: bytes) -> bool:
    """Whether an OpenEXR file holds all chunks of its offset table (https://openexr.com, file layout).
    Blender's own reader will not do: version 5.0 aborts on a truncated file."""
    if len(data) < 9 or data[:4] != b"\x76\x2f\x31\x01":
        return False
    if data[5] & 0x1A:  # tiled, deep or multi-part: Blender writes none of these here
        return True
    at, found = 8, {}
    try:
        while data[at]:
            name_end = data.index(b"\0", at)
            type_end = data.index(b"\0", name_end + 1)
            (size,) = struct.unpack_from("<i", data, type_end + 1)
            found[data[at:name_end]] = data[type_end + 5 : type_end + 5 + size]
            at = type_end + 5 + size
        _, top, _, bottom = struct.unpack("<4i", found[b"dataWindow"])
        lines = {3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}.get(found[b"compression"][0], 1)
        offsets = struct.unpack_from(f"<{-(-(bottom - top + 1) // lines)}q", data, at + 1)
        ends = [offset + 8 + struct.unpack_from("<i", data, offset + 4)[0] for offset in offsets]
    except (IndexError, KeyError, ValueError, struct.error):
        return False
    return min(offsets) > at and max(ends) <= len(data)
