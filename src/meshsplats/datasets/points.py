"""Points of a data set: those of COLMAP's sparse models, and the .ply that a transforms.json names."""

from __future__ import annotations

import os
import struct
import warnings
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from meshsplats._common.arrays import checked_array
from meshsplats._common.kinds import need_path
from meshsplats.datasets.image_files import inside, leads_out
from meshsplats.datasets.layouts import find_layout
from meshsplats.datasets.transforms import points_file
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats.ply.header import read_header
from meshsplats.formats.ply.table import FloatTable

MAX_POINTS = 5_000_000
"""More points than this are refused."""
_THIN = "thin them, or remove the file (the photographs are matched in any case)"
UNKNOWN_VIEWS = 3
"""The count for points of files that do not say which images show them."""
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
"""A point in COLMAP's binary file, before the images that show it."""
_TRACK = struct.Struct("<Q")
_TRACK_AT = 43
"""Offset of the number of these images."""
_TRACK_BYTES = 8
"""Bytes of each image of a point."""
_BLOCK_BYTES = 1 << 22
"""Bytes that are read at a time."""
_MAX_LINE = 1 << 22
"""The longest line that is read, bytes."""


class ScenePoints(NamedTuple):
    """Points on the surfaces of a scene."""

    positions: np.ndarray
    """(n, 3) float64 positions relative to the origin that they were loaded for."""
    colors: np.ndarray
    """(n, 3) uint8 display RGB; 128 where the file has none."""
    views: np.ndarray
    """(n,) int64 counts of the images that show each point; ``UNKNOWN_VIEWS`` where the file has none."""


def load_points(
    path: str | os.PathLike[str], *, origin: Sequence[float] | np.ndarray = (0, 0, 0)
) -> ScenePoints | None:
    """The points of the data set at ``path``, a folder as ``load_dataset`` takes it; None if it has none.

    ``origin``: (3,) point of the world that positions shall be relative to, that of the data set.

    Raises FileFormatError for broken files, which names file and record. Warns with a DataWarning of points
    outside of the folder, which are not read.
    """
    need_path(path=path)
    point = checked_array("origin", origin, np.float64, (3,))
    layout = find_layout(Path(path))
    if layout is None:
        return None
    if layout.name == "COLMAP":
        found = _of_model(layout.source)
        return None if found is None else found._replace(positions=found.positions - point)
    if layout.name == "LLFF":
        return None
    named = points_file(layout.source)
    if named is None:
        return None
    if leads_out(named):
        warnings.warn(
            f"{layout.source}: its points, {named[:200]!r}, are not in the folder, and are left out",
            DataWarning,
            stacklevel=2,
        )
        return None
    file = inside(layout.source.parent, named, f"{layout.source}: 'ply_file_path'")
    return _ply(file, point) if file.is_file() else None


def _of_model(model: Path) -> ScenePoints | None:
    """The points of a sparse model of COLMAP, in the world."""
    binary, text = model / "points3D.bin", model / "points3D.txt"
    if binary.is_file():
        return _binary(binary)
    return _text(text) if text.is_file() else None


def _binary(path: Path) -> ScenePoints:
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        head = file.read(_TRACK.size)
        count = _TRACK.unpack(head)[0] if len(head) == _TRACK.size else 0
        if len(head) < _TRACK.size or count * _POINT.itemsize > size - len(head):
            raise FileFormatError(
                f"{path}: says it holds {count:,} points, but has {size:,} bytes (truncated?)"
            )
        if count > MAX_POINTS:
            raise FileFormatError(f"{path}: more than {MAX_POINTS:,} points ({count:,}): {_THIN}")
        rows = np.empty(count, np.dtype([("xyz", "f8", 3), ("rgb", "u1", 3), ("track", "i8")]))
        done, block = 0, b""
        while done < count:
            block += file.read(_BLOCK_BYTES)
            starts, end = _starts(block, count - done)
            if not starts:
                raise FileFormatError(f"{path}: ends within point {done} (truncated?)")
            found = np.frombuffer(block, np.uint8)[np.add.outer(starts, np.arange(_POINT.itemsize))]
            points = found.view(_POINT)[:, 0]
            for name in ("xyz", "rgb", "track"):
                rows[name][done : done + len(points)] = points[name]
            done += len(points)
            if end > len(block):
                if file.tell() + end - len(block) > size:
                    raise FileFormatError(f"{path}: ends within the images of point {done - 1} (truncated?)")
                file.seek(end - len(block), os.SEEK_CUR)
            block = block[end:]
    return _checked(rows["xyz"].copy(), rows["rgb"].copy(), rows["track"].copy(), path)


