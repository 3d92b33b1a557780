"""Options of a conversion, validated up front, and its presets."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Literal, TypedDict

from meshsplats._common.choices import Look
from meshsplats._common.options import Advanced, Range, With, check_names, check_options

if TYPE_CHECKING:
    from typing_extensions import Unpack

Mode = Literal["crossed", "flat", "3d"]
Footprint = Literal["cameras", "framing", "distance", "filter", "none"]
Colors = Literal["view", "mean", "base"]
Detail = Literal["even", "cameras"]
Budget = Literal["merge", "drop"]
Preset = Literal["default", "paper"]

FLAT_SIDES = 8
"""Sides of an ellipse in mode 'flat' by default."""
THICK = 0.25
"""``flat_below`` of detail 'cameras' by default."""


@dataclass(frozen=True)
class ConversionOptions:
    """The options of ``convert``. None: the value of the preset, in ``PRESETS`` and ``docs/options.md``."""

    mode: Annotated[Mode | None, Advanced] = None
    """flat: one ellipse in the plane of the two largest axes of each splat. crossed: a second one at right
    angles to it, along the longest axis, so that no splat vanishes edge-on; a splat flatter than
    ``flat_below`` is one finer ellipse instead. 3d: three ellipses in the planes of axes 1-2, 2-3 and 1-3."""
    rim_radius: Annotated[float | None, Range(0.1, 10), Advanced] = None
    """Radius of the rim in standard deviations. Default: calibrated."""
    sides: Annotated[int | None, Range(3, 64), Advanced] = None
    """Sides of an ellipse; with one ring, also the triangles of its fan (3d: a multiple of 4; crossed: even).
    Default: 8 for flat, else 4."""
    rim_opacity: Annotated[float | None, Range(0, 1), Advanced] = None
    """Opacity of the rim as a fraction of the splat's."""
    center_opacity: Annotated[float | None, Range(1e-3, 2), Advanced] = None
    """Opacity of the centre as a multiple of the splat's; the product is clamped to 1. Default:
    calibrated."""
    rings: Annotated[int | None, Range(1, 4), Advanced] = None
    """Rings of vertices in an ellipse; the last is the rim. More rings follow the Gaussian more closely: 2
    rings make 3 * sides triangles."""
    detail: Annotated[Detail | None, Advanced] = None
    """Level of detail. even: every splat has the same number of triangles. cameras: that number on average, 3
    to 80 for each splat; most where the splat is large in the cameras' images and a plain fan would look
    wrong, none where it is hidden inside a solid. It implies mode 'flat' and needs one ring. Fine-tuning
    begins with it."""
    flat_below: Annotated[float | None, Range(0, 1), With(mode="crossed", detail="cameras"), Advanced] = None
    """crossed: a splat whose smallest standard deviation (with its footprint) is at most this fraction of the
    middle one becomes one ellipse of twice as many triangles. detail 'cameras': a splat that is thicker than
    that and gets 24 triangles or more becomes a star, ellipses in 6 or 10 planes, which looks alike from
    everywhere. Default there: 0.25; 1: no stars."""
    compensation: Annotated[float | None, Range(0, 1), Advanced] = None
    """1: opacities are scaled so that the ellipses of a splat have the same opacity times area as the splat,
    averaged over all directions. 0: opacities stay. Between: a power of that factor."""
    look: Look | None = None
    """How the mesh should look. area: each pixel is the mean over its area, for programs that take several
    samples a pixel: Blender, engines with MSAA, ray tracers. splats: as a 3DGS viewer shows the splats at the
    image size of the cameras or the framing; fans are then wider, and blur in larger images. Default: area;
    convert, view, render and blender take splats where the splats are so small that gaps would show."""
    footprint: Annotated[Footprint | None, Advanced] = None
    """Source of the size of a pixel at each splat, for the low-pass filter that splats were trained with.
    cameras: the given cameras. framing: images of 1000 pixels from all sides that just hold the subject, with
    finer pixels for very dense splats. distance: ``viewing_distance``. filter: the mesh gets a filter of its
    own (``SplatMesh.filter_px2``) instead, which is right at every size but which only this project's
    renderer applies; for splats of kernel '3dgs'. none: no filter, for a model trained without one. Default:
    cameras if there are any, else distance if it is given, else framing."""
    footprint_px2: Annotated[
        float | None, Range(0, 100), With(footprint=("cameras", "framing", "distance", "filter")), Advanced
    ] = None
    """Variance of that filter in square pixels. Every standard deviation s becomes sqrt(s^2 + v * pixel^2),
    or max(s, sqrt(v) * pixel) for splats of kernel '2dgs', with v this variance. Default: 0.05 for the look
    'area', against sampling noise; for 'splats' 0.5, or 0.4 for splats of kernel 'antialiased' and 0.3 for
    '2dgs'. With ``footprint`` filter: ``SplatMesh.filter_px2``, by default 0.3 as in 3DGS."""
    viewing_distance: Annotated[float | None, Range(1e-30, 1e30), With(footprint="distance"), Advanced] = None
    """Distance from which the mesh will be seen, scene units."""
    focal: Annotated[float | None, Range(1e-3, 1e9), With(footprint="distance"), Advanced] = None
    """Focal length, in pixels, of images from ``viewing_distance``. A value of 1000 is 53 degrees over 1000
    pixels."""
    min_opacity: Annotated[float | None, Range(0, 1), Advanced] = None
    """Leave out splats of less opacity than this; above 0, also splats without area. Splats below 1/255 are
    invisible."""
    shrink_faint: Annotated[bool | None, Advanced] = None
    """Make faint splats smaller: 3DGS cuts them off where their opacity falls below 1/255, which leaves the
    share 1 - 1 / (255 opacity) of their area."""
    crop: tuple[float, float, float, float, float, float] | None = None
    """Box x0 y0 z0 x1 y1 z1, in coordinates of the world, as ``info`` prints them: leave out splats whose
    centre is outside."""
    max_splats: Annotated[int | None, Range(1, 2**31 - 1)] = None
    """Largest number of splats: where there are more, similar ones are merged (or, by ``budget``,
    dropped)."""
    max_triangles: Annotated[int | None, Range(1, 2**31 - 1)] = None
    """Largest number of triangles: beyond it, similar splats are merged. Flat splats get fewer triangles each
    first, 4 at least, unless ``sides``, ``rings``, ``rim_radius`` or ``center_opacity`` is given."""
    budget: Annotated[Budget | None, Advanced] = None
    """How to keep to ``max_splats`` and ``max_triangles``. merge: merge similar splats. drop: keep only the
    most important ones, by opacity times area in the images of the cameras (splats that no camera sees count
    as at the median distance), or in scene units without cameras; this tears holes."""
    colors: Annotated[Colors | None, Advanced] = None
    """view: as the splats, the mesh has view-dependent colours, where the splats have spherical
    harmonics (``SplatMesh.harmonics``). mean: one colour, the mean of those that the cameras see. base: one
    colour, the part of degree 0. Programs that do not know the harmonics show the base colour of 'view'."""
    color_degree: Annotated[int | None, Range(1, 3), With(colors="view"), Advanced] = None
    """Degree of the spherical harmonics that 'view' keeps. Default: all that the splats have."""

    def resolved(self, preset: str, *, has_cameras: bool) -> ConversionOptions:
        """A checked copy with the preset's values in place of None.

        Raises ValueError for an unknown preset, values out of range and options that contradict each other.
        """
        if preset not in PRESETS:
            raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {preset!r}")
        defaults = PRESETS[preset]
        given = {f.name for f in fields(self) if getattr(self, f.name) is not None}
        if self.detail == "cameras":
            defaults = replace(defaults, mode="flat", flat_below=THICK if preset == "default" else 1.0)
        full = replace(
            self, **{f.name: getattr(defaults, f.name) for f in fields(self) if f.name not in given}
        )
        if full.sides is None:
            full = replace(full, sides=FLAT_SIDES if full.mode == "flat" else 4)
        if full.footprint is None:
            source: Footprint = "cameras" if has_cameras else "framing"
            full = replace(full, footprint=source if self.viewing_distance is None else "distance")
        full._check(given, has_cameras)
        numbers = ("sides", "rings", "max_splats", "max_triangles", "color_degree")
        whole = {name: int(value) for name in numbers if (value := getattr(full, name)) is not None}
        return replace(full, **whole)  # type: ignore[arg-type]  # of 1e6, say

    def _check(self, given: set[str], has_cameras: bool) -> None:
        check_options(self, given=given)
        if self.mode == "3d" and self.sides % 4:  # type: ignore[operator]
            raise ValueError(f"sides must be a multiple of 4 in mode '3d', got {self.sides}")
        if self.mode == "crossed" and self.sides % 2:  # type: ignore[operator]
            raise ValueError(f"sides must be even in mode 'crossed', got {self.sides}")
        if self.detail == "cameras":
            if not has_cameras:
                raise ValueError("detail='cameras' needs cameras: give some, or detail='even'")
            if self.mode != "flat" or self.rings != 1:
                raise ValueError(
                    f"detail='cameras' needs mode 'flat' and rings 1, got mode {self.mode!r} and"
                    f" rings {self.rings}"
                )
        if self.footprint == "cameras" and not has_cameras:
            raise ValueError(
                "footprint='cameras' needs cameras: give some, or choose framing, distance or none"
            )
        if self.footprint == "distance" and self.viewing_distance is None:
            raise ValueError("footprint='distance' needs viewing_distance, in scene units")
        if self.colors == "mean" and not has_cameras:
            raise ValueError("colors='mean' needs cameras")
        if self.crop is not None:
            import numpy as np

            box = np.asarray(self.crop, np.float64)
            if box.shape != (6,) or not np.isfinite(box).all() or not (box[:3] <= box[3:]).all():
                raise ValueError(
                    f"crop must be x0 y0 z0 x1 y1 z1 with each minimum <= its maximum, got {self.crop}"
                )


