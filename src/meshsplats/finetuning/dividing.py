"""Splats divided into cells of equal count, and in which order these may be tuned."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

MARGIN = 0.1
"""Width of the margin, as a share of the longest side of a cell."""


class Cells(NamedTuple):
    """A scene in cells."""

    owner: np.ndarray
    """(n,) int32 cell of each splat."""
    low: np.ndarray
    """(k, 3) float64 least corner of the centres of each cell's splats."""
    high: np.ndarray
    """(k, 3) float64 greatest corner."""

    def own(self, cell: int) -> np.ndarray:
        """Rows of the splats of ``cell``, ascending."""
        return np.flatnonzero(self.owner == cell)

    def margin(self, cell: int, means: np.ndarray) -> np.ndarray:
        """Rows of the splats of other cells with ``means`` (n, 3) in the margin of ``cell``, ascending."""
        away = MARGIN * float((self.high[cell] - self.low[cell]).max())
        inside = ((means >= self.low[cell] - away) & (means <= self.high[cell] + away)).all(axis=1)
        return np.flatnonzero(inside & (self.owner != cell))


def divide(means: np.ndarray, most: int) -> Cells:
    """Divides points (n, 3), n > 0, into the fewest cells of at most ``most`` points, of equal count up to
    1: halves of halves, each across the longest side. Points in one plane go by their order."""
    n = len(means)
    owner = np.empty(n, np.int32)
    todo = [(np.arange(n), -(-n // most))]
    found = 0
    while todo:
        rows, cells = todo.pop()
        if cells == 1:
            owner[rows] = found
            found += 1
            continue
        points = means[rows]
        axis = int((points.max(axis=0) - points.min(axis=0)).argmax())
        order = np.argsort(points[:, axis], kind="stable")
        count = len(rows) * (cells // 2) // cells
        first, second = np.sort(rows[order[:count]]), np.sort(rows[order[count:]])
        todo += [(second, cells - cells // 2), (first, cells // 2)]
    low, high = np.empty((found, 3)), np.empty((found, 3))
    for cell in range(found):
        own = means[owner == cell]
        low[cell], high[cell] = own.min(axis=0), own.max(axis=0)
    return Cells(owner, low, high)


def waves(cells: Cells, means: np.ndarray) -> list[list[int]]:
    """The cells in groups without neighbours, to be tuned one group after the other; two cells are neighbours
    if one has splats in the margin of the other."""
    count = len(cells.low)
    beside: list[set[int]] = [set() for _ in range(count)]
    for cell in range(count):
        for other in np.unique(cells.owner[cells.margin(cell, means)]).tolist():
            beside[cell].add(other)
            beside[other].add(cell)
    found: list[list[int]] = []
    for cell in range(count):
        wave = next((wave for wave in found if not beside[cell] & set(wave)), None)
        if wave is None:
            found.append([cell])
        else:
            wave.append(cell)
    return found