def _starts(block: bytes, most: int) -> tuple[list[int], int]:
    """Where at most ``most`` points start in ``block``, whose records, without their images, lie inside; and
    where the next one starts, which may lie beyond."""
    starts: list[int] = []
    at, last = 0, len(block) - _POINT.itemsize
    size, fixed, track = _TRACK_BYTES, _POINT.itemsize, _TRACK.unpack_from
    while at <= last and len(starts) < most:
        starts.append(at)
        at += fixed + size * track(block, at + _TRACK_AT)[0]
    return starts, at


def _text(path: Path) -> ScenePoints:
    rows = array("d")
    count = 0
    with open(path, "rb") as file:
        for number, line in enumerate(iter(lambda: file.readline(_MAX_LINE), b""), 1):
            words = line.removeprefix(b"\xef\xbb\xbf").split()  # a mark of UTF-8 may begin the file
            if not words or words[0].startswith(b"#"):
                continue
            try:
                if len(words) < 8 or len(line) == _MAX_LINE:
                    raise ValueError
                rows.extend([*map(float, words[1:7]), (len(words) - 8) // 2])
            except ValueError:
                raise FileFormatError(
                    f"{path}: line {number}: a point is 'ID X Y Z R G B ERROR', then pairs of numbers"
                ) from None
            count += 1
            if count > MAX_POINTS:
                raise FileFormatError(f"{path}: more than {MAX_POINTS:,} points: {_THIN}")
    table = np.frombuffer(rows, np.float64).reshape(-1, 7)
    if not np.isfinite(table).all():
        raise FileFormatError(f"{path}: a point has a value that is not finite")
    colors = np.clip(table[:, 3:6], 0, 255).astype(np.uint8)
    return _checked(table[:, :3].copy(), colors, table[:, 6].astype(np.int64), path)


def _ply(path: Path, origin: np.ndarray) -> ScenePoints:
    with open(path, "rb") as file:
        header = read_header(file, path)
        element = header.element("vertex")
        if element is None or element.count > MAX_POINTS:
            raise FileFormatError(
                f"{path}: expected an element 'vertex' of at most {MAX_POINTS:,} points: {_THIN}"
            )
        names = {prop.name for prop in element.properties}
        if not {"x", "y", "z"} <= names:
            raise FileFormatError(f"{path}: its points lack x, y or z")
        rgb = ("red", "green", "blue")
        has_color = set(rgb) <= names
        wanted = ("x", "y", "z", *(rgb if has_color else ()))
        table = FloatTable(file, header, element, wanted, path)
        table.origin = origin
        order = [table.names.index(name) for name in wanted]
        chunks = [chunk[:, order] for chunk in table.chunks()] if element.count else []
    rows = np.concatenate([np.empty((0, len(wanted)), np.float32), *chunks])
    positions = rows[:, :3].astype(np.float64)
    colors = np.full((len(rows), 3), 128, np.uint8)
    if has_color:
        kind = next(prop.dtype for prop in element.properties if prop.name == "red")
        scaled = rows[:, 3:] * np.float32(_color_scale(kind, rows[:, 3:]))
        colors[:] = np.clip(np.nan_to_num(scaled), 0, 255)
    return _checked(positions, colors, np.zeros(len(rows), np.int64), path)


def _color_scale(dtype: np.dtype, values: np.ndarray) -> float:
    """Factor from colour ``values`` (n, 3) of properties of type ``dtype`` to 0 to 255."""
    if dtype.kind == "f":
        return 255.0 if values.max(initial=0) <= 1 else 1.0  # some tools write 0 to 255 as floats
    return 255 / 65535 if dtype.itemsize == 2 else 1.0


def _checked(positions: np.ndarray, colors: np.ndarray, views: np.ndarray, path: Path) -> ScenePoints:
    if not np.isfinite(positions).all() or np.abs(positions).max(initial=0) > 1e9:
        raise FileFormatError(f"{path}: a point has coordinates that are not finite, or beyond 1e9")
    return ScenePoints(positions, colors, views if views.any() else np.full(len(views), UNKNOWN_VIEWS))
