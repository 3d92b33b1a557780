"""The initial state of a fine-tuning: the mesh, the unit of each vertex, and the mesh's boundary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.kinds import need, need_all
from meshsplats.conversion import ConversionOptions, convert
from meshsplats.conversion.detail import OnImage
from meshsplats.conversion.footprint import FILTER_PX2, CameraCoverage
from meshsplats.conversion.options import FLAT_SIDES, make_options
from meshsplats.datasets.splat_targets import are_rendered
from meshsplats.datasets.views import View
from meshsplats.finetuning.config import FinetuneConfig, is_long
from meshsplats.rendering import render_splats
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import DILATION, GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.order import Order, checked_order

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from meshsplats.conversion.options import ConversionChanges


MANY_TRIANGLES = 600_000
"""Clouds that would have more get fewer for each splat, so that a run of minutes has enough steps. Not with
``look='splats'``, where the guitar (90,000 splats) lost 1 dB with 6 for each."""
FEWEST_SIDES = 5
"""Triangles of a splat, on average, in the largest clouds."""
SIDES = 16
"""Triangles of a splat, on average, for runs on images of splats: even in 100 steps, playbot (31,000 splats)
has 1 dB more at 400 pixels with them than with 8."""
LONG_SIDES = 32
"""``SIDES`` of long runs."""
LONG_TRIANGLES = 1_500_000
"""``MANY_TRIANGLES`` of long runs."""

FITTED_VIEWS = 4
"""Photographs by which ``for_photographs`` chooses a footprint. Lego on its photographs, before a step and
after 1.5 minutes, as wide as 3DGS drew it: 30.1 and 34.55 dB; as for means over areas 26.0 and 34.34;
snowmiku 27.0 and 26.3 before, the same after."""

FOOTPRINT_PX2 = 0.008
"""Variance of the footprint, square pixels of the training images, for runs on means over areas: that of
``convert`` in images 2.5 times as large, 1000 pixels where the training images have 400. With the footprint
of the smaller images a dense cloud would be blurred in larger ones (0.5 million splats, one minute: 39.7 in
place of 41.1 dB at 800 pixels, 36.1 in place of 38.7 at 1600; 40.7 in place of 38.9 at 400)."""


def starting_mesh(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    options: ConversionOptions | None = None,
    *,
    preset: str = "default",
    config: FinetuneConfig | None = None,
    up: Sequence[float] | np.ndarray | None = None,
    threads: int | None = None,
    on_image: OnImage | None = None,
    **changes: Unpack[ConversionChanges],
) -> SplatMesh:
    """``cloud`` converted for the fine-tuning of ``preset``, to be seen from ``cameras``, those of all its
    training views.

    For 'paper' this is the paper's conversion. For 'default' it is ours, with one ellipse per
    splat (``mode='flat'``) of as many triangles as ``starting_sides`` says, on average, and more where much
    is visible (``detail='cameras'``), unless ``options`` or ``changes``, as in ``convert``, say otherwise:
    two crossed ellipses look better before fine-tuning, but a step takes longer and the result is worse. With
    ``look='splats'`` each splat has 8 triangles on average, and the mesh is to be drawn with the filter of
    3DGS (``footprint='filter'``), where the splats' kernel has it.
    """
    need(GaussianCloud, cloud=cloud)
    need_all(Camera, cameras=cameras)
    need(ConversionOptions, options=options, optional=True)
    need(FinetuneConfig, config=config, optional=True)
    chosen = make_options(options, **changes)
    how: dict[str, Any] = {"cameras": cameras, "up": up, "threads": threads, "on_image": on_image}
    if preset != "default":
        return convert(cloud, replace(chosen, look=None), preset="paper", **how)
    if chosen.mode is None and chosen.flat_below is None:
        chosen = replace(chosen, mode="flat")
    if starts_with_filter(cloud, chosen):
        chosen = replace(chosen, footprint="filter")
    if _is_for_images_of_splats(chosen, config) and chosen.footprint_px2 is None:
        chosen = replace(chosen, footprint_px2=FOOTPRINT_PX2)
    if chosen.detail is None and chosen.mode == "flat" and chosen.rings in (None, 1):
        chosen = replace(chosen, detail="cameras")
        if chosen.sides is None and chosen.max_triangles is None and chosen.look != "splats":
            splats = max(1, min(len(cloud), chosen.max_splats or len(cloud)))
            chosen = replace(chosen, sides=starting_sides(splats, config, len(cameras)))
    return convert(cloud, chosen, **how)


def for_photographs(
    options: ConversionOptions, cloud: GaussianCloud, views: Sequence[View], threads: int | None = None
) -> ConversionOptions:
    """``options`` with the footprint by which ``cloud`` looks most like ``views``, if these are photographs.

    3DGS widens splats by ``DILATION`` in the photographs that it trains on: their own size is too small
    there, and right where these photographs are much smaller than those. Options that say something of the
    footprint, and splats of other kernels, stay.
    """
    views = subsample(views, FITTED_VIEWS)
    if cloud.kernel != "3dgs" or options.footprint is not None or options.footprint_px2 is not None:
        return options
    if not views or are_rendered(views):
        return options
    of_areas = FILTER_PX2["area"][cloud.kernel]
    errors = dict.fromkeys((of_areas, DILATION), 0.0)
    for view in views:
        image = view.load()
        weight = 1.0 if image.mask is None else image.mask[..., None]
        target = image.over(view.background)
        for px2 in errors:
            drawn = render_splats(
                cloud, view.camera, background=view.background, samples=2, dilation=px2, threads=threads
            )
            errors[px2] += float((weight * (drawn.color.clip(0, 1) - target) ** 2).mean())
    wider = errors[DILATION] < errors[of_areas]
    return replace(options, footprint_px2=DILATION) if wider else options


def _is_for_images_of_splats(options: ConversionOptions, config: FinetuneConfig | None) -> bool:
    """Whether the mesh is blended and trained on means over areas that are rendered from splats."""
    blended = config is not None and not config.cuts
    return blended and options.look in (None, "area") and options.footprint in (None, "cameras")


def starts_with_filter(cloud: GaussianCloud, options: ConversionOptions) -> bool:
    """Whether ``starting_mesh`` (preset 'default') makes a mesh that is drawn with the filter of 3DGS."""
    if options.footprint is not None or options.footprint_px2 is not None:
        return options.footprint == "filter"
    return options.look == "splats" and cloud.kernel == "3dgs"


def starting_sides(splats: int, config: FinetuneConfig | None, views: int) -> int:
    """Triangles of a splat, on average, at the start of a run with ``config`` and this number of views.

    8 without a ``config``, or for opaque triangles; else ``SIDES``, or ``LONG_SIDES`` for long runs
    (``is_long``). In large clouds fewer (``MANY_TRIANGLES``, ``LONG_TRIANGLES``), but at least 5.
    """
    most, sides = MANY_TRIANGLES, FLAT_SIDES
    if config is not None and not config.cuts:
        sides = SIDES
        if is_long(config, views):
            most, sides = LONG_TRIANGLES, LONG_SIDES
    return min(max(most // splats, FEWEST_SIDES), sides)


def vertex_sizes(mesh: SplatMesh, cameras: Sequence[Camera] = (), pixels: float = 0.0) -> np.ndarray:
    """(v,) float32 size of each vertex in scene units: the square root of twice its triangles' area.

    The triangles of one splat (``face_splat``) share the mean of their sizes, at most this many ``pixels`` in
    images of ``cameras``, unless these are 0 or none sees it. A vertex of several triangles takes the mean of
    theirs. Vertices without area take the smallest size in the mesh, so that they hardly move; all sizes are
    0 if no triangle has an area.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.sqrt(np.linalg.norm(normals, axis=1))
    splats = mesh.splats
    size = splats.sums(size) / splats.counts
    if len(cameras) and pixels:
        places = mesh.vertices[mesh.faces[splats.starts, 0]]  # the centres of fans
        most = pixels * CameraCoverage(places, cameras).pixel_sizes()
        size = np.where(most > 0, np.minimum(size, most), size)
    return vertex_means(mesh, size[splats.of_face])


