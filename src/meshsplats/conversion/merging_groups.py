"""Which splats become one: neighbours, always the pair of least cost, after cells of an octree where few of
many splats are left."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshsplats._common.geometry import morton_codes
from meshsplats._core.library import pointer, run
from meshsplats._core.neighbours import nearest
from meshsplats._core.structures import MergingStruct
from meshsplats.conversion.selection import disc_areas, mean_shadow
from meshsplats.scene.gaussians import GaussianCloud

NEIGHBOURS = 8
"""Nearest splats with which each may be merged at first; a merged one has the neighbours of both. With 16,
results are at most 0.1 dB better, in twice the time."""

COLOR_WEIGHT = 1.0
"""Cost of a difference in colour relative to growth of the area: e-fold growth of both splats costs as much
as half the square of a difference of 1. Between 1 and 4 nothing changes."""

FINEST = 0.5
"""Least width of a splat when it is compared with others, as a share of the median splat's. Values between a
quarter and 1 differ by 0.2 dB."""

CLUMPED = 16
"""Where so many splats or more become one, those of a cell of an octree are put together at first..."""
CLUMPS = 8
"""...as long as together they count at most this part of what each counts at the end. Pair by pair from the
start, that takes five times as long and is as good: within 0.15 dB, for fur 0.2 dB worse."""
LEVELS = 21
"""Of that octree."""


def groups_of(
    cloud: GaussianCloud, masses: np.ndarray, low_pass: np.ndarray, count: int, threads: int
) -> np.ndarray:
    """(n,) indices, 0 to count - 1, of the merged splats that each becomes part of; ``masses``: what each
    counts."""
    seen = mean_shadow(disc_areas(cloud.scales[masses > 0].astype(np.float64)))
    unit = float(np.sqrt(np.median(seen))) if len(seen) else 0.0
    unit = unit or float(low_pass.max()) or 1.0
    colors = cloud.colors.astype(np.float64)
    means = (cloud.means - np.median(cloud.means, axis=0).astype(np.float64)) / unit
    covariances = covariances_of(cloud) / unit**2
    # Differences finer than the filter, or than a share of the median splat, do not count. Otherwise, merging
    # flat or thin splats with anything beside them would have an unbounded cost.
    covariances[:, [0, 3, 5]] += np.square(np.maximum(low_pass / unit, FINEST))[:, None]
    all_moments = Moments(means, covariances, masses, colors)
    group, moments = np.arange(len(cloud)), all_moments
    if CLUMPED * count < len(cloud):
        clumped = clumps(means, masses, float(masses.sum()) / (CLUMPS * count))
        # Fewer clumps than are wanted come of few splats that count for almost all.
        if clumped.max() >= count - 1:
            group, moments = clumped, all_moments.together(Groups(clumped, masses))
    while True:
        part, left = _merge_neighbours(moments, count, threads)
        group = part[group]
        if left <= count:
            return group
        # Neighbours ran out. Among the few splats that are left, others are neighbours.
        moments = all_moments.together(Groups(group, masses))


def clumps(means: np.ndarray, masses: np.ndarray, most: float) -> np.ndarray:
    """(n,) indices of groups, in the order of their first members: the largest cells of an octree in which
    the ``masses`` (n,) of the points ``means`` (n, 3) add up to at most ``most``, and what is left, alone."""
    low, side = means.min(axis=0), float(np.ptp(means, axis=0).max())
    code = morton_codes(means, low, side or 1.0, LEVELS)
    order = np.argsort(code, kind="stable")
    code, sums = code[order], np.concatenate([[0.0], np.cumsum(masses[order])])
    first = np.arange(len(means))
    for _ in range(LEVELS + 1):
        starts = np.flatnonzero(np.concatenate([[True], code[1:] != code[:-1]]))
        ends = np.append(starts[1:], len(code))
        fits = np.repeat(sums[ends] - sums[starts] <= most, ends - starts)
        if not fits.any():
            break
        first[fits] = np.repeat(starts, ends - starts)[fits]
        code = code >> np.uint64(3)
    found = np.empty_like(order)
    found[order] = first
    return _in_order(found)


def _merge_neighbours(moments: Moments, count: int, threads: int) -> tuple[np.ndarray, int]:
    """(n,) indices of groups, in the order of their first members, and their count: ``count``, or more where
    neighbours ran out."""
    n = len(moments.means)
    neighbours = min(NEIGHBOURS, n - 1)
    order, near = nearest(moments.means, neighbours, threads)
    in_order = Moments(*(np.take(values, order, axis=0) for values in moments))
    found = np.empty(n, np.int32)
    merging = MergingStruct(
        count=n,
        wanted=count,
        neighbours=neighbours,
        threads=threads,
        means=pointer(in_order.means),
        covariances=pointer(in_order.covariances),
        masses=pointer(in_order.masses),
        colors=pointer(in_order.colors),
        nearest=pointer(near),
        color_weight=COLOR_WEIGHT,
        group=pointer(found),
    )
    run("ms_merge_pairs", merging)
    group = np.empty(n, np.int64)
    group[order] = found
    return _in_order(group), merging.remaining


def _in_order(group: np.ndarray) -> np.ndarray:
    """The groups (n,), numbered in the order of their first members."""
    first, group = np.unique(group, return_index=True, return_inverse=True)[1:]
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[group]


class Moments(NamedTuple):
    """Moments and colours of n splats or groups, float64."""

    means: np.ndarray
    """(n, 3)"""
    covariances: np.ndarray
    """(n, 6) xx, xy, xz, yy, yz, zz."""
    masses: np.ndarray
    """(n,)"""
    colors: np.ndarray
    """(n, 3) RGB."""

    def together(self, groups: Groups) -> Moments:
        """The moments of each group: those of all its members together."""
        middle = groups.averages(self.means)
        apart = self.means - middle[groups.group]
        spread = apart[:, [0, 0, 0, 1, 1, 2]] * apart[:, [0, 1, 2, 1, 2, 2]]
        spread += self.covariances
        return Moments(middle, groups.averages(spread), groups.masses, groups.averages(self.colors))


class Groups:
    """Sums over the members of groups 0 to g - 1; members are added in the order of their rows."""

    def __init__(self, group: np.ndarray, masses: np.ndarray) -> None:
        self.group = group
        self.order = np.argsort(group, kind="stable")
        sizes = np.bincount(group)
        self.starts = np.cumsum(sizes) - sizes
        self.masses = self.sums(masses)
        total = self.masses[group]
        # In a group without mass, all members count alike.
        self.weights = np.where(
            total > 0, np.divide(masses, total, where=total > 0, out=np.zeros_like(masses)), 1 / sizes[group]
        )

    def sums(self, values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(np.take(values, self.order, axis=0), self.starts, axis=0)

    def averages(self, values: np.ndarray) -> np.ndarray:
        """(g, k) float64 means of ``values`` (n, k), weighted by mass."""
        return self.sums(self.weights[:, None] * values)


def covariances_of(cloud: GaussianCloud) -> np.ndarray:
    """(n, 6) float64 xx, xy, xz, yy, yz, zz."""
    axes = cloud.rotations.astype(np.float64)
    axes *= cloud.scales[:, None, :]
    return np.stack(
        [np.einsum("ij,ij->i", axes[:, i], axes[:, j]) for i in range(3) for j in range(i, 3)], axis=1
    )
