"""Views for which similar splats are merged where nobody names any: of an object from all around it, of a
place those that are found, from which neither the noise behind its walls nor what lies far outside counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshsplats.camera import Camera
from meshsplats.cameras.framing import guess_up, unit_up
from meshsplats.cameras.trajectories import dome
from meshsplats.conversion.budget import within_limits
from meshsplats.conversion.converting import convert
from meshsplats.conversion.driver import worth_drawing
from meshsplats.conversion.merging import simplify_large
from meshsplats.conversion.options import ConversionOptions, Preset
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
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
    if not cameras and _merges(cloud, given, preset):
        chosen = given.resolved(preset, has_cameras=False)
        cameras = merging_views(cloud, source, up=up, threads=threads)
        # All else is as without them.
        up = guess_up(cloud) if up is None else up
        given = replace(given, footprint=chosen.footprint)
    return convert(cloud, given, preset=preset, cameras=cameras, up=up, threads=threads)


def _merges(cloud: GaussianCloud, given: ConversionOptions, preset: Preset) -> bool:
    chosen = given.resolved(preset, has_cameras=False)
    count = len(worth_drawing(cloud, chosen))
    return chosen.budget == "merge" and within_limits(given, chosen, count)[1] < count
