"""Whether photographs are cut out: their alpha leaves out what is behind the subject."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.datasets.photo_file import PhotoFile
from meshsplats.datasets.views import SHOWN, Dataset, View, ViewImage
from meshsplats.errors import DataWarning

OPAQUE = 0.5
"""Alpha from which a pixel belongs to the silhouette."""
CLEAR = 0.1
"""Share of an image that is clear, at least, where a subject is cut out: tools that turn photographs clear
their corners."""
MOST = 0.5
"""Share of the views that are cut out, at least, where a subject is: one that is not in the way of the others
rules out what these show."""
LOOKED_AT = 24
"""Views with alpha, at most and evenly spread, that tell: each must be read."""
RIM, RIM_SIDE = 2, 200
"""Distance from the outline, in pixels of an image with at least such a longer side, at which the rim of a
subject begins, and its width."""
WHOLE = 0.999
"""Alpha from which nothing behind a pixel shows in its colour."""


@dataclass(frozen=True, eq=False)
class MaskedImage:
    """The image of ``view`` without alpha: pixels that are not wholly opaque do not count."""

    view: View

    def load(self) -> ViewImage:
        image = self.view.load()
        if image.alpha is None:
            return image
        mask = image.alpha >= WHOLE * _unit(image)
        if image.mask is not None:
            mask &= image.mask
        return ViewImage(image.color, None, None if mask.all() else mask)

    @property
    def nbytes(self) -> int:
        """Upper bound of the memory of the image in bytes."""
        return self.view.source.nbytes + self.view.camera.width * self.view.camera.height


def has_silhouettes(views: Sequence[View]) -> bool:
    """Whether ``MOST`` of ``views`` are cut out: ``CLEAR`` of their image is clear, or the mask of a subject
    leaves out any of it."""
    candidates = [view for view in views if has_alpha(view)]
    if not candidates or len(candidates) < MOST * len(views):
        return False
    some = subsample(candidates, LOOKED_AT)
    return sum(map(_is_cut_out, some)) * len(candidates) >= MOST * len(views) * len(some)


def outline_brightness(views: Sequence[View]) -> float:
    """Mean display brightness, 0 to 1, of the subject along its outline in ``views``, which are cut out; 0.5
    where there is none. The outermost pixels, in which photographs mix it with what was behind, do not
    count."""
    total, count = 0.0, 0
    for view in subsample(views, LOOKED_AT):
        image = view.load()
        if image.alpha is None:
            continue
        step = max(1, max(image.alpha.shape) // RIM_SIDE)
        color, alpha = image.color[::step, ::step], image.alpha[::step, ::step]
        inside = alpha >= OPAQUE * _unit(image)
        outer = _eroded(inside, RIM)
        rim = outer & ~_eroded(outer, RIM)
        if image.mask is not None:
            rim &= image.mask[::step, ::step]
        shares = alpha[rim].astype(np.float64)
        colors = color[rim].astype(np.float64)  # premultiplied
        total += float((colors.mean(axis=1) / shares).sum())
        count += len(shares)
    return total / count if count else 0.5


def _eroded(inside: np.ndarray, pixels: int) -> np.ndarray:
    """(h, w) bool: ``inside`` (h, w) without what is up to so many pixels from others."""
    for _ in range(pixels):
        kept = inside.copy()
        kept[1:] &= inside[:-1]
        kept[:-1] &= inside[1:]
        kept[:, 1:] &= inside[:, :-1]
        kept[:, :-1] &= inside[:, 1:]
        inside = kept
    return inside


def with_clear_pixels_masked(dataset: Dataset) -> Dataset:
    """``dataset``; where its training views have no silhouettes but clear pixels, these do not count in the
    views of the result, which have no alpha. Warns with a DataWarning that names the photographs."""
    with_alpha = [view for view in dataset.views if has_alpha(view)]
    if not with_alpha or has_silhouettes(dataset.train):
        return dataset
    odd = [view.name for view in with_alpha if _clear_share(view) > 0]
    if not odd:
        return dataset
    warnings.warn(
        f"{len(odd)} of {len(dataset.views)} photographs have transparent pixels, but no cut-out subject:"
        f" {', '.join(odd[:SHOWN])}{', ...' if len(odd) > SHOWN else ''}. These pixels do not count",
        DataWarning,
        stacklevel=3,
    )

    def masked(views: Sequence[View]) -> tuple[View, ...]:
        return tuple(replace(view, source=MaskedImage(view)) if has_alpha(view) else view for view in views)

    return replace(dataset, train=masked(dataset.train), test=masked(dataset.test))


def has_alpha(view: View) -> bool:
    """Whether the image has alpha. Photographs are not read for that."""
    if isinstance(view.source, PhotoFile):
        return view.source.has_alpha
    return not isinstance(view.source, MaskedImage) and view.load().alpha is not None


def _is_cut_out(view: View) -> bool:
    outlined = isinstance(view.source, PhotoFile) and view.source.cut_out
    share = _clear_share(view)
    return (share > 0 if outlined else share >= CLEAR) and share < 1


def _clear_share(view: View) -> float:
    """Share of the image's pixels that are clear."""
    image = view.load()
    return 0.0 if image.alpha is None else float(np.mean(image.alpha < OPAQUE * _unit(image)))


def _unit(image: ViewImage) -> int:
    return 255 if image.color.dtype == np.uint8 else 1
