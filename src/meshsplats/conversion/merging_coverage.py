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
"""Splats whose samples are in memory together."""
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
        return _shares(part, starts[first:last] - starts[first], Wholes(*(w[first:last] for w in wholes)))

    with ThreadPoolExecutor(threads) as pool:
        return np.concatenate(list(pool.map(of_range, cuts, [*cuts[1:], len(wholes.means)])))


def _shares(parts: Parts, starts: np.ndarray, wholes: Wholes) -> np.ndarray:
    """``covered_shares`` of groups whose parts begin at ``starts``."""
    group = parts.group
    plane, sizes = wholes.axes[group][:, :, :2], wholes.sizes[group]
    middle = np.einsum("ni,nia->na", parts.means - wholes.means[group], plane)
    xx, xy, _, yy = np.einsum("nia,nij,njb->nab", plane, parts.covariances, plane).reshape(-1, 4).T
    determinant = np.maximum(xx * yy - xy * xy, 1e-300)
    steps = REACH * ((np.arange(GRID) + 0.5) / GRID * 2 - 1)
    x = steps * sizes[:, :1] - middle[:, :1]
    y = steps * sizes[:, 1:] - middle[:, 1:]
    # The exponent is a sum of terms of x, of y and of both: (n, GRID, GRID), the largest array here.
    exponents = (-xy / determinant)[:, None, None] * x[:, :, None] * y[:, None, :]
    exponents += (0.5 * yy / determinant)[:, None, None] * (x * x)[:, :, None]
    exponents += (0.5 * xx / determinant)[:, None, None] * (y * y)[:, None, :]
    opacities = np.minimum(parts.opacities, MOST_OPAQUE)[:, None, None]
    logs = np.log1p(-opacities * np.exp(-np.minimum(exponents, 60)))
    left = np.exp(np.add.reduceat(logs, starts, axis=0))
    covered: np.ndarray = (1 - left).sum(axis=(1, 2)) * (2 * REACH / GRID) ** 2
    return covered / (2 * np.pi)
