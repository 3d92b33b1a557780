"""Whether photographs are cut out: their alpha leaves out what is behind the subject."""

from __future__ import annotations

from collections.abc import Sequence

from meshsplats.datasets.image_files import PhotoFile
from meshsplats.datasets.views import View

OPAQUE = 0.5
"""Alpha from which a pixel belongs to the silhouette."""


def has_silhouettes(views: Sequence[View]) -> bool:
    """Whether the image of any of ``views`` has alpha that leaves out a part of it."""
    for view in filter(has_alpha, views):
        alpha = view.alpha
        if alpha is not None and bool((alpha < OPAQUE).any()) and bool((alpha >= OPAQUE).any()):
            return True
    return False


def has_alpha(view: View) -> bool:
    """Whether the image has alpha. Photographs are not read for that."""
    if isinstance(view.source, PhotoFile):
        return view.source.has_alpha
    return view.load().alpha is not None
