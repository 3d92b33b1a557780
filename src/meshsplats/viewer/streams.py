"""Container of the viewer's data: rows of whole numbers as byte planes, a header, and gzip around them."""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from meshsplats._common.json_files import json_object

MAGIC = b"MSplat01"
LARGEST = (1 << 31) - 1
"""Magnitude of a number that still can be stored."""


class Packer:
    """Collects rows of whole numbers and writes them as one container.

    A row is stored as its zigzag codes (0, -1, 1, -2, ... as 0, 1, 2, 3, ...): first the lowest bytes of
    all its numbers, then the next ones, as many as the largest needs. Deflate compresses such planes better
    than whole numbers.
    """

    def __init__(self) -> None:
        self._rows: list[list[int]] = []
        self._parts: list[bytes] = []

    def add(self, values: np.ndarray) -> int:
        """Adds a row (n,) of integers and returns its index. Differences of neighbours are stored in place
        of the numbers where they are smaller."""
        row = np.ascontiguousarray(values, np.int64)
        if len(row) and np.abs(row).max() > LARGEST:
            raise ValueError(f"numbers to pack must lie within {LARGEST}")
        delta = 0
        if len(row) > 1:
            steps = np.diff(row, prepend=np.int64(0))
            if np.abs(steps).max() <= LARGEST and _bits(steps) < _bits(row):
                row, delta = steps, 1
        codes = ((row << 1) ^ (row >> 63)).astype(np.uint32)
        largest = int(codes.max()) if len(codes) else 0
        planes = -(-largest.bit_length() // 8)
        octets = codes.astype("<u4").view(np.uint8).reshape(-1, 4)
        self._parts += [np.ascontiguousarray(octets[:, k]).tobytes() for k in range(planes)]
        self._rows.append([len(row), planes, delta])
        return len(self._rows) - 1

    def add_rows(self, values: np.ndarray) -> int:
        """Adds the columns of ``values`` (n, k) as k rows and returns the index of the first."""
        first = len(self._rows)
        for column in np.asarray(values).T:
            self.add(column)
        return first

    def finish(self, header: Mapping[str, Any], level: int = 6) -> bytes:
        """The container: gzip around magic, length of the header, header (JSON) and planes."""
        text = json.dumps({**header, "rows": self._rows}, allow_nan=False, separators=(",", ":")).encode()
        body = b"".join([MAGIC, len(text).to_bytes(4, "little"), text, *self._parts])
        return gzip.compress(body, level, mtime=0)


class Unpacker:
    """Reads what ``Packer`` wrote.

    Raises ValueError for anything else; no more than ``most`` bytes are unpacked.
    """

    def __init__(self, data: bytes, most: int = 1 << 31) -> None:
        machine = zlib.decompressobj(wbits=31)
        try:
            body = machine.decompress(data, most)
        except zlib.error as error:
            raise ValueError(f"not packed data: {error}") from None
        if not machine.eof or body[: len(MAGIC)] != MAGIC:
            raise ValueError("not packed data, or cut off")
        at = len(MAGIC) + 4
        length = int.from_bytes(body[len(MAGIC) : at], "little")
        self.header: dict[str, Any] = json_object(body[at : at + length], len(body), "the packed data")
        at += length
        self.longest = max(1 << 20, 64 * len(body))
        """Longest row: one of zeros takes no bytes."""
        rows = self.header.get("rows")
        if not isinstance(rows, list) or not all(map(self._is_row, rows)):
            raise ValueError("packed data is broken: its header has no good table of rows")
        self._rows: list[tuple[int, int, int, int]] = []
        for count, planes, delta in rows:
            self._rows.append((count, planes, delta, at))
            at += count * planes
        if at != len(body):
            raise ValueError(f"packed data must have {at} bytes, got {len(body)}")
        self._body = np.frombuffer(body, np.uint8)

    def _is_row(self, row: object) -> bool:
        if not isinstance(row, list) or len(row) != 3 or not all(type(n) is int and n >= 0 for n in row):
            return False
        return bool(row[0] <= self.longest and row[1] <= 4 and row[2] <= 1)

    def row(self, index: int) -> np.ndarray:
        """Row ``index``, (n,) int64."""
        count, planes, delta, at = self._rows[index]
        codes = np.zeros(count, np.int64)
        for k in range(planes):
            codes |= self._body[at + k * count : at + (k + 1) * count].astype(np.int64) << (8 * k)
        values = (codes >> 1) ^ -(codes & 1)
        return np.cumsum(values) if delta else values

    def columns(self, first: int, count: int) -> np.ndarray:
        """(n, count) int64: the rows from ``first`` on as columns."""
        return np.stack([self.row(first + k) for k in range(count)], axis=1)


def _bits(values: np.ndarray) -> float:
    """Estimated bits of ``values``, for choosing between two forms."""
    return float(np.log2(1.0 + np.abs(values)).sum())


def rounded(numbers: Sequence[float] | np.ndarray) -> list[float]:
    """Seven digits of each number: what both sides compute with."""
    return [float(f"{value:.7g}") for value in np.ravel(numbers)]
