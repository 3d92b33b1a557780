"""Profiles of opacity from the centre of a fan to its rim, and the one closest to a Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np


@dataclass(frozen=True)
class Profile:
    """Concentric regular polygons of one orientation; opacity is linear between them.

    Concretely, a splat of opacity o has opacity ``opacities[0] * o`` at its centre and ``opacities[j] * o``
    on ring j, whose corners are ``radii[j - 1]`` standard deviations away.
    """

    sides: int
    """Corners of each ring, at least 3."""
    radii: tuple[float, ...]
    """Radius of each ring in standard deviations, ascending; the last is the rim."""
    opacities: tuple[float, ...]
    """Opacity at the centre and on each ring, as a multiple of the splat's."""

    @property
    def rings(self) -> int:
        return len(self.radii)

    @property
    def level_radii(self) -> tuple[float, ...]:
        """Of centre and rings, in standard deviations."""
        return (0.0, *self.radii)

    def level_opacities(self, opacity: np.ndarray) -> np.ndarray:
        """(1 + rings, n) float32 opacities of centre and rings, clamped to [0, 1], for splats of ``opacity``
        (n,). A ring between a rim that must have an opacity and the centre may be fitted below 0."""
        return np.clip(np.array(self.opacities, np.float32)[:, None] * opacity, 0, 1).astype(np.float32)

    def __call__(self, radius: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Opacity (as a multiple of the splat's) at polar positions: radius in sigma, angle from a corner."""
        turn = np.pi / self.sides
        # The rings are similar polygons: in a sector, opacity depends only on the distance along the middle
        # of its edge, here as the radius of the ring that passes through the point.
        from_edge = np.mod(angle, 2 * turn) - turn
        ring = radius * np.cos(from_edge) / np.cos(turn)
        return np.interp(ring, (0.0, *self.radii), self.opacities, right=0.0)


def _grid(sides: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quadrature over half a sector, which suffices by symmetry: ring radii, Gaussian and weights."""
    turn = np.pi / sides
    nodes, node_weights = np.polynomial.legendre.leggauss(10)
    angle = (nodes + 1) * turn / 2
    step = 0.01
    radius = np.arange(step / 2, 7, step)
    weight = step * radius[:, None] * (node_weights * turn / 2)
    ring = radius[:, None] * np.cos(angle) / np.cos(turn)
    gaussian = np.broadcast_to(np.exp(-0.5 * radius[:, None] ** 2), ring.shape)
    return ring.ravel(), gaussian.ravel(), weight.ravel()


def fidelity(profile: Profile) -> tuple[float, float]:
    """Relative L2 error against ``exp(-r^2 / 2)`` over the plane, and integrated opacity divided by that
    Gaussian's, 2 pi."""
    ring, gaussian, weight = _grid(profile.sides)
    drawn = np.interp(ring, (0.0, *profile.radii), profile.opacities, right=0.0)
    error = np.sqrt(weight @ (drawn - gaussian) ** 2 / (weight @ gaussian**2))
    return float(error), float(weight @ drawn / (weight @ gaussian))


@lru_cache(maxsize=64)
def fit_profile(
    sides: int,
    rings: int = 1,
    *,
    rim_radius: float | None = None,
    rim_opacity: float = 0.0,
    center_opacity: float | None = None,
    conserve: bool = False,
) -> Profile:
    """The profile of least squared error against the Gaussian falloff ``exp(-r^2 / 2)`` over the plane.

    Radii and the opacities of centre and inner rings are fitted where they are None. For fixed radii the
    opacities solve a small linear system; the radii are found by coordinate descent.

    Args:
        sides, rings: as in ``Profile``.
        rim_radius: in standard deviations; None: fitted.
        rim_opacity, center_opacity: as multiples of the splat's; ``center_opacity`` None: fitted.
        conserve: keep the integrated opacity at the Gaussian's 2 pi, if an opacity is fitted: many faint
            layers then add up to the right opacity.
    """
    ring, gaussian, weight = _grid(sides)
    fixed = {rings: rim_opacity}
    if center_opacity is not None:
        fixed[0] = center_opacity
    free = [j for j in range(rings + 1) if j not in fixed]

    def solve(radii: np.ndarray) -> tuple[float, np.ndarray]:
        knots = np.concatenate([[0.0], radii])
        hats = np.stack([np.interp(ring, knots, np.eye(rings + 1)[j], right=0.0) for j in range(rings + 1)])
        rest = gaussian - sum(value * hats[j] for j, value in fixed.items())
        values = np.zeros(rings + 1)
        for j, value in fixed.items():
            values[j] = value
        if free:
            basis = hats[free]
            normal, right = (basis * weight) @ basis.T, (basis * weight) @ rest
            if conserve:  # Lagrange multiplier of the one linear condition
                mass = basis @ weight
                normal = np.block([[normal, mass[:, None]], [mass, np.zeros(1)]])
                right = np.append(right, weight @ rest)
            values[free] = np.linalg.solve(normal, right)[: len(free)]
            rest = rest - values[free] @ basis
        return float(weight @ rest**2), values

    outer = 2.6 + 0.4 * min(rings - 1, 2) if rim_radius is None else rim_radius
    radii = outer * (np.arange(1, rings + 1) / rings) ** 0.7
    moving = list(range(rings if rim_radius is None else rings - 1))
    error, values = solve(radii)
    step = 0.2
    while step > 2e-4:
        improved = False
        for j in moving:
            for change in (step, -step):
                tried = radii.copy()
                tried[j] += change
                if tried[0] < 0.05 or (np.diff(tried) < 0.05).any() or tried[-1] > 6:
                    continue
                found, opacities = solve(tried)
                if found < error:
                    error, radii, values, improved = found, tried, opacities, True
        if not improved:
            step /= 2
    return Profile(sides, tuple(map(float, radii)), tuple(map(float, values)))
