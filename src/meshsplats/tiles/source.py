"""Scenes from files of any kind, tilesets among them, for what draws them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from meshsplats.errors import OptionsError
from meshsplats.scene.mesh import SplatMesh
from meshsplats.tiles import is_tileset
from meshsplats.tiles.tileset import Tileset


def open_tileset(
    path: Path, *, crop: Sequence[float] | None = None, max_error: float | None = None
) -> Tileset | None:
    """The tileset at ``path``, None if it is something else.

    Raises OptionsError for options without effect: ``max_error``, in pixels, is for tilesets, and ``crop``
    for what is no tileset.
    """
    if not is_tileset(path):
        if max_error is not None:
            raise OptionsError("``max_error`` is for tilesets")
        return None
    if max_error is not None and not 0 <= max_error < math.inf:
        raise OptionsError(f"``max_error`` must be a number of pixels, at least 0, got {max_error}")
    if crop is not None:
        raise OptionsError("``crop`` has no effect on a tileset: give it to 'meshsplats tiles'")
    return Tileset(path)


def outline(tileset: Tileset) -> SplatMesh:
    """The coarsest tile, which says where the tileset is."""
    return replace(tileset.root.load(), origin=tileset.origin)
