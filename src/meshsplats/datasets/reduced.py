"""Views at a fraction of their size: each pixel is the mean of those that it covers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from meshsplats._common.arrays import area_means
from meshsplats.datasets.views import ImageCache, View, ViewImage

_WHOLE = 1 - 1e-6
"""Share of a pixel that must count for the pixel to count."""


@dataclass(frozen=True, eq=False)
class ReducedImage:
    """The image of ``view`` at the size ``width`` x ``height``, made when it is first used."""

    view: View
    width: int
    height: int
    store: ImageCache = field(repr=False)

    def load(self) -> ViewImage:
        image = self.store.find(self)
        if image is None:
            image = reduced_image(self.view.load(), self.width, self.height)
            self.store.keep(self, image)
        return image

    @property
    def nbytes(self) -> int:
        """Upper bound of the memory of the image in bytes: it has float16 colours, and may have alpha and a
        mask."""
        return (6 + 2 + 1) * self.width * self.height


@dataclass(frozen=True, eq=False)
class OpaqueImage:
    """The image of ``view``, a photograph without alpha, with an alpha of 1: it hides any background."""

    view: View

    def load(self) -> ViewImage:
        image = self.view.load()
        if image.alpha is not None:
            return image
        one = 255 if image.color.dtype == np.uint8 else 1
        return replace(image, alpha=np.full(image.color.shape[:2], one, image.color.dtype))

    @property
    def nbytes(self) -> int:
        """Upper bound of the memory of the image in bytes."""
        return self.view.source.nbytes + 2 * self.view.camera.width * self.view.camera.height


def opaque_views(views: Sequence[View]) -> tuple[View, ...]:
    """``views`` with an alpha of 1 where their images have none."""
    return tuple(replace(view, source=OpaqueImage(view)) for view in views)


def reduced_views(views: Sequence[View], factor: float, store: ImageCache) -> tuple[View, ...]:
    """``views`` with sides ``factor`` (0 to 1) times as long. The images are kept in ``store``.

    The views themselves are returned for a factor of 1.
    """
    if factor == 1:
        return tuple(views)
    result = []
    for view in views:
        camera = view.camera.scaled(factor)
        result.append(
            replace(view, camera=camera, source=ReducedImage(view, camera.width, camera.height, store))
        )
    return tuple(result)


def reduced_image(image: ViewImage, width: int, height: int) -> ViewImage:
    """``image`` at a smaller size. Pixels that do not count are taken as black; a new pixel counts if
    all pixels that it covers do."""

    def mean(values: np.ndarray) -> np.ndarray:
        return area_means(values, height, width)

    unit = np.float32(255 if image.color.dtype == np.uint8 else 1)
    known = image.color if image.mask is None else np.where(image.mask[..., None], image.color, 0)
    color = (mean(known) / unit).astype(np.float16)
    alpha = None if image.alpha is None else (mean(image.alpha) / unit).astype(np.float16)
    mask = None if image.mask is None else mean(image.mask) >= _WHOLE
    return ViewImage(color, alpha, mask)
