"""Whether photographs differ in exposure or white balance, by what each gains from a fit of its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.datasets.reduced import reduced_views
from meshsplats.datasets.views import ImageCache, View
from meshsplats.evaluation.report import exposure_between
from meshsplats.rendering import render
from meshsplats.scene.mesh import SplatMesh

VIEWS, SIDE = 24, 200
"""Maximum number of views, evenly spread, that are looked at, and of pixels along their longer side."""
BLOCK = 16
"""Pixels along a side of the squares that are fitted and judged by turns, as on a chessboard."""
FEWEST_VIEWS, FEWEST_PIXELS = 3, 200
"""Views needed to decide, and pixels of either colour of the chessboard."""
CHANGES = 0.7
"""Exposures differ where a fit leaves less than this share of the median view's squared error. At the start
of a training: 0.89 to 0.99 in four data sets and two own scenes of constant light, 0.38 to 0.69 in these
with gains from 0.6 to 1. dtu65 is on the border, with 0.67 to 0.72: its light changes little, view-dependent
colours suffice, and its held-out photographs, of which no exposure is known, have 30.0 dB without the fit,
29.5 with it."""


def exposures_differ(mesh: SplatMesh, views: Sequence[View], threads: int | None = None) -> bool:
    """Whether ``views`` differ in exposure or white balance; ``mesh`` shows roughly what they do.

    A gain and an offset per channel are fitted to one half of each photograph, and judged on the other.
    """
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    small = reduced_views(subsample(views, VIEWS), min(1.0, SIDE / longest), ImageCache(0))
    left = [share for view in small if (share := _error_left(mesh, view, threads)) is not None]
    return len(left) >= FEWEST_VIEWS and float(np.median(left)) < CHANGES


def _error_left(mesh: SplatMesh, view: View, threads: int | None) -> float | None:
    """The share of the squared error of the image of ``mesh`` that is left after the fit, on the half of its
    pixels that was not fitted; None if there are too few."""
    image, target = render(mesh, view.camera, background=view.background, threads=threads).color, view.image
    counted = np.ones(image.shape[:2], bool) if view.mask is None else view.mask.copy()
    if view.alpha is not None:
        counted &= view.alpha == 1
    y, x = np.indices(counted.shape) // BLOCK
    fitted, judged = (counted & ((x + y) % 2 == turn) for turn in (0, 1))
    if min(np.count_nonzero(fitted), np.count_nonzero(judged)) < FEWEST_PIXELS:
        return None
    gain, offset = exposure_between(image, target, fitted)
    before = np.square(image[judged] - target[judged]).sum(dtype=np.float64)
    after = np.square(image[judged] * gain + offset - target[judged]).sum(dtype=np.float64)
    return float(after / before) if before > 0 else 1.0
