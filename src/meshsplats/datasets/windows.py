"""Windows of views: a part of the image, seen by a camera of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshsplats.datasets.splat_targets import RenderedSplats
from meshsplats.datasets.views import ImageCache, ImageSource, View, ViewImage


def window_of(view: View, left: int, top: int, right: int, bottom: int, store: ImageCache) -> View:
    """The pixels of ``view`` in columns ``left`` to ``right`` and rows ``top`` to ``bottom``, the last ones
    not included.

    Images of splats are rendered for the window alone and kept in ``store``; others are cut out of the whole.
    """
    part = view.camera.window(left, top, right - left, bottom - top)
    if isinstance(view.source, RenderedSplats):
        # Its own camera, which is relative to the origin of the splats, whatever that of the view is.
        own = view.source.camera.window(left, top, right - left, bottom - top)
        return replace(view, camera=part, source=replace(view.source, camera=own, store=store))
    return replace(view, camera=part, source=_Part(view.source, left, top, right, bottom))


@dataclass(frozen=True, eq=False)
class _Part:
    """A part of an image."""

    source: ViewImage | ImageSource
    left: int
    top: int
    right: int
    bottom: int

    def load(self) -> ViewImage:
        whole = self.source if isinstance(self.source, ViewImage) else self.source.load()
        rows, columns = slice(self.top, self.bottom), slice(self.left, self.right)

        def cut(array: np.ndarray | None) -> np.ndarray | None:
            return None if array is None else np.ascontiguousarray(array[rows, columns])

        return ViewImage(np.ascontiguousarray(whole.color[rows, columns]), cut(whole.alpha), cut(whole.mask))

    @property
    def nbytes(self) -> int:
        """As of the whole image, which is what stays in memory."""
        return self.source.nbytes
