"""How limits on splats and triangles are kept: how many splats, of how many triangles each."""

from __future__ import annotations

from dataclasses import replace

from meshsplats.conversion.fans import PLANES
from meshsplats.conversion.options import ConversionOptions

SHARE_KEPT = 2 / 3
"""Splats that are kept in mode 'flat', as a share of what there could be if each had only as many triangles
as there are for each."""

FEWEST = 4
"""Triangles of a flat splat at least. With three, more splats can be kept, but only opaque things look better
so."""


def triangles_each(options: ConversionOptions) -> int:
    """Triangles of a splat by ``mode``, ``sides`` and ``rings``; in the mean where ``detail`` shares them
    out."""
    ellipses = len(PLANES[options.mode])  # type: ignore[index]
    return ellipses * (2 * options.rings - 1) * options.sides  # type: ignore[operator]


def within_limits(
    given: ConversionOptions, chosen: ConversionOptions, n: int
) -> tuple[ConversionOptions, int]:
    """The options for a cloud of ``n`` splats, and how many splats are to stay of them.

    Crossed ellipses keep their 8 triangles: half as many such splats look better than all of them with 4
    triangles each. A flat one, where neither its triangles nor its profile were ``given``, gets fewer, 4 to
    8, for the sake of more splats (benchmarks/simplification.py).

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
