"""The mesh that a fine-tuning begins with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from meshsplats.camera import Camera
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh


def starting_mesh(
    cloud: GaussianCloud, cameras: Sequence[Camera], *, preset: str = "default", **options: Any
) -> SplatMesh:
    """``cloud`` converted for the fine-tuning of that ``preset``, to be seen from ``cameras``.

    For 'paper' and 'published' that is the paper's conversion. For 'default' it is ours with one ellipse of 8
    triangles a splat (``mode='flat'``) where ``options``, those of ``convert``, do not say otherwise: two
    crossed ones look better as they are converted, but cost twice the time in a step and end lower.
    """
    from meshsplats.conversion import convert

    if preset != "default":
        return convert(cloud, preset="paper", cameras=cameras, **options)
    if options.get("mode") is None and options.get("flat_below") is None:
        options["mode"] = "flat"
    return convert(cloud, preset="default", cameras=cameras, **options)
