"""Thick splats as stars: ellipses around one centre, in planes that are evenly spread over all directions.

A single ellipse is narrow from the side, where its splat is not. Of the ellipses of a star, some face every
viewer, so it looks alike from everywhere, as the splat does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshsplats._common.geometry import level_axes
from meshsplats.conversion.fans import Pattern, Shape

RADIUS = 2.6
"""Radius of a star in standard deviations: of the circle that has the area of each ellipse."""

OPACITIES = np.array([0, 0.02, 0.25, 0.5, 0.75, 0.9, 0.99])
"""Opacities of splats for which those of stars are tabulated."""

CENTERS = {
    6: np.array([0, 0.0052, 0.070, 0.155, 0.257, 0.328, 0.373]),
    10: np.array([0, 0.0032, 0.043, 0.095, 0.159, 0.203, 0.231]),
}
"""By the number of ellipses, and for splats of ``OPACITIES``, the opacity at the centre of each ellipse for
which the star has the least squared difference from the splat's ``o exp(-r^2 / 2)``, over the image and over
all directions. Where ellipses overlap, their opacities add up as ``1 - (1 - a) (1 - b)``, so it is not in
proportion to the splat's."""


@dataclass(frozen=True)
class StarProfile:
    """Opacities of a star: those of its ellipses fall linearly from the centre to 0 on the rim."""

    ellipses: int
    radius: float
    """Of the rims' corners, in standard deviations."""

    @property
    def level_radii(self) -> tuple[float, ...]:
        return (0.0, self.radius)

    def level_opacities(self, opacity: np.ndarray) -> np.ndarray:
        center = np.interp(opacity, OPACITIES, CENTERS[self.ellipses])
        return np.stack([center, np.zeros_like(center)]).astype(np.float32)


def star(ellipses: int, sides: int) -> Shape:
    """6 or 10 ellipses of ``sides`` triangles, across the axes of an icosahedron or a dodecahedron."""
    turn = 2 * np.pi * np.arange(sides) / sides
    points, faces = [np.zeros((1, 3))], []
    for k, axis in enumerate(_axes(ellipses)):
        first, second = level_axes(axis)
        points.append(np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
        rim = 1 + k * sides + np.arange(sides)
        faces.append(np.stack([np.zeros_like(rim), rim, np.roll(rim, -1)], axis=1))
    directions = np.concatenate(points)
    level = np.ones(len(directions), int)
    level[0] = 0
    polygon = sides * np.sin(2 * np.pi / sides) / 2
    profile = StarProfile(ellipses, RADIUS * float(np.sqrt(np.pi / polygon)))
    return Shape(
        Pattern(directions, level, np.concatenate(faces).astype(np.int32), ellipses),
        profile,
        fits_projection=True,
    )


def _axes(count: int) -> np.ndarray:
    """(count, 3) unit vectors to the corners of an icosahedron (6) or a dodecahedron (10), one of each two
    that are opposite."""
    golden = (1 + np.sqrt(5)) / 2
    a, b = (1, golden) if count == 6 else (1 / golden, golden)
    axes = [(0, a, b), (0, a, -b), (b, 0, a), (-b, 0, a), (a, b, 0), (a, -b, 0)]
    if count == 10:
        axes += [(1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)]
    return np.array(axes) / np.linalg.norm(axes, axis=1, keepdims=True)


STARS = (star(6, 4), star(6, 6), star(6, 10), star(10, 8))
"""Stars of 24, 36, 60 and 80 triangles: as many as the ellipses of the highest levels of detail have."""
