"""Levels of detail: meshes of one scene with ever fewer triangles, each made for one size on the screen."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshsplats.conversion import ConversionOptions, convert
from meshsplats.conversion.footprint import FILTER_PX2
from meshsplats.conversion.merging import simplify_large
from meshsplats.datasets.splat_targets import HELD_OUT, shown_degree, splat_dataset
from meshsplats.datasets.views import Dataset, View
from meshsplats.evaluation.comparison import compare, images_of_view
from meshsplats.evaluation.metrics import psnr
from meshsplats.finetuning import (
    FinetuneConfig,
    OrderedMesh,
    Progress,
    RunOptions,
    finetune,
    finetune_ordered,
    starting_mesh,
    worthwhile_views,
)
from meshsplats.finetuning.config import worthwhile_zooms
from meshsplats.finetuning.initial import starting_sides
from meshsplats.finetuning.on_splats import with_colors
from meshsplats.rendering.ordering import drawing_order
from meshsplats.scene.camera import Camera
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

SMALLEST = 16
"""Minimum image width of a level in pixels."""

SAMPLES = 2
"""Samples along each side of a pixel when a level is scored."""

PLAIN_VIEWS = 2
"""Views by which the filter of a level that is only converted is chosen, and the least number by which it is
scored: more views of a fine one would take longer than all else."""

SCORED_TRIANGLES = 2_000_000
"""Triangles of a level that is only converted, times the views by which it is scored. Two splats of the
ground truth count as a triangle."""

FOOTPRINTS_PX2 = (FILTER_PX2["area"]["3dgs"], 0.1, 0.2, 0.3)
"""Variances of the low-pass filter of coarse levels, square pixels, ascending: merged splats of about a pixel
leave gaps without it. The first is that of ``convert``."""


MERGED_FROM = 200_000
"""Least number of splats of a level that the levels below it are merged from where they are only converted.
Merging fewer is quick, and splats that are merged twice are up to 2 dB worse."""


@dataclass(frozen=True)
class Level:
    """Size of one level of detail."""

    splats: int
    """Maximum number of splats."""
    width: int
    """Side in pixels of the square images, which the subject just fills, that the level is made for."""
    finest: int
    """Maximum number of splats of the finest level of the chain."""


def plan_levels(splats: int, count: int, *, factor: int = 4, width: int = 800) -> list[Level]:
    """Plans ``count`` levels, the first with all ``splats`` for images ``width`` pixels wide.

    Each following level has ``1 / factor`` of the splats, and images with ``1 / factor`` of the pixels, so
    that a splat covers the same number of pixels on every level.

    Raises ValueError if the last level had no splat or less than ``SMALLEST`` pixels.
    """
    if count < 1 or factor < 2 or splats < 1:
        raise ValueError(f"there must be a splat, a level and a factor of 2, got {splats}, {count}, {factor}")
    levels = [Level(splats // factor**i, round(width / math.sqrt(factor**i)), splats) for i in range(count)]
    if levels[-1].splats < 1 or levels[-1].width < SMALLEST:
        fit = sum(level.splats >= 1 and level.width >= SMALLEST for level in levels)
        raise ValueError(
            f"{count} levels are too many for {splats} splats and images of {width} pixels: the last would"
            f" have {levels[-1].splats} splats and {levels[-1].width} pixels; at most {fit} fit"
        )
    return levels


def level_targets(
    cloud: GaussianCloud, level: Level, config: FinetuneConfig | None = None, **options: Any
) -> Dataset:
    """Training and held-out images of ``cloud`` in the size of ``level``.

    Their number suits a run with ``config`` (``worthwhile_views``), which sees some of them as windows
    (``worthwhile_zooms``). ``options`` are those of ``splat_dataset``.
    """
    train = worthwhile_views(config) if config is not None else PLAIN_VIEWS
    if config is not None:
        options = {"zooms": worthwhile_zooms(config, "area"), **options}
    return splat_dataset(cloud, train=train, width=level.width, **options)


def make_level(
    cloud: GaussianCloud,
    level: Level,
    targets: Dataset,
    config: FinetuneConfig | None = None,
    options: ConversionOptions | None = None,
    *,
    up: Sequence[float] | np.ndarray | None = None,
    run: RunOptions | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> SplatMesh:
    """The mesh of ``level``: splats merged to its number, converted, and fine-tuned on ``targets`` as
    ``config`` says; without one, converted only. Without ``options``, splats have as many triangles as on the
    finest level, so that the numbers of triangles follow those of splats.

    Its colours have harmonics up to the degree of the images of splats in ``targets``. A level that is only
    converted may be made of the splats of the level before (``merged``). If it is not the finest and there
    are no ``options``, the low-pass filter is the one of ``FOOTPRINTS_PX2`` that comes nearest to the
    training views.

    ``options`` and ``up`` are those of ``convert``; ``run`` and ``on_progress`` those of ``finetune``.
    """
    if config is None:
        return _converted_level(cloud, level, targets, options, up, run)
    mesh = _starting_level(cloud, level, targets, config, options, up)
    return finetune(mesh, targets, config, run=run, on_progress=on_progress)


def make_ordered_level(
    cloud: GaussianCloud,
    level: Level,
    targets: Dataset,
    config: FinetuneConfig | None = None,
    *,
    up: Sequence[float] | np.ndarray | None = None,
    run: RunOptions | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> OrderedMesh:
    """``make_level`` for viewers that cull and do not sort: with an order of its triangles, and optimised as
    such viewers draw it."""
    threads = run.threads if run else None
    if config is None:
        mesh = _converted_level(cloud, level, targets, None, up, run).plain
        return OrderedMesh(mesh, drawing_order(mesh, threads=threads))
    mesh = _starting_level(cloud, level, targets, config, None, up)
    order = drawing_order(mesh, threads=threads)
    return finetune_ordered(mesh, order, targets, config, run=run, on_progress=on_progress)


def _converted_level(
    cloud: GaussianCloud,
    level: Level,
    targets: Dataset,
    options: ConversionOptions | None,
    up: Sequence[float] | np.ndarray | None,
    run: RunOptions | None,
) -> SplatMesh:
    threads = run.threads if run else None
    cameras = [view.camera for view in targets.views]
    degree = shown_degree(targets.views)
    cloud = merged(cloud if degree is None else cloud.of_degree(degree), level, cameras, threads)
    if options is not None or level.splats == level.finest:
        return convert(cloud, options, cameras=cameras, up=up, threads=threads)
    best, found = -math.inf, None
    for px2 in FOOTPRINTS_PX2:
        mesh = convert(cloud, cameras=cameras, up=up, footprint_px2=px2, threads=threads)
        score = likeness_to_views(mesh, targets.train[:PLAIN_VIEWS], threads)
        if score <= best:
            break
        best, found = score, mesh
    assert found is not None
    return found


def _starting_level(
    cloud: GaussianCloud,
    level: Level,
    targets: Dataset,
    config: FinetuneConfig,
    options: ConversionOptions | None,
    up: Sequence[float] | np.ndarray | None,
) -> SplatMesh:
    """The mesh of which a fine-tuning begins."""
    cameras = [view.camera for view in targets.train]
    if options is None:
        # A level is seen at the size of its targets: their own footprint, not that of larger images.
        px2 = FILTER_PX2["area"][cloud.kernel]
        sides = starting_sides(level.finest, config, len(cameras))
        options = ConversionOptions(sides=sides, footprint_px2=px2)
    options = with_colors(options, targets, config)
    return starting_mesh(cloud, cameras, options, config=config, up=up, max_splats=level.splats)


def merged(
    cloud: GaussianCloud, level: Level, cameras: Sequence[Camera], threads: int | None = None
) -> GaussianCloud:
    """The splats of ``level``: similar ones of ``cloud`` merged, for images from ``cameras``."""
    return simplify_large(cloud, level.splats, cameras, threads)


def merges_further(level: Level) -> bool:
    """Whether the levels below ``level`` are made of its splats, not of those that it was made of itself."""
    return level.splats >= MERGED_FROM


def views_to_score(triangles: int, splats: int) -> int:
    """Number of views by which a level of so many ``triangles`` is scored against all ``splats``, if it is
    only converted."""
    return min(max(SCORED_TRIANGLES // max(triangles, splats // 2, 1), PLAIN_VIEWS), HELD_OUT)


def likeness_to_views(
    mesh: SplatMesh, views: Sequence[View], threads: int | None, listing: DrawOrder | None = None
) -> float:
    """Mean PSNR in dB of the mesh at 2 x 2 samples per pixel against the images of ``views``; drawn as
    viewers draw a file with the order ``listing``."""
    options: dict[str, Any] = {"samples": SAMPLES, "threads": threads, "listing": listing}
    pairs = (images_of_view(mesh, view, **options) for view in views)
    return float(np.mean([min(psnr(*pair), 200.0) for pair in pairs]))


def likeness(
    mesh: SplatMesh,
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    *,
    sh_degree: int | None = None,
    threads: int | None = None,
) -> float:
    """Mean PSNR in dB over ``cameras``: the mesh at 2 x 2 samples per pixel against the splats in the look
    'area', on white."""
    found = compare(cloud, mesh, cameras, samples=SAMPLES, sh_degree=sh_degree, threads=threads)
    return float(np.mean([min(view.psnr, 200.0) for view in found.views]))
