"""The choices of a conversion, its presets, and what can be told wrong before any work is done."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal, get_args

import numpy as np

from meshsplats._options import Range, check_choices, check_flags, check_names, check_ranges
from meshsplats.rendering.looks import Look

Mode = Literal["crossed", "flat", "3d"]
Footprint = Literal["cameras", "framing", "distance", "density", "filter", "none"]
Colors = Literal["degree0", "cameras"]
Detail = Literal["even", "cameras"]
Budget = Literal["merge", "drop"]


@dataclass(frozen=True)
class ConversionOptions:
    """Every choice of ``convert``. None leaves it to the preset; lengths called radius are standard
    deviations."""

    mode: Mode | None = None
    """flat: one ellipse in the two largest axes of each splat. crossed: a second one, upright on it along the
    longest axis, so that no splat vanishes edge-on; a splat flatter than ``flat_below`` gets one finer
    ellipse instead. 3d: three ellipses in the planes of axes 1-2, 2-3 and 1-3."""
    rim_radius: float | None = None
    """Radius of the rim in standard deviations, 0.1 to 10. Default: calibrated; paper: 2.7."""
    sides: int | None = None
    """Number of triangles that make up an ellipse, a fan round its centre: 3 to 64 (3d: a multiple of 4;
    crossed: even). The name is the paper's. Default: 8 for flat, else 4; paper: 8."""
    rim_opacity: float | None = None
    """Opacity of the rim as a fraction of the splat's, 0 to 1. Default: 0; paper: 0.2."""
    center_opacity: float | None = None
    """Opacity of the centre as a multiple of the splat's, above 0 to 2; the product is clamped to 1. Default:
    calibrated; paper: 1."""
    rings: int | None = None
    """Rings of vertices in an ellipse, 1 to 4; the last is the rim. More follow the Gaussian closer: 2 rings
    draw 3 * sides triangles an ellipse. Default and paper: 1."""
    detail: Detail | None = None
    """How triangles are shared out among splats. even: every splat has the same number. cameras: that number
    on average, 3 to 80 by what the cameras given see of the splat: most where it is large in the pictures and
    a plain fan would look wrong, none where it is hidden inside a solid; for mode 'flat', which it implies,
    with one ring. Fine-tuning begins so. Default and paper: even."""
    flat_below: float | None = None
    """crossed: a splat whose smallest standard deviation (with its footprint) is less than this fraction of
    the middle one is drawn as one ellipse of twice as many triangles, 0 to 1."""
    compensation: float | None = None
    """0 to 1. 1 scales a splat's opacity so that its ellipses cover, on average over all directions, as much
    opacity times area as the splat itself; 0 leaves the opacity; between, a power of that factor. Paper:
    0."""
    look: Look | None = None
    """What the mesh is to look like. area: each pixel the mean over its area, in programs that take several
    samples a pixel: Blender, engines with MSAA, ray tracers. splats: at the size of the cameras or of the
    framing, as a 3DGS viewer shows it; it is then wider, and blurs in larger pictures. Default: area; paper:
    area, as it has no footprint."""
    footprint: Footprint | None = None
    """Where the size of a pixel at each splat comes from, for the low-pass filter that splats were trained
    with. cameras: the cameras given. framing: pictures of 1000 pixels from all round that just hold the
    subject, or finer where splats lie too densely for these. distance: one stated distance. density: the
    spacing of the splats alone. filter: none of these; the mesh is to be drawn with a filter of its own
    (``SplatMesh.filter_px2``), which is right at every size, but which only this project's pictures have; for
    splats of kernel '3dgs'. none: no filter, for a model trained without it. Default: cameras if there are
    any, else distance if stated, else framing; paper: none."""
    footprint_px2: float | None = None
    """Variance of that filter in square pixels, 0 to 100; every standard deviation s becomes
    sqrt(s^2 + footprint_px2 * pixel^2), or max(s, sqrt(footprint_px2) * pixel) for splats trained as 2DGS.
    Default: 0.05 for the look 'area', which the samples of a pixel need; for 'splats' 0.5, or 0.4 and 0.3
    for splats of kernel 'antialiased' and '2dgs'. footprint = filter: ``filter_px2`` of the mesh, 0.3 by
    default, as 3DGS draws."""
    viewing_distance: float | None = None
    """Distance the mesh will be seen from, scene units; for footprint = distance."""
    focal: float | None = None
    """Focal length in pixels of the pictures taken from ``viewing_distance``. Default: 1000, such as 1000
    pixels over 53 degrees."""
    min_opacity: float | None = None
    """Splats of less opacity than this are left out, 0 to 1; above 0 also those without any area. Default:
    1/255, below which they do not show; paper: 0."""
    shrink_faint: bool | None = None
    """Draw faint splats smaller, with as much area as they keep where 3DGS cuts their opacity off, at 1/255:
    the share 1 - 1 / (255 opacity). Paper: no."""
    crop: tuple[float, float, float, float, float, float] | None = None
    """Box x0 y0 z0 x1 y1 z1 in scene units: splats with their centre outside are left out."""
    max_splats: int | None = None
    """At most so many splats: see ``budget``."""
    max_triangles: int | None = None
    """At most so many triangles: see ``budget``. In mode 'flat', where neither ``sides`` nor the profile
    is given, splats get fewer triangles each, 4 at least, before they get fewer."""
    budget: Budget | None = None
    """How max_splats and max_triangles are kept. merge: splats that are alike are merged. drop: only the most
    important stay, by opacity times visible area: that on the pictures of the cameras where there are any
    (splats that none of them sees count as at the median distance), else that in scene units; it tears
    holes. Default and paper: merge."""
    colors: Colors | None = None
    """degree0: the view-independent part of the colour. cameras: the mean of the colours that the cameras
    see, where the splats have spherical harmonics."""

    def resolved(self, preset: str, *, has_cameras: bool) -> ConversionOptions:
        """With the preset's values where nothing was said, checked.

        Raises ValueError for an unknown preset, values out of range and choices that contradict each other.
        """
        if preset not in PRESETS:
            raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {preset!r}")
        defaults = PRESETS[preset]
        given = {f.name for f in fields(self) if getattr(self, f.name) is not None}
        if self.detail == "cameras" and self.mode is None:
            defaults = replace(defaults, mode="flat")
        full = replace(
            self, **{f.name: getattr(defaults, f.name) for f in fields(self) if f.name not in given}
        )
        if full.sides is None:
            full = replace(full, sides=8 if full.mode == "flat" else 4)
        if full.footprint is None:
            source: Footprint = "cameras" if has_cameras else "framing"
            full = replace(full, footprint=source if self.viewing_distance is None else "distance")
        full._check(given, has_cameras)
        return full

    def _check(self, given: set[str], has_cameras: bool) -> None:
        check_choices(self, _CHOICES)
        check_ranges(self, _RANGES, types=(int, float, np.integer, np.floating))
        check_flags(self, ("shrink_faint",))
        if self.mode == "3d" and self.sides % 4:  # type: ignore[operator]
            raise ValueError(f"sides must be a multiple of 4 in mode '3d', got {self.sides}")
        if self.mode == "crossed" and self.sides % 2:  # type: ignore[operator]
            raise ValueError(f"sides must be even in mode 'crossed', got {self.sides}")
        if "flat_below" in given and self.mode != "crossed":
            raise ValueError(f"flat_below is for mode 'crossed', got mode {self.mode!r}")
        if self.detail == "cameras":
            if not has_cameras:
                raise ValueError("detail='cameras' needs cameras: give some, or choose even")
            if self.mode != "flat" or self.rings != 1:
                raise ValueError(
                    f"detail='cameras' needs mode 'flat' and rings 1, got mode {self.mode!r} and"
                    f" rings {self.rings}"
                )
        if self.footprint == "cameras" and not has_cameras:
            raise ValueError(
                "footprint='cameras' needs cameras: give some, or choose framing, distance, density or none"
            )
        if self.footprint == "distance" and self.viewing_distance is None:
            raise ValueError("footprint='distance' needs viewing_distance, in scene units")
        if self.footprint != "distance" and given & {"viewing_distance", "focal"}:
            named = " and ".join(sorted(given & {"viewing_distance", "focal"}))
            raise ValueError(f"{named} is for footprint='distance', got footprint={self.footprint!r}")
        if self.footprint == "none" and "footprint_px2" in given:
            raise ValueError("footprint_px2 says how wide the footprint is, but footprint is 'none'")
        if self.colors == "cameras" and not has_cameras:
            raise ValueError("colors='cameras' needs cameras")
        if self.crop is not None:
            box = np.asarray(self.crop, np.float64)
            if box.shape != (6,) or not np.isfinite(box).all() or not (box[:3] <= box[3:]).all():
                raise ValueError(
                    f"crop must be x0 y0 z0 x1 y1 z1 with each minimum <= its maximum, got {self.crop}"
                )


