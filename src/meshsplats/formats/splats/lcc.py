"""LCC, the format of XGRIDS: a folder of meta.lcc and binary files, with z up. The finest level is read.

index.bin lists the cells of a grid, and for each level the count, place and bytes of their splats; data.bin
has 32 bytes a splat, shcoef.bin 64 bytes of harmonics at twice the place. environment.bin (far surroundings)
and LCC2 are not read. Specification: xgrids/LCCWhitepaper.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from meshsplats._common.json_files import json_object
from meshsplats.errors import FileFormatError
from meshsplats.formats._orientation import Y_DOWN_FROM_Z_UP
from meshsplats.formats.content import Content
from meshsplats.formats.reading import FormatReader, Reading
from meshsplats.formats.splats._cloud_builder import Fill, SplatReader, SplatRows, decode_smallest_three
from meshsplats.scene.gaussians import constant_harmonics
from meshsplats.scene.origin import SAMPLE

_MAX_META_BYTES = 4 << 20
_MAX_LEVELS = 64
_AT_ONCE = 1 << 16
_RECORD = np.dtype(
    [
        ("position", "<f4", 3),
        ("color", "u1", 4),
        ("scale", "<u2", 3),
        ("rotation", "<u2", 2),
        ("normal", "<u2", 3),
    ]
)
_HARMONICS = np.dtype([("words", "<u4", 15), ("unused", "<u4")])


class _Scene(NamedTuple):
    """What meta.lcc says."""

    levels: int
    scales: tuple[np.ndarray, np.ndarray]
    harmonics: tuple[np.ndarray, np.ndarray] | None
    """Least and greatest values of each axis or channel."""


class _Run(NamedTuple):
    """Splats that lie one after the other in data.bin."""

    first: int
    splats: int


def _matches(content: Content) -> bool:
    text = content.json_text
    return all(name in text for name in (b'"totalLevel"', b'"splats"', b'"attributes"'))


def _open(content: Content, file: BinaryIO, _: Reading) -> SplatReader:
    """The splats of a meta.lcc; errors as ``load_gaussians``."""
    where = content.path
    scene = _scene(file.read(_MAX_META_BYTES + 1), where)
    with ExitStack() as opened:
        data = opened.enter_context(_beside(where, "data.bin"))
        rest = opened.enter_context(_beside(where, "shcoef.bin")) if scene.harmonics else None
        runs = _runs(where, scene, data, rest)
        close = opened.pop_all().close
    count = sum(run.splats for run in runs)
    chunks = partial(_chunks, data, rest, runs, scene, where)
    positions = partial(_sample, data, runs, where)
    return SplatReader(
        count,
        16 if scene.harmonics else 1,
        "3dgs",
        where,
        chunks,
        positions,
        up=_up(content),
        close_files=close,
    )


def _scene(raw: bytes, where: Path) -> _Scene:
    meta = json_object(raw, _MAX_META_BYTES, str(where))
    levels, entries = meta.get("totalLevel"), meta.get("attributes")
    if not isinstance(levels, int) or isinstance(levels, bool) or not 1 <= levels <= _MAX_LEVELS:
        raise FileFormatError(f"{where}: totalLevel must be 1 to {_MAX_LEVELS}, got {str(levels)[:20]}")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise FileFormatError(f"{where}: attributes must be a list of objects, got {str(entries)[:40]}")
    named = {str(entry.get("name")): entry for entry in entries}
    has_harmonics = meta.get("fileType") != "Portable" and "shcoef" in named
    return _Scene(
        levels, _range(named, "scale", where), _range(named, "shcoef", where) if has_harmonics else None
    )


def _range(named: dict[str, dict[str, Any]], name: str, where: Path) -> tuple[np.ndarray, np.ndarray]:
    ends = []
    for end in ("min", "max"):
        values = named.get(name, {}).get(end)
        listed = values if isinstance(values, list) else []
        if len(listed) != 3 or not all(isinstance(x, (int, float)) and abs(x) < 1e30 for x in listed):
            raise FileFormatError(f"{where}: {end} of {name} must be 3 numbers, got {str(values)[:40]}")
        ends.append(np.array(listed, np.float32))
    return ends[0], ends[1]


def _beside(where: Path, name: str) -> BinaryIO:
    path = where.parent / name
    if not path.is_file():
        raise FileFormatError(f"{where}: the file {name!r} must lie beside it, and is missing")
    return open(path, "rb")


def _runs(where: Path, scene: _Scene, data: BinaryIO, rest: BinaryIO | None) -> list[_Run]:
    """The splats of the finest level, cell by cell."""
    cell = np.dtype(
        [
            ("xy", "<i2", 2),
            ("levels", np.dtype([("count", "<i4"), ("at", "<i8"), ("bytes", "<i4")]), scene.levels),
        ]
    )
    with _beside(where, "index.bin") as file:
        length = file.seek(0, io.SEEK_END)
        if length % cell.itemsize:
            raise FileFormatError(
                f"{where}: index.bin has {length:,} bytes, no multiple of {cell.itemsize} for a cell of"
                f" {scene.levels} levels"
            )
        file.seek(0)
        finest = np.frombuffer(file.read(), cell)["levels"].reshape(-1, scene.levels)[:, 0]
    finest = finest[finest["count"] != 0]
    room = data.seek(0, io.SEEK_END) // _RECORD.itemsize
    room = room if rest is None else min(room, rest.seek(0, io.SEEK_END) // _HARMONICS.itemsize)
    counts, places = finest["count"].astype(np.int64), finest["at"]
    first = places // _RECORD.itemsize
    wrong = (counts < 0) | (places < 0) | (places % _RECORD.itemsize != 0) | (first > room - counts)
    if wrong.any():
        k = int(wrong.argmax())
        raise FileFormatError(
            f"{where}: index.bin has {counts[k]:,} splats at byte {places[k]:,} of data.bin, which does not"
            f" hold them, or shcoef.bin not their harmonics ({room:,} splats; truncated?)"
        )
    if counts.sum() > room:
        raise FileFormatError(
            f"{where}: index.bin has {counts.sum():,} splats, data.bin {room:,}: they overlap"
        )
    return [_Run(int(a), int(n)) for a, n in zip(first, counts, strict=True)]


def _pieces(runs: list[_Run]) -> Iterator[_Run]:
    for run in runs:
        for start in range(0, run.splats, _AT_ONCE):
            yield _Run(run.first + start, min(_AT_ONCE, run.splats - start))


def _rows(file: BinaryIO, run: _Run, record: np.dtype, where: Path) -> np.ndarray:
    file.seek(run.first * record.itemsize)
    data = file.read(run.splats * record.itemsize)
    if len(data) < run.splats * record.itemsize:
        raise FileFormatError(f"{where}: a file became shorter while it was read")
    return np.frombuffer(data, record)


def _sample(data: BinaryIO, runs: list[_Run], where: Path) -> np.ndarray:
    """(k, 3) float64: every so many-th position."""
    step = max(1, sum(run.splats for run in runs) // SAMPLE)
    found = [_rows(data, run, _RECORD, where)["position"][::step] for run in _pieces(runs)]
    return np.concatenate([np.empty((0, 3)), *found]).astype(np.float64)


def _chunks(
    data: BinaryIO, rest: BinaryIO | None, runs: list[_Run], scene: _Scene, where: Path, origin: np.ndarray
) -> Iterator[tuple[int, Fill]]:
    for run in _pieces(runs):
        records = _rows(data, run, _RECORD, where)
        harmonics = None if rest is None else _rows(rest, run, _HARMONICS, where)["words"]
        yield run.splats, partial(_fill, records, harmonics, scene, origin)


def _fill(
    records: np.ndarray, harmonics: np.ndarray | None, scene: _Scene, origin: np.ndarray, rows: SplatRows
) -> None:
    rows.means[:] = records["position"] - origin
    scales = _between(scene.scales, records["scale"] / np.float32(65535))
    rows.scales[:] = np.where(scales < 0, np.nan, scales)  # no deviation is negative
    low, high = records["rotation"].astype(np.uint32).T
    words = low | high << np.uint32(16)
    fields = [words >> np.uint32(10 * i) & np.uint32(1023) for i in range(3)]
    small = (np.stack(fields, axis=1) / np.float32(1023) - np.float32(0.5)) * np.float32(np.sqrt(2))
    xyzw = np.empty((len(records), 4), np.float32)
    decode_smallest_three(xyzw, small, words >> np.uint32(30))
    rows.quaternions[:] = xyzw[:, [3, 0, 1, 2]]
    color = records["color"] / np.float32(255)
    rows.opacities[:] = color[:, 3]
    rows.sh[:, 0] = constant_harmonics(color[:, :3])
    if harmonics is not None and scene.harmonics is not None:
        steps = [
            (harmonics >> np.uint32(shift) & np.uint32(most)) / np.float32(most)
            for shift, most in ((0, 2047), (11, 1023), (21, 2047))
        ]
        rows.sh[:, 1:] = _between(scene.harmonics, np.stack(steps, axis=2))


def _between(ends: tuple[np.ndarray, np.ndarray], shares: np.ndarray) -> np.ndarray:
    return ends[0] * (1 - shares) + ends[1] * shares


def _up(_: Content) -> np.ndarray:
    return np.array([0.0, 0.0, 1.0])


READER = FormatReader(_matches, _open, up=_up, to_y_down=Y_DOWN_FROM_Z_UP)
