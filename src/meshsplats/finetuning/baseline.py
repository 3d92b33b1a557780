"""The conversion as the baseline of a fine-tuning: which of the two is nearer to the splats, at every size.

A short run on a large cloud can end below its conversion, above all in images larger than those that it was
trained on. Both are compared in the same images, of several sizes.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.cameras.framing import guess_up
from meshsplats.conversion import ConversionOptions, convert
from meshsplats.datasets.splat_targets import RenderedSplats, splat_views, window_centers, window_of_image
from meshsplats.datasets.views import Dataset, View
from meshsplats.evaluation.comparison import images_of_view
from meshsplats.evaluation.metrics import psnr
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.finetuning.initial import starts_with_filter
from meshsplats.finetuning.step import samples_of
from meshsplats.formats.cutting import cut_mesh
from meshsplats.scene.camera import Camera
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

ZOOMS = (0.5, 1, 2, 4)
"""Image sizes, as multiples of those of the training views: for 400 pixels, 200 to 1600. Of the larger images
windows of the views' size are compared, which also show what they would from as much nearer."""
VIEWS = 3
"""Views of each size."""
SAMPLES = 2
"""Samples along each side of a pixel of the splats, for the look 'area'."""
SHARES = (0.5, 0.25)
"""Where a mesh that began as its conversion ended below it at some size, it is moved by these shares of its
way only: noise falls faster than what was gained."""
TOLERANCE = 0.05
"""Differences in dB that do not count."""


@dataclass(frozen=True)
class SizeScores:
    """Mean PSNR in dB of a conversion, and of the same splats tuned, by image width in pixels."""

    converted: Mapping[int, float]
    tuned: Mapping[int, float]

    @property
    def worse_at(self) -> list[int]:
        """Image widths at which the tuned mesh is below the conversion."""
        return [width for width, own in self.converted.items() if self.tuned[width] < own - TOLERANCE]

    @property
    def loses(self) -> bool:
        """Whether it is, anywhere."""
        return bool(self.worse_at)

    def to_dict(self) -> dict[str, Any]:
        """For JSON, with the name of the one that is kept."""
        scores = {"converted": self.converted, "tuned": self.tuned}
        rounded = {name: {str(w): round(db, 3) for w, db in by.items()} for name, by in scores.items()}
        return {"psnr_by_width": rounded, "written": "converted" if self.loses else "tuned"}


@dataclass(frozen=True)
class Baseline:
    """The conversion's scores, and the views that they come from."""

    views: Mapping[int, Sequence[View]]
    """By image width in pixels."""
    scores: Mapping[int, float]
    """Mean PSNR of the conversion in dB, by image width."""
    seconds: float
    """Time that scoring it took, without rendering the splats."""

    def compared_with_itself(self) -> SizeScores:
        """The scores of the conversion, also as those of the result."""
        return SizeScores(self.scores, self.scores)

    def compare(
        self,
        mesh: SplatMesh,
        config: FinetuneConfig,
        threads: int | None = None,
        listing: DrawOrder | None = None,
    ) -> SizeScores:
        """Scores ``mesh`` likewise; drawn as a file with the order ``listing``."""
        return SizeScores(self.scores, _scores(mesh, self.views, config, threads, listing))


def converted(
    cloud: GaussianCloud,
    config: FinetuneConfig,
    options: ConversionOptions,
    cameras: Sequence[Camera] = (),
) -> SplatMesh:
    """What ``convert`` makes of ``cloud`` with these ``options``, and with the look and opacity of a run with
    ``config``: with the filter of 3DGS where the run has it, cut where its triangles are opaque.

    ``cameras``, of the views of the run, tell what is up, and the mean colours if these are asked for. Its
    detail and footprint are those of a conversion without cameras.
    """
    if starts_with_filter(cloud, options):
        options = replace(options, footprint="filter")
    wanted = without_cameras(options)
    if options.colors == "mean":
        wanted = replace(wanted, colors="mean")
        if wanted.footprint is None and wanted.viewing_distance is None:
            wanted = replace(wanted, footprint="framing")
    seen_from = cameras if options.colors == "mean" else None
    mesh = convert(cloud, wanted, cameras=seen_from, up=guess_up(cloud, cameras))
    return cut_mesh(mesh, config.cutoff) if config.cuts else mesh


