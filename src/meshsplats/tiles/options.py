"""Options of a tileset."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from meshsplats._options import Range, check_options
from meshsplats.conversion.budget import triangles_each
from meshsplats.conversion.options import ConversionOptions, Preset
from meshsplats.conversion.streaming import refuse_whole

TilesAlpha = Literal["auto", "blend", "mask", "opaque"]

MAX_TRIANGLES = 1 << 16
"""Triangles of a tile."""


@dataclass(frozen=True)
class TileOptions:
    """Options of ``build_tiles``."""

    max_triangles: Annotated[int, Range(1, math.inf)] = MAX_TRIANGLES
    """Largest number of triangles of a tile."""
    preset: Preset = "default"
    """Preset of the conversion."""
    conversion: ConversionOptions | None = None
    """What to do otherwise than the preset does; not ``max_splats``, ``max_triangles``, ``detail='cameras'``,
    ``colors='mean'``, and of the footprints framing, distance and none. Colours are those of degree 0, which
    every program shows; with ``colors='view'``, tiles have the harmonics, too, for programs that draw them
    (docs/viewers.md), and are 1.6 times as large with degree 1, twice with 2."""
    up: tuple[float, float, float] | None = None
    """Direction that points up in the world frame. None: that of the splat files, where they name it, else
    (0, -1, 0)."""
    lit: bool = False
    """A material that scene lights shade, instead of an unlit one."""
    alpha: TilesAlpha = "auto"
    """How viewers treat opacity, as in ``save_mesh``, the same in all tiles. auto: 'blend' or 'mask',
    whichever is nearer to the sorted image in viewers that do not sort (``choose_alpha``), by images of the
    tiles from around the scene."""
    place: Literal["world", "local"] = "world"
    """'world': the tileset stands at the origin of the splats, to which the transform of its root moves it;
    'local': that transform is left out."""

    def resolved(self) -> ConversionOptions:
        """The checked options of the conversion. Raises ValueError."""
        check_options(self)
        conversion = self.conversion or ConversionOptions()
        if conversion.colors is None and conversion.color_degree is None:
            conversion = replace(conversion, colors="base")
        chosen = conversion.resolved(self.preset, has_cameras=False)
        refuse_whole(chosen)
        if chosen.footprint == "filter":
            raise ValueError("footprint='filter' is for this project's renderer, tiles are for others")
        least = triangles_each(chosen)
        if self.max_triangles < 8 * least:
            raise ValueError(
                f"max_triangles of a tile must be at least {8 * least}, got {self.max_triangles!r}"
            )
        return chosen