_CHOICES = {
    "mode": get_args(Mode),
    "look": get_args(Look),
    "footprint": get_args(Footprint),
    "colors": get_args(Colors),
    "detail": get_args(Detail),
    "budget": get_args(Budget),
}

_RANGES: list[Range] = [
    ("rim_radius", 0.1, 10, False),
    ("sides", 3, 64, True),
    ("rim_opacity", 0, 1, False),
    ("center_opacity", 1e-3, 2, False),
    ("rings", 1, 4, True),
    ("flat_below", 0, 1, False),
    ("compensation", 0, 1, False),
    ("footprint_px2", 0, 100, False),
    ("viewing_distance", 1e-30, 1e30, False),
    ("focal", 1e-3, 1e9, False),
    ("min_opacity", 0, 1, False),
    ("max_splats", 1, 2**31 - 1, True),
    ("max_triangles", 1, 2**31 - 1, True),
]

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
        colors="degree0",
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
        colors="degree0",
    ),
}
"""default: calibrated to look like the splats. paper: arXiv 2502.07754 with the rim opacity and the
number of sides of its published code."""


def make_options(named: dict) -> ConversionOptions:
    """``ConversionOptions(**named)``; a misspelt name is a TypeError that says which names there are."""
    check_names("convert", named, [f.name for f in fields(ConversionOptions)])
    return ConversionOptions(**named)
