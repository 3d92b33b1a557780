"""How much wider a merged splat has to be to cover what its parts covered.

A Gaussian with the covariance of a sheet of opaque splats is much narrower than the sheet, and no more than
opaque: sheets would become dots with gaps between them. So merged splats are widened until one that is opaque
has the area that the parts cover together, seen along the least axis: the integral of ``1 - product (1 -
opacity)`` over the plane of the two others. Layers behind each other, and parts that overlap, do not count
twice.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

GRID = 12
"""Samples along each side of the square in which the area of a group is integrated."""
REACH = 3.0
"""Half the side of this square, in standard deviations of the merged splat."""
AT_ONCE = 20_000
"""Splats whose samples are in memory together, for each thread: 80 MB."""
MOST_OPAQUE = 1 - 1e-4
"""Opacity of splats in these products, at most."""


class Parts(NamedTuple):
    """The n splats that are merged, as they are drawn, sorted by their group."""

    group: np.ndarray
    """(n,) int64 from 0, ascending."""
    means: np.ndarray
    """(n, 3) float64."""
    covariances: np.ndarray
    """(n, 3, 3) float64, with the low-pass filter."""
    opacities: np.ndarray
    """(n,) float64."""


class Wholes(NamedTuple):
    """The g splats that groups become, as they are drawn."""

    means: np.ndarray
    """(g, 3) float64."""
    axes: np.ndarray
    """(g, 3, 3) float64 unit vectors in columns, that of the largest size first."""
    sizes: np.ndarray
    """(g, 2) float64, the two largest standard deviations."""


def covered_shares(parts: Parts, wholes: Wholes, threads: int) -> np.ndarray:
    """(g,) float64: the area that the parts of each group cover, as a multiple of that of ``wholes`` if these
    were opaque. Every group has parts. The result does not depend on ``threads``."""
    starts = np.searchsorted(parts.group, np.arange(len(wholes.means) + 1))
    cuts = np.unique(np.searchsorted(starts[:-1], np.arange(0, len(parts.group), AT_ONCE)))

    def of_range(first: int, last: int) -> np.ndarray:
        rows = slice(starts[first], starts[last])
        part = Parts(*(column[rows] for column in parts))
        part = part._replace(group=part.group - first)
        return _shares(part, Wholes(*(column[first:last] for column in wholes)))

    with ThreadPoolExecutor(threads) as pool:
        return np.concatenate(list(pool.map(of_range, cuts, [*cuts[1:], len(wholes.means)])))


def _shares(parts: Parts, wholes: Wholes) -> np.ndarray:
    """``covered_shares`` of a few groups; each may have any number of parts."""
    logs = np.zeros((len(wholes.means), GRID, GRID))
    for first in range(0, len(parts.group), AT_ONCE):
        some = Parts(*(column[first : first + AT_ONCE] for column in parts))
        groups, starts = np.unique(some.group, return_index=True)
        logs[groups] += np.add.reduceat(_logs(some, wholes), starts, axis=0)
    covered: np.ndarray = -np.expm1(logs).sum(axis=(1, 2)) * (2 * REACH / GRID) ** 2
    return covered / (2 * np.pi)


def _logs(parts: Parts, wholes: Wholes) -> np.ndarray:
    """(n, GRID, GRID) logarithms of what each part lets through at the samples of its group."""
    group = parts.group
    plane, sizes = wholes.axes[group][:, :, :2], wholes.sizes[group]
    middle = np.einsum("ni,nia->na", parts.means - wholes.means[group], plane)
    xx, xy, _, yy = np.einsum("nia,nij,njb->nab", plane, parts.covariances, plane).reshape(-1, 4).T
    determinant = np.maximum(xx * yy - xy * xy, 1e-300)
    steps = REACH * ((np.arange(GRID) + 0.5) / GRID * 2 - 1)
    x = steps * sizes[:, :1] - middle[:, :1]
    y = steps * sizes[:, 1:] - middle[:, 1:]
    exponents = (-xy / determinant)[:, None, None] * x[:, :, None] * y[:, None, :]
    exponents += (0.5 * yy / determinant)[:, None, None] * (x * x)[:, :, None]
    exponents += (0.5 * xx / determinant)[:, None, None] * (y * y)[:, None, :]
    # Those of a needle seen end on, along a diagonal, cancel to less than 0.
    profile = np.exp(-np.clip(exponents, 0, 60))
    logs: np.ndarray = np.log1p(-np.minimum(parts.opacities, MOST_OPAQUE)[:, None, None] * profile)
    return logs
