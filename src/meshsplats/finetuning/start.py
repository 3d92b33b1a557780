"""The mesh that a fine-tuning begins with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from meshsplats.camera import Camera
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.looks import Look


def starting_mesh(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    *,
    preset: str = "default",
    look: Look = "area",
    **options: Any,
) -> SplatMesh:
    """``cloud`` converted for the fine-tuning of that ``preset``, to be seen from ``cameras``.

    For 'paper' and 'published' that is the paper's conversion. For 'default' it is ours, where ``options``,
    those of ``convert``, do not say otherwise, with one ellipse a splat (``mode='flat'``) of 8 triangles in
    the mean, more where much shows (``detail='cameras'``): two crossed ellipses look better as they are
    converted, but cost more time in a step and end lower. For the ``look`` 'splats' it is to be
    drawn with a filter (``footprint='filter'``), where the splats' kernel has one: that of 3DGS.
    """
    from meshsplats.conversion import convert

    if preset != "default":
        return convert(cloud, preset="paper", cameras=cameras, **options)
    if options.get("mode") is None and options.get("flat_below") is None:
        options["mode"] = "flat"
    given = options.get("footprint") is not None or options.get("footprint_px2") is not None
    if look == "splats" and cloud.kernel == "3dgs" and not given:
        options["footprint"] = "filter"
    one_ring = options.get("mode") == "flat" and options.get("rings") in (None, 1)
    if options.get("detail") is None and one_ring:
        options["detail"] = "cameras"
    return convert(cloud, preset="default", cameras=cameras, look=look, **options)
