"""Places from which the splats look as they do in photographs: fine, and without holes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshsplats.viewpoints.sample import BINS, DIRECTIONS, Sample, merit

ROUNDS = (120, 80, 60)
"""Numbers of places: first all over the scene, then around the best ones so far."""
FEW = (48, 32, 20)
"""The same for a first impression."""
ANGLES = (0.003, 0.02)
"""The first places are as far from a splat as makes it look this large, radians."""
NATURAL = np.exp(np.arange(-7.0, -3.4, 0.25))
"""Angles among which the natural one is found."""
BOTH_SIDES = 1.6
"""Tolerance below an angle while the natural one is sought, in its logarithm: from where photographs were
taken, splats look alike."""
FINER = 4.0
"""The same afterwards: finer than in photographs is not bad."""
BEST = 40
"""Number of the best places that measurements are made of."""


@dataclass(frozen=True, eq=False)
class Places:
    """Places and how the scene looks from each in ``DIRECTIONS`` directions."""

    places: np.ndarray
    """(k, 3) float64, best first."""
    worth: np.ndarray
    """(k, DIRECTIONS) how much the view is like a photograph, 0 to 1."""
    alpha: np.ndarray
    """(k, DIRECTIONS) mean alpha."""
    depth: np.ndarray
    """(k, pixels) distances in the panoramas."""
    natural: float
    """Angle in radians that splats have in photographs, about."""

    def best(self) -> Places:
        """The best places."""
        part = slice(BEST)
        return Places(self.places[part], self.worth[part], self.alpha[part], self.depth[part], self.natural)


def best_of(worth: np.ndarray) -> np.ndarray:
    """(k,) worth of places: the mean of the best sixth of their directions, (k, DIRECTIONS)."""
    return np.sort(worth, axis=1)[:, -(DIRECTIONS // 6) :].mean(axis=1)


def natural_angle(shares: np.ndarray) -> float:
    """The angle at which the dozen best places show their splats most evenly.

    Args:
        shares: (k, DIRECTIONS, bins) of panoramas.
    """
    even = [np.sort(best_of(_weighed(shares, angle, BOTH_SIDES)))[-12:].mean() for angle in NATURAL]
    return float(NATURAL[int(np.argmax(even))])


def _weighed(shares: np.ndarray, natural: float, finer: float) -> np.ndarray:
    # not a matrix product, whose bits may depend on the number of threads
    return np.einsum("kdb,b->kd", shares, merit(BINS, natural, finer), optimize=False)


def find_places(sample: Sample, rounds: Sequence[int] = ROUNDS) -> Places:
    """Places along the normals of splats, as far away as their size says, then near the best ones; as many as
    the ``rounds`` say."""
    rng = np.random.default_rng(0)
    weight = sample.thin.opacities.astype(np.float64)
    weight = weight / weight.sum() if weight.sum() > 0 else np.full(len(weight), 1 / len(weight))
    places = np.empty((0, 3))
    shares: list[np.ndarray] = []
    alpha: list[np.ndarray] = []
    depth: list[np.ndarray] = []
    for number, count in enumerate(rounds):
        if number == 0:
            rows = rng.choice(len(weight), count, p=weight)
            away = sample.size[rows] / np.exp(
                rng.uniform(float(np.log(ANGLES[0])), float(np.log(ANGLES[1])), count)
            )
            away = np.minimum(away, 100 * sample.radius)
            toward = sample.normals[rows] + 0.5 * rng.normal(size=(count, 3)) @ sample.axes
            # A normal has no sign: towards the side that random numbers of the frame choose.
            chosen = rng.normal(size=(count, 3)) @ sample.axes
            side = np.sign(np.sum(sample.normals[rows] * chosen, axis=1, keepdims=True))
            toward = toward * side
            new = sample.means[rows] + away[:, None] * toward / np.linalg.norm(toward, axis=1, keepdims=True)
        else:
            worth = best_of(_weighed(np.array(shares), natural_angle(np.array(shares)), FINER))
            top = places[np.argsort(-worth, kind="stable")[: max(12, len(worth) // 5)]]
            apart = np.sort(np.linalg.norm(top[:, None] - top, axis=2), axis=1)[:, 4]
            pick = rng.integers(len(top), size=count)
            new = top[pick] + 0.5 * apart[pick, None] * (rng.normal(size=(count, 3)) @ sample.axes)
        places = np.concatenate([places, new])
        for seen in sample.panoramas(new):
            for values, value in zip((shares, alpha, depth), seen, strict=True):
                values.append(value)
    natural = natural_angle(np.array(shares))
    worth = _weighed(np.array(shares), natural, FINER)
    order = np.argsort(-best_of(worth), kind="stable")
    return Places(places[order], worth[order], np.array(alpha)[order], np.array(depth)[order], natural)
