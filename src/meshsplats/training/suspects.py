"""Photographs that are blurred, double or misplaced, found before the first step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshsplats._arrays import spread_indices, subsample
from meshsplats.datasets.reduced import reduced_image
from meshsplats.datasets.views import View, ViewImage
from meshsplats.mesh import SplatMesh
from meshsplats.rendering import render

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
TINY = 32
"""Pixels along the sides of images by which doubles are found..."""
DOUBLE = 0.01
"""... and their root mean square difference below which two photographs are one. Copies that were compressed
again have 0.005; neighbours in bonsai 0.08."""
FIT_SIDE, BLOCK = 120, 10
"""Longer side of the images in which cameras are checked, and of the blocks that are compared, in pixels."""
TEXTURE, FITS = 0.03, 0.5
"""Least standard deviation of a block of a photograph to say anything, and the correlation from which the
image of the start fits it."""
FEWEST_BLOCKS = 10
MISPLACED = 0.7
"""A camera is wrong if a share of its blocks fits that is less than usual by this factor, and lower than
others' by a fence, as some sets fit unevenly. It has left traces in the start: turned by 20 degrees,
photographs of saharov have 0.35 and 0.62 of what is usual."""
FENCES = (3.0, 1.5)
"""Outliers, of steepness and of fit, lie below the lower quartile by so many times the distance of the
quartiles (Tukey 1977)."""


@dataclass(frozen=True)
class Suspects:
    """Names of photographs that do harm."""

    blurred: tuple[str, ...] = ()
    doubles: tuple[tuple[str, str], ...] = ()
    """Pairs that are the same photograph."""
    misplaced: tuple[str, ...] = ()
    """Their cameras do not fit those of the others."""

    def messages(self) -> list[str]:
        """A line about each kind that was found."""
        lines = []
        if self.blurred:
            lines.append(
                f"{_photographs(len(self.blurred))} blurred beside the others: {_listed(self.blurred)}."
                " Without, the mesh may be sharper"
            )
        if self.doubles:
            names = [f"{one} and {other}" for one, other in self.doubles]
            lines.append(
                f"the same photograph twice: {_listed(names)}. If one is held out, its score means nothing;"
                " if their cameras differ, one is wrong"
            )
        if self.misplaced:
            whose = "its camera says" if len(self.misplaced) == 1 else "their cameras say"
            lines.append(
                f"{_photographs(len(self.misplaced))} not where {whose}: {_listed(self.misplaced)}."
                " Without, the mesh may be better"
            )
        return lines


def _photographs(count: int) -> str:
    return "1 photograph is" if count == 1 else f"{count} photographs are"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")


def find_suspects(mesh: SplatMesh, views: Sequence[View], threads: int | None = None) -> Suspects:
    """Photographs of ``views`` that differ from the others as they should not. ``mesh``: the fans that a
    training starts from, which show roughly what they do."""
    looked_at = [views[i] for i in spread_indices(len(views), LOOKED_AT)]
    if len(looked_at) < FEWEST:
        return Suspects()
    steep, tiny, fit = [], [], []
    for view in looked_at:
        image = view.load()
        steep.append(steepness(image))
        tiny.append(reduced_image(image, TINY, TINY).over((0, 0, 0)).ravel())
        fit.append(fitting_share(mesh, view, image, threads))
    names = [view.name for view in looked_at]
    blurred = _below(np.array(steep), BLURRED, FENCES[0])
    misplaced = _below(np.array(fit)[:, None], MISPLACED, FENCES[1])
    return Suspects(
        tuple(name for name, low in zip(names, blurred, strict=True) if low),
        tuple((names[i], names[j]) for i, j in alike(np.array(tiny))),
        tuple(name for name, low in zip(names, misplaced, strict=True) if low),
    )


def _below(values: np.ndarray, share: float, fence: float) -> np.ndarray:
    """(n,) bool: which rows of ``values`` (n, k) have one that is below this share of its column's median and
    an outlier there by this ``fence``; nan is none."""
    found = np.zeros(len(values), bool)
    for column in values.T:
        known = column[~np.isnan(column)]
        if len(known) >= FEWEST:
            low, middle, high = np.quantile(known, (0.25, 0.5, 0.75))
            found |= column < min(share * middle, low - fence * (high - low))
    return found


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
    shows = exact.std(axis=1) >= TEXTURE
    return np.argwhere(np.triu((distance < DOUBLE**2) & shows & shows[:, None], 1))


def fitting_share(mesh: SplatMesh, view: View, image: ViewImage, threads: int | None = None) -> float:
    """Share of the blocks of ``image``, that of ``view``, in which ``mesh`` shows the same pattern; nan if
    too few have any."""
    camera = view.camera.within(FIT_SIDE)
    small = reduced_image(image, camera.width, camera.height)
    drawn = render(mesh, camera, background=view.background, threads=threads).color
    one, other = (_blocks(pixels.mean(axis=2)) for pixels in (small.over(view.background), drawn))
    counts = one.std(axis=1) >= TEXTURE
    if small.mask is not None:
        counts &= _blocks(small.mask).all(axis=1)
    if np.count_nonzero(counts) < FEWEST_BLOCKS:
        return float("nan")
    one, other = (part[counts] - part[counts].mean(axis=1, keepdims=True) for part in (one, other))
    scale = np.sqrt(np.square(one).sum(axis=1) * np.square(other).sum(axis=1))
    return float(((one * other).sum(axis=1) > FITS * scale).mean())


def _blocks(image: np.ndarray) -> np.ndarray:
    """(n, BLOCK * BLOCK) pixels of the whole blocks of ``image`` (h, w)."""
    rows, columns = (side // BLOCK for side in image.shape)
    whole = image[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
    return whole.swapaxes(1, 2).reshape(rows * columns, BLOCK * BLOCK)
