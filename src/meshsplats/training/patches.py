"""Points to patches: merged in cells of about equal size on the screen, each with its plane."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_NEAREST = 8
"""Points that determine a plane, at least, where there are as many."""
_REACH = 2**17
"""Cells from the median of the points to each side in which planes are fitted: squares of offsets by more
lose the digits that tell a plane."""


class SurfacePoints(NamedTuple):
    """Points on surfaces, to be merged to patches."""

    positions: np.ndarray
    """(n, 3) float64."""
    colors: np.ndarray
    """(n, 3) float32 display RGB."""
    weights: np.ndarray
    """(n,) float64 weight of each in a patch."""
    opacities: np.ndarray
    """(n,) float64 opacity that its patch has at the start."""

    @classmethod
    def alike(cls, positions: np.ndarray, colors: np.ndarray, weight: float, opacity: float) -> SurfacePoints:
        """Points of equal ``weight`` and ``opacity``."""
        return cls(positions, colors, *(np.full(len(positions), float(v)) for v in (weight, opacity)))

    @classmethod
    def joined(cls, *parts: SurfacePoints) -> SurfacePoints:
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class Patches(NamedTuple):
    """Small pieces of surfaces."""

    points: np.ndarray
    """(n, 3) float64."""
    normals: np.ndarray
    """(n, 3) float64 unit normals, of either sign."""
    colors: np.ndarray
    """(n, 3) float32 display RGB."""
    sides: np.ndarray
    """(n,) float64 side of the piece, scene units."""
    opacities: np.ndarray
    """(n,) float64 opacity at the start."""

    def select(self, rows: np.ndarray) -> Patches:
        """Those of a mask or of indices."""
        return Patches(*(column[rows] for column in self))

    @classmethod
    def joined(cls, *parts: Patches) -> Patches:
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def merged(found: SurfacePoints, pixels: np.ndarray, count: int) -> Patches:
    """About ``count`` patches, at most, for n points ``found``.

    Cells have sides in proportion to ``pixels`` (n,), the size of a pixel at each point, in powers of 2.
    Points are merged with their weights; cells with a weight of 1 or less are left out if others have more.
    """
    points, weights = found.positions, found.weights
    octave = np.round(np.log2(pixels / np.median(pixels))).astype(np.int64)
    octave = np.clip(octave, -8, 12)
    low = points.min(axis=0)
    # The extent of the points bounds the cell from above, 1/256 of a pixel from below.
    small, large = np.median(pixels) / 256, float((points.max(axis=0) - low).max()) + np.median(pixels)
    for _ in range(40):
        middle = np.sqrt(small * large)
        if len(np.unique(_keys(points - low, octave, middle))) > count:
            small = middle
        else:
            large = middle
    keys = _keys(points - low, octave, large)
    _, first, group = np.unique(keys, return_index=True, return_inverse=True)
    group = group.reshape(-1)

    def mean(values: np.ndarray) -> np.ndarray:
        total = np.bincount(group, weights)
        columns = [np.bincount(group, weights * column) / total for column in values.T]
        return np.stack(columns, axis=1)

    places, tints = mean(points), mean(found.colors)
    side = large * 2.0 ** octave[first]
    total = np.bincount(group, weights)
    keep = total > 1
    if not keep.any():
        keep[:] = True
    normals = plane_normals(points, places, side)
    opacities = mean(found.opacities[:, None])[:, 0]
    return Patches(places[keep], normals[keep], tints[keep].astype(np.float32), side[keep], opacities[keep])


def _keys(offsets: np.ndarray, octave: np.ndarray, side: float) -> np.ndarray:
    """(n,) int64 key of the cell of each point, from ``offsets`` (n, 3), which are not negative. Keys sort by
    octave, x, y and z."""
    steps = offsets / (side * 2.0**octave)[:, None]
    cells = np.minimum(steps, 2**31 - 1).astype(np.int64)
    if cells.max() < 2**19:
        return ((octave + 8) << 57) | (cells[:, 0] << 38) | (cells[:, 1] << 19) | cells[:, 2]
    # A few points lie far away: the rows and columns of cells that hold points are numbered.
    pairs = (((octave + 8) << 31) | cells[:, 0], (cells[:, 1] << 31) | cells[:, 2])
    outer, inner = (np.unique(pair, return_inverse=True)[1].reshape(-1) for pair in pairs)
    return outer * len(cells) + inner


def plane_normals(points: np.ndarray, places: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """(m, 3) unit normals of the planes through ``points`` (n, 3) around ``places`` (m, 3).

    A plane is fitted to the points in the cube of the cell around a place and the 26 beside it. The cells
    have sides of ``sides`` (m,), or larger ones, up to 64 times, where these cubes hold fewer than
    ``_NEAREST`` points.
    """
    normals = np.tile([0.0, 0.0, 1.0], (len(places), 1))
    if len(points) < 3:
        return normals
    low = np.minimum(points.min(axis=0), places.min(axis=0))
    low = np.maximum(low, np.median(points, axis=0) - _REACH * float(sides.min()))
    octave = np.floor(np.log2(sides / sides.min())).astype(int)
    open_ = np.ones(len(places), bool)
    for level in range(int(octave.max()) + 7):
        rows = np.flatnonzero(open_ & (octave <= level))
        if not len(rows):
            continue
        side = float(sides.min()) * 2.0**level
        count, total, products = sums_around(points, places[rows], low, side)
        enough = count >= _NEAREST
        rows, count, total, products = rows[enough], count[enough], total[enough], products[enough]
        mean = total / count[:, None]
        covariance = products / count[:, None, None] - mean[:, :, None] * mean[:, None, :]
        normals[rows] = np.linalg.eigh(covariance)[1][:, :, 0]
        open_[rows] = False
    return normals


def sums_around(
    points: np.ndarray, places: np.ndarray, low: np.ndarray, side: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each of ``places`` (m, 3): count (m,), sum (m, 3) and sum of products (m, 3, 3) of the points in
    its cell of ``side`` and the 26 beside it, relative to ``low``. Points and places below ``low``, or 2^20
    cells above it, count to the cells at the edge."""

    def cell_of(positions: np.ndarray) -> np.ndarray:
        cells = np.clip((positions - low) / side, 0, 2**20 - 4).astype(np.int64) + 1
        return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]

    keys, group = np.unique(cell_of(points), return_inverse=True)
    group = group.reshape(-1)
    x = points - low
    products = [x[:, i] * x[:, j] for i, j in _PAIRS]
    sums = np.stack([np.bincount(group, values) for values in (np.ones(len(x)), *x.T, *products)], axis=1)
    wanted, back = np.unique(cell_of(places), return_inverse=True)
    around = np.zeros((len(wanted), sums.shape[1]))
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            for k in (-1, 0, 1):
                beside = wanted + ((i << 42) + (j << 21) + k)
                at = np.minimum(np.searchsorted(keys, beside), len(keys) - 1)
                there = keys[at] == beside
                around[there] += sums[at[there]]
    around = around[back.reshape(-1)]
    full = np.empty((len(places), 3, 3))
    for column, (i, j) in enumerate(_PAIRS):
        full[:, i, j] = full[:, j, i] = around[:, 4 + column]
    return around[:, 0], around[:, 1:4], full
