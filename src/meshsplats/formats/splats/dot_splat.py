""".splat: 32 bytes a splat and nothing else, the format of the first web viewer (antimatter15/splat, MIT).

Each record holds position and scales (6 float32), colour and opacity (4 bytes of 255ths), and the rotation
(4 bytes, w x y z, 128 + 128 times the component, truncated). There is no header, so a file is recognised by
its rotations, which have length 1; some writers do not normalise them, or store 255 times the component, so
that in a file of that name sizes and positions count.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats.content import Content
from meshsplats.formats.reading import FormatReader, Reading
from meshsplats.formats.splats._cloud_builder import Fill, SplatReader, SplatRows
from meshsplats.formats.splats._quantising import as_bytes
from meshsplats.formats.writing import FormatWriter, Writing, warn_of_losses
from meshsplats.scene.gaussians import SH_C0, GaussianCloud, constant_harmonics
from meshsplats.scene.origin import SAMPLE

_RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
_AT_ONCE = 1 << 16
_RUN = 16
"""Records that lie together in a sample of positions."""
_FARTHEST, _LARGEST = 1e7, 1e5
"""Greatest positions and standard deviations of what can be splats: text and noise have greater ones."""


def _matches(content: Content) -> bool:
    """Whether the file can be `.splat`: whole records, and nine in ten of a sample have unit rotations, or,
    where the name says so, sizes and positions of splats."""
    with content.open() as file:
        return _is_dot_splat(file, content.name.endswith(".splat"))


def _is_dot_splat(file: BinaryIO, named: bool) -> bool:
    size = file.seek(0, io.SEEK_END)
    if size == 0 or size % _RECORD.itemsize:
        return False
    count = size // _RECORD.itemsize
    bytes_ = b""
    for start in sorted({0, count // 3, count - min(count, 256)}):
        file.seek(start * _RECORD.itemsize)
        bytes_ += file.read(256 * _RECORD.itemsize)
    records = np.frombuffer(bytes_, _RECORD)
    likely = np.abs(np.linalg.norm(_rotations(records), axis=1) - 1) < 0.05
    if named:
        likely |= (np.abs(records["position"]) < _FARTHEST).all(axis=1) & (
            (records["scale"] > 0) & (records["scale"] < _LARGEST)
        ).all(axis=1)
    return bool(likely.mean() >= 0.9)


def _open(content: Content, file: BinaryIO, _: Reading) -> SplatReader:
    """The splats of an opened file that ``_matches``; errors as ``load_gaussians``."""
    where = content.path
    count = file.seek(0, io.SEEK_END) // _RECORD.itemsize
    positions = partial(_sample, file, count)
    return SplatReader(count, 1, "3dgs", where, partial(_chunks, file, count, where), positions)


def _sample(file: BinaryIO, count: int) -> np.ndarray:
    """(k, 3) float64 positions, evenly spread."""
    starts = np.linspace(0, max(count - _RUN, 0), SAMPLE // _RUN).astype(np.int64)
    data = b""
    for start in np.unique(starts).tolist():
        file.seek(start * _RECORD.itemsize)
        data += file.read(_RUN * _RECORD.itemsize)
    whole = len(data) // _RECORD.itemsize
    return np.frombuffer(data, _RECORD, whole)["position"].astype(np.float64)


def _chunks(file: BinaryIO, count: int, where: object, origin: np.ndarray) -> Iterator[tuple[int, Fill]]:
    file.seek(0)
    for start in range(0, count, _AT_ONCE):
        m = min(_AT_ONCE, count - start)
        data = file.read(m * _RECORD.itemsize)
        if len(data) < m * _RECORD.itemsize:
            raise FileFormatError(f"{where}: the file became shorter while it was read")
        yield m, partial(_fill, np.frombuffer(data, _RECORD), origin)


def _fill(records: np.ndarray, origin: np.ndarray, rows: SplatRows) -> None:
    color = records["color"] / np.float32(255)
    rows.means[:] = records["position"] - origin
    rows.scales[:] = np.where(records["scale"] < 0, np.nan, records["scale"])  # no deviation is negative
    rows.quaternions[:] = _rotations(records)
    rows.opacities[:] = color[:, 3]
    rows.sh[:, 0] = constant_harmonics(color[:, :3])


def _rotations(records: np.ndarray) -> np.ndarray:
    # Writers truncate 128 + 128 q to an integer: the middle of that step lies half a unit higher.
    return (records["rotation"] - np.float32(127.5)) / np.float32(127.5)


def write_dot_splat(cloud: GaussianCloud, path: Path, writing: Writing) -> None:
    """Writes ``cloud``, the largest and most opaque splats first, as viewers that load a part want them; see
    ``save_gaussians``."""
    warn_of_losses(cloud, writing.where, degree=0)
    order = np.argsort(-cloud.scales.prod(axis=1) * cloud.opacities, kind="stable")
    records = np.empty(len(cloud), _RECORD)
    records["position"], records["scale"] = cloud.means[order], cloud.scales[order]
    colors = np.float32(0.5) + np.float32(SH_C0) * cloud.sh[order, 0]
    records["color"][:, :3] = as_bytes(colors * np.float32(255))
    records["color"][:, 3] = as_bytes(cloud.opacities[order] * np.float32(255))
    # Truncated, as by other writers; see ``_rotations``.
    records["rotation"] = np.clip(128 + 128 * cloud.quaternions[order], 0, 255).astype(np.uint8)
    with open(path, "wb") as file:
        file.write(records.data)


READER = FormatReader(_matches, _open)
WRITER = FormatWriter(write_dot_splat, lambda _: _RECORD.itemsize)
