"""Limits on splats and triangles: how many splats stay, with how many triangles each."""

from __future__ import annotations

from dataclasses import replace

from meshsplats.conversion.fans import PLANES
from meshsplats.conversion.options import ConversionOptions

SHARE_KEPT = 2 / 3
"""Share of the splats that stay in mode 'flat'. Each of them then has 3/2 of the triangles that each splat
would have if all stayed."""

FEWEST = 4
"""Fewest triangles of a flat splat. With three, more splats could stay, but only opaque subjects would look
better."""


def triangles_each(options: ConversionOptions) -> int:
    """Triangles of a splat by ``mode``, ``sides`` and ``rings``; their mean for ``detail='cameras'``."""
    ellipses = len(PLANES[options.mode])  # type: ignore[index]
    return ellipses * (2 * options.rings - 1) * options.sides  # type: ignore[operator]


def usual_triangles_each() -> int:
    """Those of a splat as ``convert`` makes them by default."""
    return triangles_each(ConversionOptions().resolved("default", has_cameras=False))


def within_limits(
    given: ConversionOptions, chosen: ConversionOptions, n: int
) -> tuple[ConversionOptions, int]:
    """The options for a cloud of ``n`` splats, and how many of the splats stay.

    Crossed ellipses keep their 8 triangles: half the splats with 8 triangles look better than all of them
    with 4. Flat splats get fewer triangles, 4 to 8, so that more splats stay, unless ``given`` sets their
    triangles or profile (benchmarks/simplification.py).

    Raises ValueError if not even one splat fits.
    """
    count = n if chosen.max_splats is None else min(n, chosen.max_splats)
    most = chosen.max_triangles
    if most is None or count * triangles_each(chosen) <= most:
        return chosen, count
    own = (given.sides, given.rings, chosen.rim_radius, chosen.center_opacity)
    if chosen.mode == "flat" and all(value is None for value in own):
        each = round(most / count / SHARE_KEPT)
        chosen = replace(chosen, sides=min(max(each, FEWEST), triangles_each(chosen)))
    if most < triangles_each(chosen):
        raise ValueError(f"max_triangles must be at least {triangles_each(chosen)}, one splat's, got {most}")
    return chosen, min(count, most // triangles_each(chosen))
