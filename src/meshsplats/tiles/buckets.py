"""Splats sorted into the cells of an octree on the disk, so that each part of it fits into memory.

A cell is named by the digits of its path, one octant (0 to 7) a level: bit 0 is x, bit 1 is y, bit 2 is z.
Splats in one spot, which no octree parts, are parted by their order below the deepest level.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from meshsplats._common.geometry import morton_codes
from meshsplats._files import DISK_FULL
from meshsplats._files.atomic import patiently
from meshsplats.errors import FileFormatError
from meshsplats.scene.gaussians import GaussianCloud, Kernel
from meshsplats.tiles.journal import Journal

DEPTH = 20
"""Levels of the octree that centres decide."""
LEVELS_AT_ONCE = 2
"""Levels that one pass over a cell parts it by: 64 files are open at a time."""
BUCKET = 1 << 18
"""Splats that are in memory together."""
_AT_ONCE = 1 << 16


class Cube:
    """The root cell: (3,) least corner and side, scene units."""

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        self.low = np.asarray(low, np.float64)
        self.side = float((np.asarray(high, np.float64) - self.low).max()) * (1 + 1e-6) or 1.0

    def codes(self, means: np.ndarray) -> np.ndarray:
        """(n,) uint64 Morton codes of ``means`` (n, 3): 3 ``DEPTH`` bits, the first octant on top."""
        return morton_codes(means, self.low, self.side, DEPTH)


def record_type(degree: int) -> np.dtype[np.void]:
    """A splat with harmonics up to ``degree``, and its row in the input."""
    return np.dtype(
        [
            ("row", "<i4"),
            ("means", "<f4", 3),
            ("quaternions", "<f4", 4),
            ("scales", "<f4", 3),
            ("opacities", "<f4"),
            ("sh", "<f4", ((degree + 1) ** 2, 3)),
        ]
    )


def records_of(cloud: GaussianCloud, rows: np.ndarray, degree: int) -> np.ndarray:
    """(n,) records of a cloud, with its harmonics up to ``degree``; those that it does not have are 0."""
    records = np.zeros(len(cloud), record_type(degree))
    records["row"] = rows
    for name in ("means", "quaternions", "scales", "opacities"):
        records[name] = getattr(cloud, name)
    sh = cloud.of_degree(degree).sh
    records["sh"][:, : sh.shape[1]] = sh
    return records


def cloud_of(records: np.ndarray, kernel: Kernel) -> GaussianCloud:
    """The inverse of ``records_of``."""
    names = ("means", "quaternions", "scales", "opacities", "sh")
    arrays = {name: np.ascontiguousarray(records[name]) for name in names}
    return GaussianCloud(**arrays, kernel=kernel)


def read_records(paths: Iterable[Path], degree: int) -> np.ndarray:
    """All records of that ``degree`` in the files at ``paths``, in the order of their rows."""
    records = np.concatenate([np.fromfile(path, record_type(degree)) for path in paths])
    return records[np.argsort(records["row"], kind="stable")]


def check_size(path: Path, size: int) -> None:
    """FileFormatError unless the file, which a run has left, has so many bytes: a copy or a power cut can
    shorten it."""
    found = path.stat().st_size if path.is_file() else 0
    if found != size:
        raise FileFormatError(
            f"{path}: it has {found:,} bytes, but {size:,} were written: begin again with ``replace_old``"
        )


class Buckets:
    """Files of records of that ``degree`` in a folder, each the splats of a cell, in the order of their
    rows."""

    def __init__(self, folder: Path, cube: Cube, journal: Journal, bucket: int, degree: int = 0) -> None:
        self._folder, self._cube, self._journal, self._bucket = folder, cube, journal, bucket
        self._type = record_type(degree)

    def fill(self, records: Iterable[np.ndarray], count: int) -> None:
        """Sorts ``count`` splats into cells of at most as many as fit into memory. Steps that the journal
        names are done already."""
        done = {line["key"]: line["counts"] for line in self._journal.steps if line["step"] == "sorted"}
        todo = [("", count)]
        while todo:
            key, size = todo.pop()
            counts = done.get(key)
            if counts is None:
                if key:
                    self._check(key, size)
                counts = self._part(key, self._read(key) if key else records, size)
                self._journal.add("sorted", key=key, counts=counts)
            if key:
                self.remove([key])
            todo += [(key + cell, n) for cell, n in counts.items() if n > self._bucket]

    def cells(self) -> dict[str, list[str]]:
        """The cells that fit into memory, the largest ones that do, and the files of each; in order."""
        sizes = self._sizes()
        totals: dict[str, int] = {}
        for key, n in sizes.items():
            for length in range(len(key) + 1):
                totals[key[:length]] = totals.get(key[:length], 0) + n
        found: dict[str, list[str]] = {}
        for key in sorted(sizes):
            cell = next(
                (key[:length] for length in range(len(key)) if totals[key[:length]] <= self._bucket), key
            )
            found.setdefault(cell, []).append(key)
        return found

    def paths(self, cells: Mapping[str, Iterable[str]]) -> list[tuple[str, list[Path]]]:
        """The ``cells``, each with the places of its files on the disk, for ``read_records``.
        FileFormatError if one of them does not hold the splats that were written."""
        sizes = self._sizes()
        for files in cells.values():
            for key in files:
                self._check(key, sizes[key])
        return [(cell, [self._path(key) for key in files]) for cell, files in cells.items()]

    def remove(self, files: Iterable[str]) -> None:
        for key in files:
            patiently(partial(self._path(key).unlink, missing_ok=True))

    def _sizes(self) -> dict[str, int]:
        """The splats in each file, by the journal."""
        parted = self._journal.keys("sorted")
        return {
            line["key"] + cell: n
            for line in self._journal.steps
            if line["step"] == "sorted"
            for cell, n in line["counts"].items()
            if line["key"] + cell not in parted
        }

    def _check(self, key: str, count: int) -> None:
        check_size(self._path(key), count * self._type.itemsize)

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.splats"

    def _read(self, key: str) -> Iterator[np.ndarray]:
        with open(self._path(key), "rb") as file:
            while data := file.read(_AT_ONCE * self._type.itemsize):
                yield np.frombuffer(data, self._type)

    def _part(self, key: str, records: Iterable[np.ndarray], size: int) -> dict[str, int]:
        """Writes the splats of a cell into files of the cells inside; the count of each."""
        files = {}
        counts: dict[str, int] = {}
        passed = 0
        try:
            for block in records:
                digits = self._digits(key, block["means"], passed, size)
                passed += len(block)
                order = np.argsort(digits, kind="stable")
                ends = np.flatnonzero(np.diff(digits[order], append=-1)) + 1
                for rows in np.split(order, ends[:-1]):
                    cell = _name(int(digits[rows[0]]))
                    if cell not in files:
                        files[cell] = open(self._path(key + cell), "wb")  # noqa: SIM115 (closed below)
                    files[cell].write(block[rows].tobytes())
                    counts[cell] = counts.get(cell, 0) + len(rows)
            for file in files.values():
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            if error.errno in DISK_FULL:
                needed = (size - passed) * self._type.itemsize / 1e6
                text = f"no space left for the splats on their way into tiles, at least {needed:.0f} MB more"
                raise OSError(errno.ENOSPC, text, str(self._folder)) from None
            raise
        finally:
            for file in files.values():
                with suppress(OSError):  # a full disk, which is reported already
                    file.close()
        if passed != size:
            raise ValueError(f"the splats changed while they were read: {size:,} before, {passed:,} now")
        return dict(sorted(counts.items()))

    def _digits(self, key: str, means: np.ndarray, passed: int, size: int) -> np.ndarray:
        depth = len(key) + LEVELS_AT_ONCE
        if depth > DEPTH:
            return (passed + np.arange(len(means), dtype=np.int64)) * 8**LEVELS_AT_ONCE // size
        codes = self._cube.codes(means) >> np.uint64(3 * (DEPTH - depth))
        return (codes & np.uint64(8**LEVELS_AT_ONCE - 1)).astype(np.int64)


def _name(digits: int) -> str:
    return f"{digits:0{LEVELS_AT_ONCE}o}"
