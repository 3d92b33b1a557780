"""Points of a data set: those of COLMAP's sparse models, and the .ply that a transforms.json names."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from meshsplats.datasets.folder import find_layout
from meshsplats.datasets.image_files import inside
from meshsplats.datasets.transforms import points_file
from meshsplats.errors import FileFormatError
from meshsplats.formats.ply.header import read_header
from meshsplats.formats.ply.table import FloatTable

MAX_POINTS = 20_000_000
"""More points than this are refused."""
UNKNOWN_VIEWS = 3
"""The count for points of files that do not say which images show them."""
_POINT = struct.Struct("<Q3d3BdQ")
_TRACK_BYTES = 8


class ScenePoints(NamedTuple):
    """Points on the surfaces of a scene."""

    positions: np.ndarray
    """(n, 3) float64, world frame."""
    colors: np.ndarray
    """(n, 3) uint8 display RGB; 128 where the file has none."""
    views: np.ndarray
    """(n,) int64 counts of the images that show each point; ``UNKNOWN_VIEWS`` where the file has none."""


def load_points(path: str | os.PathLike[str]) -> ScenePoints | None:
    """The points of the data set at ``path``, a folder as ``load_dataset`` takes it; None if it has none.

    Raises FileFormatError for broken files, which names file and record.
    """
    layout = find_layout(Path(path))
    if layout is None:
        return None
    if layout.name == "COLMAP":
        binary, text = layout.source / "points3D.bin", layout.source / "points3D.txt"
        if binary.is_file():
            return _binary(binary)
        return _text(text) if text.is_file() else None
    named = points_file(layout.source)
    if named is None:
        return None
    found = inside(layout.source.parent, named, f"{layout.source}: 'ply_file_path'")
    return _ply(found) if found.is_file() else None


def _binary(path: Path) -> ScenePoints:
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data) if len(data) >= 8 else (0,)
    if count > MAX_POINTS or count * _POINT.size > len(data) - 8:
        raise FileFormatError(
            f"{path}: says it holds {count:,} points, but has {len(data):,} bytes (truncated?)"
        )
    positions, colors = np.empty((count, 3)), np.empty((count, 3), np.uint8)
    views = np.empty(count, np.int64)
    at = 8
    for i in range(count):
        if at + _POINT.size > len(data):
            raise FileFormatError(f"{path}: ends within point {i} (truncated?)")
        _, x, y, z, r, g, b, _, track = _POINT.unpack_from(data, at)
        at += _POINT.size + _TRACK_BYTES * track
        if at > len(data):
            raise FileFormatError(f"{path}: ends within the images of point {i} (truncated?)")
        positions[i], colors[i], views[i] = (x, y, z), (r, g, b), track
    return _checked(positions, colors, views, path)


def _text(path: Path) -> ScenePoints:
    rows: list[list[float]] = []
    with open(path, "rb") as file:
        for number, line in enumerate(file, 1):
            words = line.split()
            if not words or words[0].startswith(b"#"):
                continue
            try:
                rows.append([*map(float, words[1:7]), (len(words) - 8) // 2])
                if len(words) < 8:
                    raise ValueError
            except ValueError:
                raise FileFormatError(
                    f"{path}: line {number}: a point is 'ID X Y Z R G B ERROR', then pairs of numbers"
                ) from None
            if len(rows) > MAX_POINTS:
                raise FileFormatError(f"{path}: more than {MAX_POINTS:,} points")
    table = np.array(rows, np.float64).reshape(-1, 7)
    if not np.isfinite(table).all():
        raise FileFormatError(f"{path}: a point has a value that is not finite")
    colors = np.clip(table[:, 3:6], 0, 255).astype(np.uint8)
    return _checked(table[:, :3].copy(), colors, table[:, 6].astype(np.int64), path)


def _ply(path: Path) -> ScenePoints:
    with open(path, "rb") as file:
        header = read_header(file, path)
        element = header.element("vertex")
        if element is None or element.count > MAX_POINTS:
            raise FileFormatError(f"{path}: expected up to {MAX_POINTS:,} points in an element 'vertex'")
        names = {prop.name for prop in element.properties}
        if not {"x", "y", "z"} <= names:
            raise FileFormatError(f"{path}: its points lack x, y or z")
        rgb = ("red", "green", "blue")
        has_color = set(rgb) <= names
        wanted = ("x", "y", "z", *(rgb if has_color else ()))
        table = FloatTable(file, header, element, wanted, path)
        order = [table.names.index(name) for name in wanted]
        chunks = [chunk[:, order] for chunk in table.chunks()] if element.count else []
    rows = np.concatenate([np.empty((0, len(wanted)), np.float32), *chunks])
    positions = rows[:, :3].astype(np.float64)
    colors = np.clip(rows[:, 3:], 0, 255) if has_color else np.full((len(rows), 3), 128.0)
    return _checked(positions, colors.astype(np.uint8), np.zeros(len(rows), np.int64), path)


def _checked(positions: np.ndarray, colors: np.ndarray, views: np.ndarray, path: Path) -> ScenePoints:
    if not np.isfinite(positions).all() or np.abs(positions).max(initial=0) > 1e9:
        raise FileFormatError(f"{path}: a point has coordinates that are not finite, or beyond 1e9")
    return ScenePoints(positions, colors, views if views.any() else np.full(len(views), UNKNOWN_VIEWS))
