"""Fine-tuning on images of the splats, within a time: as much as there is time for, and never below the
conversion."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.choices import Device
from meshsplats.conversion import ConversionOptions
from meshsplats.conversion.budget import usual_triangles_each
from meshsplats.conversion.merging import simplify_in_blocks
from meshsplats.conversion.merging_views import merged_within_limits
from meshsplats.datasets.splat_targets import shown_degree
from meshsplats.datasets.views import Dataset
from meshsplats.errors import OptionsError
from meshsplats.finetuning.baseline import (
    SHARES,
    SizeScores,
    converted,
    measure_baseline,
    partly,
    without_cameras,
)
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.finetuning.initial import starting_mesh
from meshsplats.finetuning.journal import Journal
from meshsplats.finetuning.memory import available_memory, check_order_memory
from meshsplats.finetuning.ordered import finetune_ordered, ordering_views
from meshsplats.finetuning.pace import (
    BRIEF_RATES,
    BRIEF_ZOOMS,
    StartRecord,
    is_brief,
    measure_pace,
    most_splats,
    of_brief_run,
    worthwhile_steps,
)
from meshsplats.finetuning.phases.listed import check_for_file_order
from meshsplats.finetuning.plain import with_plain_means
from meshsplats.finetuning.reports import SCORED_VIEWS, held_out_scores, scored_count
from meshsplats.finetuning.run import finetune
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.finetuning.setup import Display, Setup
from meshsplats.formats.mesh_formats import takes
from meshsplats.rendering.ordering import drawing_order
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

SETUP_SHARE = 0.2
"""Largest share of the time, of a run with a length in minutes, before its first step."""
FEWEST_BRIEF_STEPS = 3
"""With less time left than for so many steps, a brief run is not begun."""
BASELINE_SHARE = 0.05
"""Share of it in which the conversion is scored, and the result afterwards."""
OVERTIME = 5.0
"""Seconds that may be added to it for a result that is better than the conversion."""
SAVE_SECONDS = 2e-6
"""Time to write a triangle, to choose its alpha mode and to draw it in the preview, with some to spare."""
TIMED_SPLATS = 10_000
"""Steps are timed for clouds from this size on."""
FILE_TRIANGLES = 4_000_000
"""Most triangles by default of a file that is tuned in its order: 200 MB, for viewers."""


@dataclass(frozen=True)
class SplatRun:
    """What a run on images of splats is made of."""

    cloud: GaussianCloud
    targets: Callable[[FinetuneConfig, Sequence[int] | None], Dataset]
    """Makes the images for a configuration, training views of the given zooms; None: those that suit it."""
    config: FinetuneConfig
    options: ConversionOptions
    """Of the mesh at the start, but for its look, which is that of the images."""
    folder: Path
    """Of the run."""
    begun: FinetuneConfig
    """``config`` with the length that the run began with."""
    resumed: bool = False
    fixed: Collection[str] = ()
    """Settings that a brief run does not change."""
    threads: int | None = None
    device: Device = "cpu"


def with_colors(options: ConversionOptions, dataset: Dataset, config: FinetuneConfig) -> ConversionOptions:
    """``options`` with the harmonics that images of splats in ``dataset`` show, unless they name colours. For
    opacity 'cutoff' with one colour: programs with a depth buffer draw no harmonics."""
    degree = shown_degree(dataset.train)
    if options.colors is not None or options.color_degree is not None:
        return options
    if config.cuts:
        return replace(options, colors="base")
    if degree is None:
        return options
    return replace(options, colors="view", color_degree=degree) if degree else replace(options, colors="base")


class Tuned(NamedTuple):
    """The end of a run."""

    mesh: SplatMesh
    order: DrawOrder | None = None
    """In which a file lists its triangles, of a run with order 'file'."""
    sizes: SizeScores | None = None
    """Of the conversion of splats and of the tuned mesh."""


def tuned_as_configured(
    mesh: SplatMesh, dataset: Dataset, config: FinetuneConfig, run: RunOptions, show: Display
) -> Tuned:
    """``finetune``, or with order 'file' ``finetune_ordered`` in an order that suits the training views."""
    if config.order != "file":
        return Tuned(finetune(mesh, dataset, config, run=run, on_progress=show))
    show.phase("ordering triangles")
    check_for_file_order(mesh, config)
    check_order_memory(mesh)
    order = drawing_order(mesh, [view.camera for view in dataset.train], threads=run.threads)
    return Tuned(*finetune_ordered(mesh, order, dataset, config, run=run, on_progress=show))


def check_order_of_file(config: FinetuneConfig, path: Path) -> None:
    """ValueError if the order of triangles of a run is to be in a file, and that of ``path`` has none."""
    if config.order == "file" and not takes(path, "order"):
        raise ValueError(f"order 'file' is for .glb files, which list triangles in an order, not {path.name}")


class SplatTuning:
    """A run on images of splats that is ready to begin. Reads or makes the record of its start."""

    def __init__(self, run: SplatRun, setup: Setup) -> None:
        self._run, self._setup = run, setup
        self.dataset, self.config = run.targets(run.config, None), run.config
        self._options = with_colors(replace(run.options, look=self.dataset.look), self.dataset, self.config)
        self._record = StartRecord.load(run.folder) if run.resumed else self._timed()
        if self._record.brief_steps is not None:
            self.config = of_brief_run(self.config, self._record.brief_steps, set(run.fixed))
            self.dataset = run.targets(self.config, BRIEF_ZOOMS)
        self._cloud, cameras = run.cloud, [view.camera for view in self.dataset.train]
        if (most := self._record.max_splats) is not None:
            setup.phase(f"merging {len(run.cloud):,} splats to {most:,}")
            self._cloud = simplify_in_blocks(run.cloud, most, cameras=cameras, threads=run.threads)
        setup.phase(f"converting {len(self._cloud):,} splats")
        wanted = without_cameras(self._options)
        self._to_convert = merged_within_limits(self._cloud, wanted, cameras, threads=run.threads)
        """Splats and options of the conversion."""
        conversion = self._converted()
        self._order = None
        if self.config.order == "file":
            setup.phase("ordering triangles")
            conversion = conversion.plain  # as files have it
            check_for_file_order(conversion, self.config)
            check_order_memory(conversion)
            views = ordering_views(conversion, self.dataset)
            self._order = drawing_order(conversion, views, threads=run.threads)
        setup.phase("scoring the conversion")
        seconds = None if setup.seconds is None else BASELINE_SHARE * setup.seconds
        self._baseline = measure_baseline(
            conversion,
            run.cloud,
            self.dataset,
            self.config,
            threads=run.threads,
            seconds=seconds,
            listing=self._order,
        )
        self._begins_converted = self.is_brief or self._order is not None
        self.mesh = conversion if self._begins_converted else self._started()
        """The mesh at the start."""
        self._saving = SAVE_SECONDS * len(self.mesh.faces)
        self.reserve = (2 if self.is_brief else 1) * self._baseline.seconds + self._saving
        """Seconds that are needed after the last step."""

    @property
    def is_brief(self) -> bool:
        """Whether the run is brief (``pace.is_brief``): it begins as the conversion and takes small steps."""
        return self._record.brief_steps is not None

    @property
    def rates(self) -> dict[str, float]:
        """Learning rates that differ from those of the configuration."""
        return {name: getattr(self.config, name) for name in BRIEF_RATES} if self.is_brief else {}

    def optimise(self, options: RunOptions, show: Display) -> Tuned:
        """The tuned mesh, or the conversion where that is better at some size. OptionsError if no triangle of
        it is opaque enough to stay."""
        best = self._best(options, show)
        if not len(best.mesh.faces):
            raise OptionsError(
                f"no triangle is as opaque as {self.config.cutoff:g}, the cutoff, before the run or after it:"
                " ``opacity`` 'blended' shows splats as faint as these"
            )
        return best

    def _best(self, options: RunOptions, show: Display) -> Tuned:
        run, baseline, config = self._run, self._baseline, self.config
        if not run.resumed:
            if not self._has_time():
                return Tuned(self.mesh, self._order, baseline.compared_with_itself())
            self._record.save(run.folder)
        order = self._order
        if order is None:
            tuned = finetune(self.mesh, self.dataset, config, run=options, on_progress=show)
        else:
            tuned, order = finetune_ordered(
                self.mesh, order, self.dataset, config, run=options, on_progress=show
            )
        show.phase("scoring the result")
        sizes = baseline.compare(tuned, config, run.threads, order)
        if not sizes.loses:
            return Tuned(tuned, order, sizes)
        start = self.mesh
        if self._begins_converted and tuned.plain_colors is not None:
            start = with_plain_means(start, self.dataset, threads=run.threads)
        for share in SHARES if self._begins_converted else ():
            late = self._setup.spent + baseline.seconds + self._saving - (self._setup.seconds or np.inf)
            if late > OVERTIME:
                break
            less = partly(start, tuned, share)
            if less is not None and not (found := baseline.compare(less, config, run.threads, order)).loses:
                log_scores(run.folder, less, self.dataset, config, run.threads, order)
                return Tuned(less, order, found)
        best = self.mesh if self._begins_converted else self._converted()
        log_scores(run.folder, best, self.dataset, config, run.threads, self._order)
        return Tuned(best, self._order, sizes)

    def _converted(self) -> SplatMesh:
        cameras = [view.camera for view in self.dataset.train]
        cloud, options = self._to_convert
        return converted(cloud, self.config, options, cameras)

    def _started(self) -> SplatMesh:
        """The starting mesh of a run that is not brief. The record notes the images that there was time for,
        or says it, if the run is resumed."""
        goes_on = self._setup.observer("choosing numbers of triangles", SETUP_SHARE)
        record, recorded = self._record, self._record.images

        def on_image(done: int, total: int) -> bool:
            in_time = goes_on(done, total)
            if self._run.resumed:
                return recorded is None or done < recorded
            record.images = done
            return in_time

        return starting_mesh(
            self._cloud,
            [view.camera for view in self.dataset.train],
            self._options,
            config=self._run.begun,
            threads=self._run.threads,
            on_image=on_image,
        )

    def _has_time(self) -> bool:
        """Whether what is left of the time is worth beginning a brief run."""
        seconds, steps = self._setup.seconds, self._record.brief_steps
        if seconds is None or steps is None:
            return True
        step = (1 - SETUP_SHARE) * seconds / steps
        return seconds - self._setup.spent - self.reserve >= FEWEST_BRIEF_STEPS * step

    def _timed(self) -> StartRecord:
        """What the time leaves of the start, by the speed of this machine."""
        run, chosen, config, dataset = self._run, self._run.options, self._run.config, self.dataset
        pixels = dataset.train[0].camera.width * dataset.train[0].camera.height
        limited = chosen.max_splats is not None or chosen.max_triangles is not None
        own = any(value is not None for value in (chosen.mode, chosen.detail, chosen.sides, chosen.rings))
        # In the order of a file, usual learning rates gain 2.5 dB where brief ones gain 1.0: a landscape of
        # 4.2 million splats, 1.6 million triangles, three minutes.
        listed = config.order == "file"
        may_be_brief = not config.cuts and not listed and dataset.look == "area" and not own
        steps: float | None = config.total_steps(len(dataset.train))
        count, seconds = len(run.cloud), self._setup.seconds
        timed = seconds is not None and count >= TIMED_SPLATS
        if not limited:
            count = min(count, most_splats(available_memory()) or count)
            if listed:
                count = min(count, FILE_TRIANGLES // usual_triangles_each())
        if timed:
            self._setup.phase("timing steps")
            pace = measure_pace(run.cloud, dataset, config, self._options, run.threads, run.device)
            left = (1 - SETUP_SHARE) * (seconds or 0)
            if (config.cuts or listed) and not limited:
                count = pace.splats(count, worthwhile_steps(config), left)
            steps = pace.steps(self._limited(count), left)
        brief = may_be_brief and steps is not None and is_brief(self._limited(count), pixels, steps, timed)
        return StartRecord(
            max_splats=count if count < len(run.cloud) else None,
            brief_steps=max(1, round(steps)) if brief and steps is not None else None,
        )

    def _limited(self, splats: int) -> int:
        """How many of them the options leave."""
        chosen = self._run.options
        if chosen.max_triangles is not None:
            splats = min(splats, max(chosen.max_triangles // usual_triangles_each(), 1))
        return min(splats, chosen.max_splats or splats)


def log_scores(
    folder: Path,
    mesh: SplatMesh,
    dataset: Dataset,
    config: FinetuneConfig,
    threads: int | None = None,
    listing: DrawOrder | None = None,
) -> None:
    """Logs the scores of ``mesh``, which is not that of the last step, on the held-out views in the journal
    of the run in ``folder``; drawn as a file with the order ``listing``."""
    if not dataset.test:
        return
    journal = Journal(folder)
    views = subsample(dataset.test, scored_count(journal) or SCORED_VIEWS)
    decibels, similarity = held_out_scores(mesh, views, config, threads, listing=listing)
    lines = journal.metrics()
    if lines and lines[-1].get("psnr") == decibels:
        return  # of a run that had ended, resumed again
    last = max((line["step"] for line in lines), default=0)
    count = len(mesh.faces)
    journal.log_metrics(last, psnr=decibels, ssim=similarity, views=len(views), triangles=count)