def without_cameras(options: ConversionOptions) -> ConversionOptions:
    """``options`` with the default in place of what needs cameras."""
    needing = {"detail": "cameras", "footprint": "cameras", "colors": "mean"}
    return replace(
        options, **{name: None for name, value in needing.items() if getattr(options, name) == value}
    )


def partly(start: SplatMesh, tuned: SplatMesh, share: float) -> SplatMesh | None:
    """``start`` moved by this ``share`` of the way to ``tuned``, in positions and colours, plain ones too
    where ``tuned`` has some; None if they differ in their triangles or in the degree of their colours."""
    alike = start.colors.shape == tuned.colors.shape and start.sh_degree == tuned.sh_degree
    if not alike or not np.array_equal(start.faces, tuned.faces):
        return None

    def between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return one + np.float32(share) * (other - one)

    harmonics = plain = None
    if start.harmonics is not None and tuned.harmonics is not None:
        harmonics = between(start.harmonics, tuned.harmonics)
    if tuned.plain_colors is not None:
        plain = between(start.plain.colors[:, :3], tuned.plain_colors)
    return replace(
        tuned,
        vertices=between(start.vertices, tuned.vertices),
        colors=between(start.colors, tuned.colors),
        harmonics=harmonics,
        plain_colors=plain,
    )


def measure_baseline(
    mesh: SplatMesh,
    cloud: GaussianCloud,
    dataset: Dataset,
    config: FinetuneConfig,
    *,
    threads: int | None = None,
    seconds: float | None = None,
    listing: DrawOrder | None = None,
) -> Baseline:
    """Scores ``mesh``, the conversion of ``cloud``, in held-out views of ``dataset``, which are images of
    ``cloud``; in training views if none are held out. Of each size ``VIEWS``, or as few as take
    ``seconds``. ``listing``: the order of the file as which it is drawn."""
    views = _views(cloud, dataset, threads)
    used: dict[int, Sequence[View]] = dict.fromkeys(views, ())
    start, spent = time.perf_counter(), 0.0
    scores: dict[int, list[float]] = {width: [] for width in views}
    for place in range(min(len(same) for same in views.values())):
        if place and seconds is not None and (time.perf_counter() - start) * (place + 1) / place > seconds:
            break
        for width, same in views.items():
            same[place].load()
            began = time.perf_counter()
            scores[width].append(_psnr(mesh, same[place], config, threads, listing))
            spent += time.perf_counter() - began
            used[width] = same[: place + 1]
    means = {width: float(np.mean(found)) for width, found in scores.items()}
    return Baseline(used, means, spent)


def _views(cloud: GaussianCloud, dataset: Dataset, threads: int | None) -> dict[int, Sequence[View]]:
    source = (dataset.test or dataset.train)[0]
    assert isinstance(source.source, RenderedSplats)
    cameras = [view.camera for view in subsample(dataset.test or dataset.train, VIEWS)]
    centers = window_centers(cloud)
    found: dict[int, Sequence[View]] = {}
    for zoom in ZOOMS:
        if zoom <= 1:
            seen = [camera.scaled(zoom) for camera in cameras]
        else:
            seen = [window_of_image(camera, int(zoom), i, centers) for i, camera in enumerate(cameras)]
        found[round(zoom * cameras[0].width)] = splat_views(
            cloud,
            seen,
            look=source.source.look,
            sh_degree=source.source.sh_degree,
            background=source.background,
            samples=SAMPLES if source.source.look == "area" else None,
            threads=threads,
        )
    return found


def _scores(
    mesh: SplatMesh,
    views: Mapping[int, Sequence[View]],
    config: FinetuneConfig,
    threads: int | None,
    listing: DrawOrder | None,
) -> dict[int, float]:
    return {
        width: float(np.mean([_psnr(mesh, view, config, threads, listing) for view in same]))
        for width, same in views.items()
    }


def _psnr(
    mesh: SplatMesh, view: View, config: FinetuneConfig, threads: int | None, listing: DrawOrder | None
) -> float:
    images = images_of_view(mesh, view, samples=samples_of(view, config), threads=threads, listing=listing)
    return min(psnr(*images), 200.0)
