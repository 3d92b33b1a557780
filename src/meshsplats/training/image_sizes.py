"""How large images of photographs are in training, by the time there is."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from meshsplats._common.choices import Masks, Missing
from meshsplats.datasets.folder import MOST_DOWNSCALE, load_dataset
from meshsplats.errors import DataWarning

PIXELS_PER_MINUTE = 40_000
"""Pixels of a photograph that are worth while for each minute of a run and each of its threads. At the whole
size, a phone's 43 photographs of 1080 x 1920 pixels become better in two minutes of two processors at a
quarter of the sides than at a half (29.9 and 29.4 dB), in five at a half than whole (31.2, 30.4)."""
MOST_PIXELS = 2_100_000
"""Pixels of a photograph that are worth while for any run: about those of 1600 columns, which 3DGS has."""


def worthwhile_downscale(
    folder: Path,
    minutes: float | None,
    threads: int | None,
    missing: Missing = "few",
    masks: Masks = "count",
) -> int:
    """The factor by which the images of the photographs in ``folder`` should be smaller than these: the whole
    one that comes nearest to the sides of the pixels that are worth while. So 2.25 times as many stay whole:
    a quarter of them, by the next factor, would be further from these. Where sizes differ, that of the median
    counts, so that one large photograph does not make all others small.

    Args:
        folder, missing, masks: as in ``load_dataset``, which does not warn here.
        minutes: length of the run; None: as long as it takes.
        threads: number of threads; None: without limit, on a graphics card.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        views = load_dataset(folder, missing=missing, masks=masks).views
    pixels = float(np.median([view.camera.width * view.camera.height for view in views]))
    affordable = MOST_PIXELS
    if minutes is not None and threads is not None:
        affordable = min(affordable, max(1, int(PIXELS_PER_MINUTE * minutes * threads)))
    return min(max(1, round((pixels / affordable) ** 0.5)), MOST_DOWNSCALE)