PRESETS = {
    "default": ConversionOptions(
        mode="crossed",
        look="area",
        rim_opacity=0.0,
        rings=1,
        detail="even",
        flat_below=0.15,
        compensation=1.0,
        focal=1000.0,
        min_opacity=1 / 255,
        shrink_faint=True,
        budget="merge",
        colors="view",
    ),
    "paper": ConversionOptions(
        mode="flat",
        look="area",
        rim_radius=2.7,
        sides=8,
        rim_opacity=0.2,
        center_opacity=1.0,
        rings=1,
        detail="even",
        flat_below=0.0,
        compensation=0.0,
        footprint="none",
        focal=1000.0,
        min_opacity=0.0,
        shrink_faint=False,
        budget="merge",
        colors="base",
    ),
}
"""default: calibrated to look like the splats. paper: arXiv 2502.07754, with the rim opacity and the number
of sides of its published code."""


class ConversionChanges(TypedDict, total=False):
    """The fields of ``ConversionOptions`` as keywords, for type checkers and editors."""

    mode: Mode | None
    rim_radius: float | None
    sides: int | None
    rim_opacity: float | None
    center_opacity: float | None
    rings: int | None
    detail: Detail | None
    flat_below: float | None
    compensation: float | None
    look: Look | None
    footprint: Footprint | None
    footprint_px2: float | None
    viewing_distance: float | None
    focal: float | None
    min_opacity: float | None
    shrink_faint: bool | None
    crop: tuple[float, float, float, float, float, float] | None
    max_splats: int | None
    max_triangles: int | None
    budget: Budget | None
    colors: Colors | None
    color_degree: int | None


def make_options(
    options: ConversionOptions | None = None, **changes: Unpack[ConversionChanges]
) -> ConversionOptions:
    """``options``, none by default, with ``changes``. A misspelt name is a TypeError that says which names
    there are."""
    check_names("convert", changes, [f.name for f in fields(ConversionOptions)])
    return replace(options or ConversionOptions(), **changes)