def vertex_means(mesh: SplatMesh, values: np.ndarray) -> np.ndarray:
    """(v,) float32: for each vertex the mean of its triangles' ``values``, (f,) >= 0.

    Vertices whose mean is 0 take the smallest positive one; all are 0 if all values are.
    """
    v = len(mesh.vertices)
    total = np.bincount(mesh.faces.ravel(), np.repeat(values, 3), v)
    uses = np.bincount(mesh.faces.ravel(), minlength=v)
    result = np.divide(total, uses, out=np.zeros(v), where=uses > 0)
    positive = result > 0
    if positive.any():
        result[~positive] = result[positive].min()
    return result.astype(np.float32)


def boundary_vertices(faces: np.ndarray, count: int) -> np.ndarray:
    """(count,) bool: the vertices on the boundary, on edges of exactly one of the triangles (f, 3)."""
    low = np.minimum(faces, np.roll(faces, -1, axis=1)).astype(np.int64)
    high = np.maximum(faces, np.roll(faces, -1, axis=1))
    edges = np.sort((low * count + high).ravel())
    differs = np.concatenate([[True], edges[1:] != edges[:-1], [True]])
    boundary = edges[differs[:-1] & differs[1:]] if len(edges) else edges
    result = np.zeros(count, bool)
    result[boundary // max(count, 1)] = True
    result[boundary % max(count, 1)] = True
    return result


def order_of(mesh: SplatMesh, config: FinetuneConfig) -> Order:
    """The order in which the triangles of ``mesh`` are blended and optimised."""
    if config.cuts or config.order == "file":
        return "fragment"
    return mesh.order if config.order == "mesh" else checked_order(config.order, mesh.face_splat)
