"""Points sorted into cells: counts of neighbours, and connected parts."""

from __future__ import annotations

import numpy as np

_STEPS = [(x << 42) + (y << 21) + z for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
"""From the key of a cell to those of the 26 cells around it, and its own."""
_MOST = 1 << 20
"""Cells in a row at most; farther points are strays."""


class Cells:
    """Points (n, 3) in cubic cells with a ``side`` > 0, in the units of the points."""

    def __init__(self, points: np.ndarray, side: float) -> None:
        low = np.array([column.min() for column in points.T])  # a fifth of the time of min(axis=0)
        high = np.array([column.max() for column in points.T])
        # Keys have 21 bits for each axis, of which half are for cells in a row.
        whole = bool(((high - low) / side <= _MOST - 2).all())
        if not whole:
            low = np.median(points, axis=0) - _MOST // 2 * side
        steps = (points - low) / side
        far = np.zeros(len(points), bool) if whole else ((steps < 0) | (steps > _MOST - 2)).any(axis=1)
        steps = np.where(far[:, None], 0, steps).astype(np.int64) + 1
        keys = (steps[:, 0] << 42) | (steps[:, 1] << 21) | steps[:, 2]
        if far.any():
            # Strays are in cells as large as the space of all others, and these are never beside one another.
            coarse = np.floor((points[far] - low) / (side * _MOST))
            of_stray = np.unique(coarse, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)
            keys[far] = ((_MOST + 8) << 42) | ((3 * (of_stray >> 18)) << 21) | (3 * (of_stray & 0x3FFFF))
        self._cells, of = np.unique(keys, return_inverse=True)
        self._of = of.reshape(-1)

    def near(self) -> np.ndarray:
        """(n,) int64 counts of the points in the cell of each point and the 26 around it, itself included."""
        held = np.bincount(self._of, minlength=len(self._cells))
        total = np.zeros(len(self._cells), np.int64)
        for step in _STEPS:
            row, found = self._beside(step)
            total[row] += held[found]
        return total[self._of]

    def parts(self, group: np.ndarray | None = None) -> np.ndarray:
        """(n,) int64 indices, from 0, of the connected parts that the points form.

        Points in cells that share at least a corner are connected; so are points of one ``group`` (n,),
        ascending.
        """
        label = np.arange(len(self._cells))
        pairs = [self._beside(step) for step in _STEPS if step > 0]
        if group is not None:
            same = group[1:] == group[:-1]
            pairs.append((self._of[1:][same], self._of[:-1][same]))
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
        return np.unique(label, return_inverse=True)[1].reshape(-1)[self._of]

    def _beside(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the cells that have another cell ``step`` away, and of those others."""
        keys = self._cells + step
        found = np.minimum(np.searchsorted(self._cells, keys), len(self._cells) - 1)
        row = np.flatnonzero(self._cells[found] == keys)
        return row, found[row]
