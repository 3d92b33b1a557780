"""Photographs that are blurred or double, found before the first step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshsplats._common.arrays import spread_indices, subsample
from meshsplats.datasets.reduced import reduced_image
from meshsplats.datasets.views import View, ViewImage

LOOKED_AT = 300
"""Views, at most and evenly spread, that are looked at: each must be read."""
FEWEST = 10
"""Views that tell what is usual, at least."""
SHOWN = 5
"""Names in a message, at most."""
LINES = 150
"""Rows and columns of an image, at most and evenly spread, that are searched for edges."""
REACH = 5
"""Pixels that an edge is measured across."""
STRONGEST, LEAST_STEP, FEWEST_EDGES = 0.02, 12, 50
"""Share of the places that count as edges, least difference across one, of 255, and edges that are enough."""
BLURRED = 0.6
"""A photograph is blurred if its edges, across rows or columns, are less steep than usual by this factor, and
less than in nearly all others: smooth subjects have edges of all kinds."""
TINY, SMALL = 32, 128
"""Pixels along the sides of images by which duplicates are found, and told from neighbours..."""
DOUBLE = 0.01
"""... and their root mean square difference below which two photographs are one. Copies that were
compressed again have 0.003 and 0.005; neighbours in bonsai 0.08, and two of lego's, a third of a degree
apart, 0.004 and 0.016."""
CONTRAST = 0.03
"""Least standard deviation of a photograph that tells something."""
FENCE = 3.0
"""Outliers lie below the lower quartile by so many times the distance of the quartiles (Tukey 1977)."""


@dataclass(frozen=True)
class Suspects:
    """Names of photographs that do harm."""

    blurred: tuple[str, ...] = ()
    duplicates: tuple[tuple[str, str], ...] = ()
    """Pairs that are the same photograph."""

    def messages(self) -> list[str]:
        """A line about each kind that was found."""
        lines = []
        if self.blurred:
            lines.append(
                f"{_photographs(len(self.blurred))} blurred beside the others: {shortened(self.blurred)}."
                " Without, the mesh may be sharper; held out, they lower the scores"
            )
        if self.duplicates:
            names = [f"{one} and {other}" for one, other in self.duplicates]
            lines.append(
                f"duplicate photographs: {shortened(names)}. If one is held out, its score means nothing;"
                " if their cameras differ, one is wrong"
            )
        return lines


def _photographs(count: int) -> str:
    return "1 photograph is" if count == 1 else f"{count} photographs are"


def shortened(names: Sequence[str]) -> str:
    """The first of ``names``, and whether there are more."""
    return ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")


def find_suspects(views: Sequence[View]) -> Suspects:
    """Photographs of ``views`` that differ from the others as they should not."""
    looked_at = [views[i] for i in spread_indices(len(views), LOOKED_AT)]
    if len(looked_at) < FEWEST:
        return Suspects()
    steep, tiny = [], []
    for view in looked_at:
        image = view.load()
        steep.append(steepness(image))
        tiny.append(reduced_image(image, TINY, TINY).over((0, 0, 0)).ravel())
    names = [view.name for view in looked_at]
    return Suspects(
        tuple(name for name, low in zip(names, _are_low(np.array(steep)), strict=True) if low),
        tuple(
            (names[i], names[j])
            for i, j in alike(np.array(tiny))
            if _are_same(looked_at[i].load(), looked_at[j].load())
        ),
    )


def _are_low(values: np.ndarray) -> np.ndarray:
    """(n,) bool: which rows of ``values`` (n, k) have one that is below ``BLURRED`` of its column's median
    and an outlier there; nan is none."""
    found = np.zeros(len(values), bool)
    for column in values.T:
        known = column[~np.isnan(column)]
        if len(known) >= FEWEST:
            low, middle, high = np.quantile(known, (0.25, 0.5, 0.75))
            found |= column < min(BLURRED * middle, low - FENCE * (high - low))
    return found


def _are_same(one: ViewImage, other: ViewImage) -> bool:
    """Whether these are one photograph, as far as the smaller of them tells."""
    side = min(SMALL, *one.color.shape[:2], *other.color.shape[:2])
    first, second = (reduced_image(image, side, side) for image in (one, other))
    difference = first.over((0, 0, 0)) - second.over((0, 0, 0))
    # Pixels that are clear in both tell nothing: of a subject that is small, neighbours would be the same.
    shown = np.maximum(_shown(first), _shown(second)).mean()
    return bool(np.square(difference).mean() < DOUBLE**2 * shown)


def _shown(image: ViewImage) -> np.ndarray:
    """(h, w) float32, 0 to 1: how much of each pixel is opaque and counts."""
    opaque = np.ones(image.color.shape[:2], np.float32) if image.alpha is None else image.alpha
    return opaque if image.mask is None else opaque * image.mask


def steepness(image: ViewImage) -> np.ndarray:
    """(2,) how steep the strongest edges of ``image`` are along its rows and its columns: the median of the
    largest difference between two pixels as a share of that across ``REACH`` pixels. 1 / ``REACH``: edges are
    as wide as that, 1: as sharp as a pixel; nan: there are too few.

    What a photograph shows hardly matters, as each edge is compared with itself.
    """
    green = image.color[..., 1].astype(np.float32) * np.float32(1 if image.color.dtype == np.uint8 else 255)
    found = np.full(2, np.nan)
    for axis in (0, 1):
        lines = subsample(np.swapaxes(green, 0, axis), LINES)
        count = lines.shape[1] - REACH
        if count < 1:
            continue
        across = np.abs(lines[:, REACH:] - lines[:, :-REACH])
        near = np.abs(np.diff(lines, axis=1))
        most = np.max([near[:, k : k + count] for k in range(REACH)], axis=0)
        edges = across >= max(float(np.quantile(across, 1 - STRONGEST)), LEAST_STEP)
        if np.count_nonzero(edges) >= FEWEST_EDGES:
            found[axis] = np.median(most[edges] / across[edges])
    return found


def alike(images: np.ndarray) -> np.ndarray:
    """(m, 2) indices i < j of rows of ``images`` (n, k), values from 0 to 1, that are the same but for noise.
    Rows without contrast tell nothing."""
    exact = images.astype(np.float64)
    squares = np.square(exact).sum(axis=1)
    distance = (squares[:, None] + squares - 2 * exact @ exact.T) / exact.shape[1]
    shows = exact.std(axis=1) >= CONTRAST
    return np.argwhere(np.triu((distance < DOUBLE**2) & shows & shows[:, None], 1))
