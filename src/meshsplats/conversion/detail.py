"""Level of detail: more triangles for splats with a large footprint and error, within a fixed budget.

In images that just hold a scene, most splats cover less than a pixel, where an octagon looks like a square.
Most of the difference to the ground truth lies on the few splats that cover more, and on outlines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.choices import Look
from meshsplats.conversion.stars import STARS
from meshsplats.rendering.backward import TapeOptions
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.rendering.engine import scatter_to_vertices
from meshsplats.rendering.looks import draw_splats
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

LEVELS = ((3, 1), (4, 1), (6, 1), (8, 1), (8, 2), (12, 2), (12, 3), (16, 3))
"""Levels of detail: sides and rings of the ellipses, in the order of their triangle counts."""

TRIANGLES = np.array([(2 * rings - 1) * sides for sides, rings in LEVELS])
"""Triangle counts of the levels, ascending."""

FIRST_STAR = len(LEVELS) - len(STARS)
"""From this level on, thick splats become stars of as many triangles."""

LEAST = int(TRIANGLES[0])

POWER = 0.5
"""A splat gets triangles in proportion to this power of its need. If the error of a splat falls as
``triangles^-p``, the power ``1 / (1 + p)`` minimises the total error. Measured after fine-tuning, 0.5 is at
least as good as 0.7."""

IMAGES = (16, 64)
"""Least and greatest number of images to render: of an eighth of the cameras, evenly spread."""

AREA_SAMPLES = 2
"""Side of the grid of samples in each pixel of these images, for the look 'area'."""

SIDE = 400
"""Greatest side of these images. Visible pixels are counted in pixels of the cameras' own images."""

HIDDEN = 0.003
"""Splats with fewer visible pixels than this, for each image whose frustum holds them, get no triangles: they
lie inside a solid or behind others."""

MIN_VIEWS = 4
"""Only splats inside the frustum of at least this many cameras can count as hidden."""


FEWEST_IMAGES = 6
"""That are rendered, however little time there is; no splat counts as hidden by less than ``IMAGES``."""

GOLDEN = (5**0.5 - 1) / 2
"""The golden ratio: its multiples modulo 1 spread evenly, however many there are."""

OnImage = Callable[[int, int], bool]
"""Called after each image, with how many are rendered and how many there will be; returns whether to go
on."""


class Visibility(NamedTuple):
    """Visible pixels and error of n splats in images of a mesh."""

    pixels: np.ndarray
    """(n,) float64 visible pixels, sums of blending weights; mean over the images."""
    error: np.ndarray
    """(n,) float64: the same, each pixel weighted by its squared difference to the ground truth."""
    hidden: np.ndarray
    """(n,) bool: next to no visible pixels, though cameras look there."""

    @property
    def need(self) -> np.ndarray:
        """(n,) float64 need of triangles: geometric mean of visible pixels and error."""
        return np.sqrt(self.pixels * self.error)


def visibility(
    mesh: SplatMesh,
    means: np.ndarray,
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    look: Look,
    *,
    threads: int | None = None,
    on_image: OnImage | None = None,
) -> Visibility:
    """How visible each splat is to ``cameras``, and how large its error.

    Args:
        mesh: triangles of the splats; its ``face_splat`` are rows of ``means``.
        means: (n, 3) float32 centres of the splats.
        cloud: the splats that the ground truth is rendered from, in that ``look``.
        on_image: may end this early, after ``FEWEST_IMAGES`` images.
    """
    assert mesh.face_splat is not None
    n = len(means)
    splats = mesh.splats
    owner = splats.numbers[splats.of_vertex]
    triangles = mesh.triangles._replace(values=np.zeros((len(owner), 2), np.float32))
    pixels, error, views = np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
    samples = 1 if look == "splats" else AREA_SAMPLES
    drawing, options = CpuEngine(threads), TapeOptions((0, 0, 0), samples)
    fewest, most = IMAGES
    chosen = subsample(cameras, min(max(len(cameras) // 8, fewest), most))
    done = 0
    # In an order of which every beginning is evenly spread: multiples of the golden ratio.
    order = np.argsort(np.argsort(np.arange(len(chosen)) * GOLDEN % 1, kind="stable"), kind="stable")
    for own in (chosen[i] for i in order):
        camera = own.within(SIDE)
        rendering = drawing.tape(triangles, camera, options)
        # Colours over black and alpha: then no background hides a difference.
        target = draw_splats(cloud, camera, look, background=(0, 0, 0), samples=samples, threads=threads)
        square = np.square(rendering.color - target.color).sum(axis=2)
        square += np.square(rendering.alpha - target.alpha)
        sums = scatter_to_vertices(rendering, np.stack([np.ones_like(square), square], axis=2))
        own_pixels = own.width * own.height / (camera.width * camera.height)
        pixels += own_pixels * np.bincount(owner, sums[:, 0], n)
        error += own_pixels * np.bincount(owner, sums[:, 1], n)
        views += camera.sees(means)
        done += 1
        if on_image is not None and not on_image(done, len(chosen)) and done >= FEWEST_IMAGES:
            break
    # A few images do not tell what is hidden from others.
    told = done == len(chosen) or done >= fewest
    hidden = told & (pixels < HIDDEN * views) & (views >= MIN_VIEWS)
    return Visibility(pixels / done, error / done, hidden)


def choose_levels(need: np.ndarray, budget: int) -> np.ndarray:
    """(n,) int8 indices of ``LEVELS`` for splats of that ``need`` (n,), at most ``budget`` triangles in all.

    Only ratios of needs count. Raises ValueError if the lowest level does not fit.
    """
    if len(need) * LEAST > budget:
        raise ValueError(f"{len(need)} splats need at least {len(need) * LEAST} triangles, not {budget}")
    # The factor of proportionality at which each splat reaches each level: half way on a logarithmic scale.
    half_way = np.sqrt(TRIANGLES[1:] * TRIANGLES[:-1].astype(np.float64))
    with np.errstate(divide="ignore"):
        factors = half_way / np.maximum(need, 0)[:, None] ** POWER
    steps = len(half_way)
    order = np.argsort(factors, axis=None, kind="stable")
    order = order[np.isfinite(factors.ravel()[order])]
    spent = len(need) * LEAST + np.cumsum(np.diff(TRIANGLES)[order % steps])
    taken = order[: np.searchsorted(spent, budget, side="right")]
    return np.bincount(taken // steps, minlength=len(need)).astype(np.int8)
