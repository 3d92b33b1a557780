"""Options of a tileset."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal

from meshsplats._common.choices import Look
from meshsplats._common.options import Range, check_options
from meshsplats._common.words import parse_up
from meshsplats.conversion.options import ConversionOptions, Preset

TilesAlpha = Literal["auto", "blend", "mask", "opaque"]

MAX_TRIANGLES = 1 << 16
"""Triangles of a tile."""
_OF_SPLATS = ("crop", "min_opacity", "colors", "color_degree")


@dataclass(frozen=True)
class TileOptions:
    """Options of ``build_tiles``."""

    max_triangles: Annotated[int, Range(1, math.inf)] = MAX_TRIANGLES
    """Largest number of triangles of a tile. A splat counts as two of them, as viewers draw it."""
    as_splats: bool = False
    """Tiles of splats, not of meshes, as CesiumJS streams them: glTF with KHR_gaussian_splatting and SPZ.
    They keep all harmonics, unless ``conversion`` says otherwise by ``colors`` or ``color_degree``; of its
    other options, only ``crop`` and ``min_opacity`` have a meaning."""
    preset: Preset = "default"
    """Preset of the conversion."""
    conversion: ConversionOptions | None = None
    """What to do otherwise than the preset does; not ``max_splats``, ``max_triangles``, ``detail='cameras'``,
    ``colors='mean'``, and of the footprints framing, distance and none. Colours are those of degree 0, which
    every program shows; with ``colors='view'``, tiles have the harmonics, too, for programs that draw them
    (docs/viewers.md), and are 1.6 times as large with degree 1, twice with 2."""
    up: tuple[float, float, float] | None = None
    """Direction that points up in the world frame. None: that of the splat files, where they name it, else
    (0, 0, 1) of a survey, (0, -1, 0) of other ones."""
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
        from meshsplats.conversion.streaming import refuse_whole

        check_options(self)
        conversion = self.conversion or ConversionOptions()
        if self.as_splats:
            self._check_splats(conversion)
        elif conversion.colors is None and conversion.color_degree is None:
            conversion = replace(conversion, colors="base")
        chosen = conversion.resolved(self.preset, has_cameras=False)
        refuse_whole(chosen)
        if chosen.footprint == "filter":
            raise ValueError("footprint='filter' is for this project's renderer, tiles are for others")
        least = self.triangles_each(chosen)
        if self.max_triangles < 8 * least:
            raise ValueError(
                f"max_triangles of a tile must be at least {8 * least}, got {self.max_triangles!r}"
            )
        return chosen

    def triangles_each(self, conversion: ConversionOptions) -> int:
        """Triangles of a splat with the resolved options of the ``conversion``."""
        from meshsplats.conversion.budget import triangles_each

        return 2 if self.as_splats else triangles_each(conversion)

    def _check_splats(self, conversion: ConversionOptions) -> None:
        """Raises ValueError for options that tiles of splats have no use for."""
        given = {"preset": self.preset != "default", "lit": self.lit, "alpha": self.alpha != "auto"}
        given |= {f.name: getattr(conversion, f.name) is not None for f in fields(conversion)}
        wrong = [name for name, there in given.items() if there and name not in _OF_SPLATS]
        if wrong:
            raise ValueError(
                f"{', '.join(wrong)}: of meshes; tiles of splats have only {', '.join(_OF_SPLATS)}: leave it"
                " out, or as_splats"
            )


@dataclass(frozen=True)
class TilingOptions:
    """``TileOptions`` and those of their conversion, as commands have them: side by side, with words for
    directions."""

    as_splats: bool = False
    """Tiles of splats (SPZ in glTF), as CesiumJS draws them, not of triangles."""
    max_triangles: int = MAX_TRIANGLES
    """Maximum number of triangles of a tile. A splat of ``as_splats`` counts as 2."""
    preset: Preset = "default"
    """default: calibrated to look like the splats; paper: the conversion of the MeshSplats paper."""
    look: Look | None = None
    """area: for programs that take several samples a pixel; splats: as splat viewers show them. Default:
    area."""
    min_opacity: float | None = None
    """Leave out splats of less opacity than this. Default: 1/255; paper: 0."""
    colors: Literal["base", "view"] | None = None
    """base: one colour for each splat, which every program shows; the default of meshes. view: also the
    harmonics of view-dependent colours, for this program's images and for shaders; 1.6 to 2 times
    as large."""
    color_degree: int | None = None
    """Harmonics of 'view' up to this degree, 1 to 3. Default: all that the splats have."""
    crop: tuple[float, float, float, float, float, float] | None = None
    """Only splats with their centre in this box, in the coordinates of the file."""
    up: str | None = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the
    files, else -y, z of a survey, or as an object stands."""
    lit: bool = False
    """A material that takes light and shadow, not one that shows the colours as they are."""
    alpha: TilesAlpha = "auto"
    """auto: blend or mask, whichever is nearer to the sorted image in viewers that do not sort, by a few
    images of both. blend: viewers blend true opacities; mask: they draw as solid what is at least 20 %
    opaque; opaque: solid triangles, cut there."""

    def tile_options(self, place: Literal["world", "local"] = "world") -> TileOptions:
        """The checked options of ``build_tiles``. Raises ValueError."""
        names = ("look", "min_opacity", "crop", "colors", "color_degree")
        conversion = ConversionOptions(**{name: getattr(self, name) for name in names})
        up = None
        if self.up is not None:
            x, y, z = (float(u) for u in parse_up(self.up))
            up = (x, y, z)
        given = (self.preset, conversion, up, self.lit, self.alpha, place)
        options = TileOptions(self.max_triangles, self.as_splats, *given)
        options.resolved()
        return options
