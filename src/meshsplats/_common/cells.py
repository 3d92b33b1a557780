"""Points sorted into cells: counts of neighbours, and connected parts."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy

import numpy as np

from meshsplats._common.chunks import chunks

_STEPS = [(x << 42) + (y << 21) + z for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
"""From the key of a cell to those of the 26 cells around it, and its own."""
_MOST = 1 << 20
"""Cells in a row at most; farther points are strays."""
_CHUNK = 1 << 13
"""Points that are sorted into cells together: so many stay in the cache, with their ends."""


class Cells:
    """Points (n, 3) in cubic cells with a ``side`` > 0, in the units of the points.

    With ``ends`` (n, k, 3), offsets from each point, the way there belongs to it: halfway, and at each end.
    """

    def __init__(self, points: np.ndarray, side: float, ends: np.ndarray | None = None) -> None:
        self._points, self._side, self._ends = points, side, ends
        extents = [[(column.min(), column.max()) for column in block.T] for block in self._blocks()]
        low, high = np.min(extents, axis=0)[:, 0], np.max(extents, axis=0)[:, 1]
        # Keys have 21 bits for each axis, of which half are for cells in a row.
        self._whole = bool(((high - low) / side <= _MOST - 2).all())
        if not self._whole:
            columns = (np.concatenate([block[:, axis] for block in self._blocks()]) for axis in range(3))
            low = np.array([np.median(column) for column in columns]) - _MOST // 2 * side
        per = 1 if ends is None else 1 + 2 * ends.shape[1]
        keys = np.empty(len(points) * per, np.int64)
        stray, coarse, start = np.zeros(len(keys), bool), [], 0
        for block in self._blocks():
            own = slice(start, start := start + len(block))
            steps = (block - low) / side
            if not self._whole:
                stray[own] = far = ((steps < 0) | (steps > _MOST - 2)).any(axis=1)
                steps[far] = 0
                coarse.append(np.floor((block[far] - low) / (side * _MOST)))
            cells = steps.astype(np.int64) + 1
            keys[own] = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
        if stray.any():
            # Strays are in cells as large as the space of all others, and these are never beside one another.
            _, of_stray = np.unique(np.concatenate(coarse), axis=0, return_inverse=True)
            of_stray = of_stray.reshape(-1).astype(np.int64)
            keys[stray] = ((_MOST + 8) << 42) | ((3 * (of_stray >> 18)) << 21) | (3 * (of_stray & 0x3FFFF))
        self._cells = _numbered(keys)
        self._of = keys.reshape(-1, per)

    def _blocks(self) -> Iterator[np.ndarray]:
        """(k, 3) points, with those on the ways to their ends, for few of them at a time."""
        for part in chunks(len(self._points), _CHUNK):
            points = self._points[part]
            if self._ends is not None:
                ends = self._ends[part].astype(np.float64)
                offsets = np.concatenate([0 * ends[:, :1], ends / 2, ends], axis=1)
                points = (points[:, None] + offsets).reshape(-1, 3)
            yield points

    def coarser(self, doublings: int) -> Cells:
        """The same points in cells whose side is so often doubled."""
        if not doublings:
            return self
        side = self._side * 2.0**doublings
        if not self._whole:
            return Cells(self._points, side, self._ends)
        keys = np.zeros_like(self._cells)
        for shift in (42, 21, 0):
            keys |= ((((self._cells >> shift & 0x1FFFFF) - 1) >> doublings) + 1) << shift
        result = copy(self)
        result._side = side
        result._cells, of = np.unique(keys, return_inverse=True)
        result._of = of.reshape(-1)[self._of]
        return result

    def near(self) -> np.ndarray:
        """(n,) int64 counts of the points in the cell of each point and the 26 around it, itself included,
        without ends."""
        own = self._of[:, 0]
        held = np.bincount(own, minlength=len(self._cells))
        total = np.zeros(len(self._cells), np.int64)
        for step in _STEPS:
            row, found = self._beside(step)
            total[row] += held[found]
        return total[own]

    def parts(self) -> np.ndarray:
        """(n,) int64 indices, from 0, of the connected parts that the points form.

        Points in cells that share at least a corner are connected, and so are a point and its ends.
        """
        label = np.arange(len(self._cells))
        pairs = [self._beside(step) for step in _STEPS if step > 0] + [self._apart()]
        while True:
            before = label
            for row, found in pairs:
                least = np.minimum(label[row], label[found])
                label = label.copy()
                np.minimum.at(label, row, least)
                np.minimum.at(label, found, least)
                # Roots, too, so that whole parts take the lower label at once.
                np.minimum.at(label, before[row], least)
                np.minimum.at(label, before[found], least)
            while True:
                further = label[label]
                if np.array_equal(further, label):
                    break
                label = further
            if np.array_equal(label, before):
                break
        return np.unique(label, return_inverse=True)[1].reshape(-1)[self._of[:, 0]]

    def _apart(self) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of cells, by their indices, of points and their ends that are not in cells side by side."""
        count, codes = len(self._cells), [np.zeros(0, np.int64)]
        for part in chunks(len(self._of), _CHUNK):
            of = self._of[part]
            own, end = np.broadcast_arrays(of[:, :1], of[:, 1:])
            other = own != end
            codes.append(_different(own[other] * count + end[other]))
        row, found = np.divmod(_different(np.concatenate(codes)), count)
        apart = ~np.isin(self._cells[row] - self._cells[found], _STEPS)
        return row[apart], found[apart]

    def _beside(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the cells that have another cell ``step`` away, and of those others."""
        keys = self._cells + step
        found = np.minimum(np.searchsorted(self._cells, keys), len(self._cells) - 1)
        row = np.flatnonzero(self._cells[found] == keys)
        return row, found[row]


def _numbered(keys: np.ndarray) -> np.ndarray:
    """The different ``keys`` (n,) int64, ascending; writes the index among them of each in its place."""
    found = []
    for part in (parts := chunks(len(keys), 8 * _CHUNK)):
        own, of = np.unique(keys[part], return_inverse=True)
        keys[part] = of.reshape(-1)
        found.append(own)
    every = _different(np.concatenate(found))
    for part, own in zip(parts, found, strict=True):
        keys[part] = np.searchsorted(every, own)[keys[part]]
    return every


def _different(values: np.ndarray) -> np.ndarray:
    """The different ``values`` >= 0, ascending: ``np.unique`` hashes them, which takes far longer."""
    values = np.sort(values)
    return values[np.diff(values, prepend=-1) > 0]
