"""Views for which similar splats are merged where nobody names any: of an object from all around it, of a
place those that are found, from which neither the noise behind its walls nor what lies far outside counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshsplats.cameras.framing import guess_up, unit_up
from meshsplats.cameras.trajectories import dome
from meshsplats.conversion.budget import within_limits
from meshsplats.conversion.converting import convert
from meshsplats.conversion.driver import worth_drawing
from meshsplats.conversion.merging import simplify_large
from meshsplats.conversion.options import ConversionOptions, Preset
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewpoints.showing import default_views

VIEWS, SIDE = 32, 800
"""Number of views and side of their images in pixels."""


def views_of_place(
    cloud: GaussianCloud,
    source: Path | None = None,
    *,
    up: np.ndarray | None = None,
    threads: int | None = None,
) -> list[Camera] | None:
    """``merging_views`` of a scene that is no object; None for one."""
    found = default_views(cloud, source, VIEWS, side=(SIDE, SIDE), up=up, threads=threads)
    return None if found is None else found[0]


def merging_views(
    cloud: GaussianCloud,
    source: Path | None = None,
    *,
    up: np.ndarray | None = None,
    threads: int | None = None,
) -> list[Camera]:
    """Cameras for which splats are merged where nobody names any.

    Args:
        source: file or folder of the splats; None: they have none.
        up: (3,) direction, where the user names it.
        threads: at most this many; all processors by default.
    """
    views = views_of_place(cloud, source, up=up, threads=threads)
    if views is not None:
        return views
    toward = guess_up(cloud) if up is None else unit_up(up)
    return list(dome(cloud, VIEWS, whole=True, up=toward, width=SIDE, height=SIDE))


def simplify_for_views(
    cloud: GaussianCloud,
    count: int,
    cameras: Sequence[Camera] | None = None,
    *,
    up: np.ndarray | None = None,
    threads: int | None = None,
) -> GaussianCloud:
    """``simplify_large``; without ``cameras`` for ``merging_views``."""
    if count >= len(cloud):
        return cloud
    views = cameras or merging_views(cloud, up=up, threads=threads)
    return simplify_large(cloud, count, views, threads)


def convert_within_limits(
    cloud: GaussianCloud,
    options: ConversionOptions | None = None,
    *,
    preset: Preset = "default",
    cameras: Sequence[Camera] | None = None,
    up: np.ndarray | None = None,
    source: Path | None = None,
    threads: int | None = None,
) -> SplatMesh:
    """``convert``; without ``cameras``, splats that a limit wants merged are merged for ``merging_views``."""
    given = ConversionOptions() if options is None else options
    if not cameras and _limited(cloud, given, preset) is not None:
        chosen = given.resolved(preset, has_cameras=False)
        cameras = merging_views(cloud, source, up=up, threads=threads)
        # All else is as without them.
        up = guess_up(cloud) if up is None else up
        given = replace(given, footprint=chosen.footprint)
    return convert(cloud, given, preset=preset, cameras=cameras, up=up, threads=threads)


def merged_within_limits(
    cloud: GaussianCloud,
    options: ConversionOptions,
    cameras: Sequence[Camera],
    *,
    preset: Preset = "default",
    threads: int | None = None,
) -> tuple[GaussianCloud, ConversionOptions]:
    """``cloud`` merged for ``cameras`` as far as the limits of ``options`` want it, and the options without
    these limits: a conversion without cameras then keeps to them."""
    limited = _limited(cloud, options, preset)
    if limited is None:
        return cloud, options
    chosen, count = limited
    merged = simplify_large(cloud, count, cameras, threads)
    return merged, replace(options, sides=chosen.sides, max_splats=None, max_triangles=None)


def _limited(
    cloud: GaussianCloud, given: ConversionOptions, preset: Preset
) -> tuple[ConversionOptions, int] | None:
    """Options and number of splats that the limits of ``given`` leave, if these want splats merged."""
    chosen = given.resolved(preset, has_cameras=False)
    drawn = len(worth_drawing(cloud, chosen))
    within, count = within_limits(given, chosen, drawn)
    return (within, count) if chosen.budget == "merge" and count < drawn else None
