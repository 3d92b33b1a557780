"""Splats that are smaller than the distance between them, such as those that are made of one photograph or of
a point cloud. A splat viewer closes the gaps: it draws none smaller than about a pixel. A mesh of exactly
their size would be a sieve."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from meshsplats.conversion.footprint import FILTER_PX2, usual_pixels, widen
from meshsplats.conversion.options import ConversionOptions
from meshsplats.errors import DataWarning
from meshsplats.rendering.api import render_splats
from meshsplats.rendering.layers import affordable
from meshsplats.rendering.previews import preview_camera
from meshsplats.scene.gaussians import DILATION, GaussianCloud

SIDE = 500
"""Side in pixels of the images that tell."""
MOST_SPLATS = 4_000_000
"""More than these are captures of places, which are trained; the images would take seconds."""
_FRAGMENTS = 3e8
_SOLID, _THIN = 0.95, 0.9
"""Alpha of a splat viewer's image where it is solid; of the exact one where that has gaps."""
_SHARE = 0.05
"""Share of such pixels from which on gaps show. Files of trained splats have 0 to 2.4 %; two, made of one
photograph each, 7 %, and a sampled surface 36 %."""


def gap_share(cloud: GaussianCloud, threads: int | None = None) -> float:
    """Share, 0 to 1, of the pixels which a splat viewer shows solid and splats of exactly their size do not,
    in one image of the whole ``cloud``; 0 for clouds that take too long."""
    if not 0 < len(cloud) <= MOST_SPLATS:
        return 0.0
    camera = preview_camera(cloud).within(SIDE)
    if affordable(cloud, camera, 1, _FRAGMENTS) != camera:
        return 0.0
    shown, exact = (
        render_splats(cloud, camera, sh_degree=0, dilation=variance, threads=threads).alpha
        for variance in (DILATION, FILTER_PX2["area"][cloud.kernel])
    )
    solid = shown > _SOLID
    inner = solid.copy()  # without outlines, which the filter moves
    inner[1:] &= solid[:-1]
    inner[:-1] &= solid[1:]
    inner[:, 1:] &= solid[:, :-1]
    inner[:, :-1] &= solid[:, 1:]
    return float(np.mean(exact[inner] < _THIN)) if inner.any() else 0.0


def with_usual_look(
    cloud: GaussianCloud,
    options: ConversionOptions | None = None,
    *,
    threads: int | None = None,
    named: bool = False,
) -> ConversionOptions:
    """``options`` for all of ``cloud``, with the look 'splats' and a DataWarning where nothing says how wide
    fans are and gaps would show (``gap_share``). ``named``: the user can choose the look, and is told how."""
    options = ConversionOptions() if options is None else options
    if options.look is not None or options.footprint is not None or options.footprint_px2 is not None:
        return options
    if gap_share(cloud, threads) < _SHARE:
        return options
    _warn(" (``look`` splats; ``look`` area leaves them as they are)" * named)
    return replace(options, look="splats")


def without_gaps(cloud: GaussianCloud, threads: int | None = None, hint: str = "") -> GaussianCloud:
    """``cloud``, with a DataWarning that ends in ``hint`` and each splat as large as a splat viewer shows it
    where gaps would show (``gap_share``): what a mesh that is optimised on their images begins from."""
    if gap_share(cloud, threads) < _SHARE:
        return cloud
    _warn(hint)
    return replace(cloud, scales=widen(cloud.scales, usual_pixels(cloud), DILATION, "3dgs"))


def _warn(hint: str) -> None:
    warnings.warn(
        "the splats are smaller than the gaps between them; each becomes as large as a splat viewer shows it"
        f" in images of 1000 pixels{hint}",
        DataWarning,
        stacklevel=3,
    )
