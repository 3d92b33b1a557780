"""More triangles for splats that show large, fewer for those that show little, and as many in all.

In pictures that just hold a scene, most splats show less than a pixel, where no one can tell an octagon from
a square, and most of the difference to the splats' own picture lies on the few that show large.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from meshsplats._arrays import evenly
from meshsplats.camera import Camera
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.recorded import shown_pixels

LEVELS = ((3, 1), (4, 1), (6, 1), (8, 1), (8, 2), (12, 2), (12, 3), (16, 3))
"""Sides and rings of the ellipses to choose from, by their number of triangles."""

TRIANGLES = np.array([(2 * rings - 1) * sides for sides, rings in LEVELS])
"""Their numbers of triangles, ascending."""

LEAST = int(TRIANGLES[0])

POWER = 0.5
"""A splat gets triangles in proportion to this power of the pixels that it shows. If the error that is left
on a splat falls as ``triangles^-p``, ``1 / (1 + p)`` leaves the least in all. Measured after fine-tuning, 0.5
is at least as good as 0.7."""

PICTURES = (16, 64)
"""Fewest and most pictures that are looked at: of an eighth of the cameras, evenly spread."""

SIDE = 400
"""Greatest side of these pictures. What they show is counted in pixels of the cameras' own."""

HIDDEN = 0.003
"""Splats that show less than this, in pixels a picture that has them before it, get no triangles: they lie
inside a solid or behind others."""

LOOKED_AT = 4
"""Only those that at least so many pictures have before them: they could have been shown."""


class Shown(NamedTuple):
    """What pictures show of n splats."""

    pixels: np.ndarray
    """(n,) float64 pixels, sums of blending weights, in the mean of all pictures."""
    hidden: np.ndarray
    """(n,) bool: next to nothing, though pictures look there."""


def look(mesh: SplatMesh, means: np.ndarray, cameras: Sequence[Camera]) -> Shown:
    """What ``cameras`` show of the splats with centres ``means`` (n, 3), whose rows ``mesh.face_splat``
    numbers."""
    assert mesh.face_splat is not None
    owner = np.zeros(len(mesh.vertices), np.int64)
    owner[mesh.faces.ravel()] = np.repeat(mesh.face_splat, 3)
    pixels, looked_at = np.zeros(len(means)), np.zeros(len(means), np.int64)
    fewest, most = PICTURES
    chosen = evenly(cameras, min(max(len(cameras) // 8, fewest), most))
    for own in chosen:
        camera = own.within(SIDE)
        shown = shown_pixels(mesh.vertices, mesh.faces, mesh.colors, camera, face_splat=mesh.face_splat)
        of_own = own.width * own.height / (camera.width * camera.height)
        pixels += of_own * np.bincount(owner, shown, len(means))
        looked_at += camera.sees(means)
    return Shown(pixels / len(chosen), (pixels < HIDDEN * looked_at) & (looked_at >= LOOKED_AT))


def choose_levels(shown: np.ndarray, budget: int) -> np.ndarray:
    """(n,) int8 numbers of LEVELS for splats that show so many pixels; at most ``budget`` triangles in all.

    ValueError if not even the least fit.
    """
    if len(shown) * LEAST > budget:
        raise ValueError(f"{len(shown)} splats need at least {len(shown) * LEAST} triangles, not {budget}")
    # The level rises with the factor of proportionality, from one to the next half way on a scale of ratios.
    half_way = np.sqrt(TRIANGLES[1:] * TRIANGLES[:-1].astype(np.float64))
    with np.errstate(divide="ignore"):
        factors = half_way / np.maximum(shown, 0)[:, None] ** POWER
    steps = len(half_way)
    order = np.argsort(factors, axis=None, kind="stable")
    order = order[np.isfinite(factors.ravel()[order])]
    spent = len(shown) * LEAST + np.cumsum(np.diff(TRIANGLES)[order % steps])
    taken = order[: np.searchsorted(spent, budget, side="right")]
    return np.bincount(taken // steps, minlength=len(shown)).astype(np.int8)
