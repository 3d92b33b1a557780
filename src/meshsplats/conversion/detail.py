"""More triangles for splats that show large and wrong, fewer for those that show little, and as many in all.

In pictures that just hold a scene, most splats show less than a pixel, where no one can tell an octagon from
a square, and most of the difference to the splats' own picture lies on the few that show large, and on
outlines.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from meshsplats._arrays import evenly
from meshsplats.camera import Camera
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.backward import TapedRendering
from meshsplats.rendering.looks import Look, draw_splats

LEVELS = ((3, 1), (4, 1), (6, 1), (8, 1), (8, 2), (12, 2), (12, 3), (16, 3))
"""Sides and rings of the ellipses to choose from, by their number of triangles."""

TRIANGLES = np.array([(2 * rings - 1) * sides for sides, rings in LEVELS])
"""Their numbers of triangles, ascending."""

LEAST = int(TRIANGLES[0])

POWER = 0.5
"""A splat gets triangles in proportion to this power of its need. If the error that is left on a splat falls
as ``triangles^-p``, ``1 / (1 + p)`` leaves the least in all. Measured after fine-tuning, 0.5 is at least as
good as 0.7."""

PICTURES = (16, 64)
"""Fewest and most pictures that are looked at: of an eighth of the cameras, evenly spread."""

AREA_SAMPLES = 2
"""Side of the grid of samples in each pixel of these pictures, for the look 'area'."""

SIDE = 400
"""Greatest side of these pictures. What they show is counted in pixels of the cameras' own."""

HIDDEN = 0.003
"""Splats that show less than this, in pixels a picture that has them before it, get no triangles: they lie
inside a solid or behind others."""

LOOKED_AT = 4
"""Only those that at least so many pictures have before them: they could have been shown."""


class Visibility(NamedTuple):
    """What pictures of a mesh show of n splats."""

    pixels: np.ndarray
    """(n,) float64 pixels, sums of blending weights, in the mean of all pictures."""
    error: np.ndarray
    """(n,) float64 of these, times the square of the pixels' difference to the splats' own picture."""
    hidden: np.ndarray
    """(n,) bool: next to nothing, though pictures look there."""

    @property
    def need(self) -> np.ndarray:
        """(n,) float64 of triangles: the geometric mean of what shows and what is wrong in it."""
        return np.sqrt(self.pixels * self.error)


def visibility(
    mesh: SplatMesh, means: np.ndarray, cloud: GaussianCloud, cameras: Sequence[Camera], look: Look
) -> Visibility:
    """What ``cameras`` show of the splats with centres ``means`` (n, 3), whose rows ``mesh.face_splat``
    numbers; the images should be those of ``cloud`` in that ``look``."""
    assert mesh.face_splat is not None
    n = len(means)
    owner = np.zeros(len(mesh.vertices), np.int64)
    owner[mesh.faces.ravel()] = np.repeat(mesh.face_splat, 3)
    pixels, error, looked_at = np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
    samples = 1 if look == "splats" else AREA_SAMPLES
    fewest, most = PICTURES
    chosen = evenly(cameras, min(max(len(cameras) // 8, fewest), most))
    for own in chosen:
        camera = own.within(SIDE)
        picture = TapedRendering(
            mesh.vertices,
            mesh.faces,
            mesh.colors,
            np.zeros((len(owner), 2), np.float32),
            camera,
            background=(0, 0, 0),
            samples=samples,
            face_splat=mesh.face_splat,
            filter_px2=mesh.filter_px2,
        )
        # Over black, and in opacity: then no background hides a difference.
        truth = draw_splats(cloud, camera, look, background=(0, 0, 0), samples=samples)
        square = np.square(picture.color - truth.color).sum(axis=2) + np.square(picture.alpha - truth.alpha)
        sums = picture.spread(np.stack([np.ones_like(square), square], axis=2))
        of_own = own.width * own.height / (camera.width * camera.height)
        pixels += of_own * np.bincount(owner, sums[:, 0], n)
        error += of_own * np.bincount(owner, sums[:, 1], n)
        looked_at += camera.sees(means)
    hidden = (pixels < HIDDEN * looked_at) & (looked_at >= LOOKED_AT)
    return Visibility(pixels / len(chosen), error / len(chosen), hidden)


def choose_levels(need: np.ndarray, budget: int) -> np.ndarray:
    """(n,) int8 numbers of LEVELS for splats with such a need, of which only ratios count; at most ``budget``
    triangles in all.

    ValueError if not even the least fit.
    """
    if len(need) * LEAST > budget:
        raise ValueError(f"{len(need)} splats need at least {len(need) * LEAST} triangles, not {budget}")
    # The level rises with the factor of proportionality, from one to the next half way on a scale of ratios.
    half_way = np.sqrt(TRIANGLES[1:] * TRIANGLES[:-1].astype(np.float64))
    with np.errstate(divide="ignore"):
        factors = half_way / np.maximum(need, 0)[:, None] ** POWER
    steps = len(half_way)
    order = np.argsort(factors, axis=None, kind="stable")
    order = order[np.isfinite(factors.ravel()[order])]
    spent = len(need) * LEAST + np.cumsum(np.diff(TRIANGLES)[order % steps])
    taken = order[: np.searchsorted(spent, budget, side="right")]
    return np.bincount(taken // steps, minlength=len(need)).astype(np.int8)
