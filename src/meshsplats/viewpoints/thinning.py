"""Some splats that stand for all: few of many small ones, each as much wider."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshsplats.scene.gaussians import GaussianCloud

POOL = 1_250_000
"""Splats among which the ones that a place shows are chosen, about."""
LEAST_LIKELY = 1e-3
"""Least probability with which a splat is chosen."""
SOME = 16
ROUNDS = 12
"""Probabilities are scaled so often until their sum is right, for every so many of the splats."""


def largest(values: np.ndarray) -> np.ndarray:
    """(n,) the largest of each row of ``values`` (n, 3): as numpy's ``max`` along the axis, but faster."""
    return np.maximum(np.maximum(values[:, 0], values[:, 1]), values[:, 2])


def sizes_of(scales: np.ndarray) -> np.ndarray:
    """(n,) float32 sizes of splats: the geometric mean of their two larger standard deviations (n, 3)."""
    most = largest(scales)
    middle = scales.sum(axis=1) - most + largest(-scales)
    with np.errstate(over="ignore"):  # of splats that no image shows
        return np.sqrt(np.maximum(middle, 0) * most) + np.finfo(np.float32).tiny


def without_harmonics(cloud: GaussianCloud, rows: slice | np.ndarray) -> GaussianCloud:
    """Some splats of a cloud, without the harmonics that only colours need: most of its memory. Without
    ``up``."""
    return GaussianCloud(
        cloud.means[rows],
        cloud.quaternions[rows],
        cloud.scales[rows],
        cloud.opacities[rows],
        cloud.sh[rows, :1],
        cloud.kernel,
        origin=cloud.origin,
    )


class ByPlace:
    """Chooses the splats of a large scene that panoramas show, anew for each place.

    A sample in which all splats are equally likely, wide enough to close surfaces, shows a capture of ten
    million as lumps: coarse noise stays closed, and fine surfaces get holes. Here the probability of a splat
    grows with the angle at which it is seen, so what is near and what is large keeps its shape.
    """

    def __init__(self, cloud: GaussianCloud, most: int) -> None:
        """``most``: the number of splats for a place, about."""
        self.most = most
        rng = np.random.default_rng(0)
        likely = probabilities(sizes_of(cloud.scales) * cloud.opacities, POOL)
        rows = np.flatnonzero(rng.random(len(cloud)) < likely)
        self.pool = without_harmonics(cloud, rows)
        self._columns = np.ascontiguousarray(self.pool.means.T)
        self.stands_for = 1 / likely[rows]
        """How many splats each of the pool stands for."""
        self.size = sizes_of(self.pool.scales).astype(np.float64)
        self.area = (self.size**2 * self.pool.opacities * self.stands_for).astype(np.float32)
        self.lot = rng.random(len(rows), np.float32)

    def seen_from(self, place: np.ndarray, near: float) -> tuple[GaussianCloud, np.ndarray]:
        """The splats to show from ``place`` (3,), widened; and their sizes (k,) before that."""
        x, y, z = self._columns - place.astype(np.float32)[:, None]
        angle = self.area / np.maximum(x * x + y * y + z * z, np.float32(near) ** 2)
        likely = probabilities(angle, self.most)
        rows = np.flatnonzero(self.lot < likely)
        thin = self.pool.take(rows)
        wider = (self.stands_for[rows] / likely[rows]).astype(np.float32)[:, None] ** 0.5
        thickness = -largest(-thin.scales)[:, None]
        scales = np.where(thin.scales > thickness, thin.scales * wider, thin.scales)
        return replace(thin, scales=scales), self.size[rows]


def probabilities(value: np.ndarray, count: int) -> np.ndarray:
    """(n,) probabilities in proportion to ``value`` (n,), with a sum of about ``count``."""
    if count >= len(value):
        return np.ones(len(value))
    likely: np.ndarray = np.clip(value * _factor(value[::SOME], count / len(value)), LEAST_LIKELY, 1)
    return likely


def _factor(value: np.ndarray, mean: float) -> float:
    """By what to multiply ``value`` (n,) so that clipped to probabilities it has about this ``mean``."""
    factor = mean / max(float(value.mean()), np.finfo(np.float64).tiny)
    for _ in range(ROUNDS):  # those that are certain leave more for the others
        factor *= mean / float(np.clip(factor * value, LEAST_LIKELY, 1).mean())
    return factor
