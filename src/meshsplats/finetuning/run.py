"""finetune: the training loop, with scores, previews, checkpoints and interruption."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from meshsplats._arrays import checked_array, subsample
from meshsplats._kinds import need, need_path
from meshsplats._options import Range, check_options
from meshsplats._origin import need_one_origin
from meshsplats.datasets.views import CACHE_BYTES, Dataset, View
from meshsplats.evaluation.comparison import images_of_view
from meshsplats.evaluation.metrics import psnr
from meshsplats.evaluation.report import masked_ssim
from meshsplats.finetuning.checkpoint import (
    Checkpoint,
    OtherRunError,
    check_same_run,
    dataset_fingerprint,
    mesh_fingerprint,
    planned_length,
)
from meshsplats.finetuning.config import FinetuneConfig, with_changes
from meshsplats.finetuning.hybrid import (
    ColorLimits,
    opaque_fraction,
    soft_fraction,
    with_soft_splats,
)
from meshsplats.finetuning.interruption import Interrupted, StopSignals
from meshsplats.finetuning.journal import Journal
from meshsplats.finetuning.memory import check_memory
from meshsplats.finetuning.opaque import visible_samples
from meshsplats.finetuning.outlines import fewer_triangles
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import kept_faces, make_step, samples_of
from meshsplats.formats.cutting import cut_mesh
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.api import Device
from meshsplats.webgpu.device import open_device

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from meshsplats.finetuning.config import FinetuneChanges

WRAP_UP_SECONDS = 1.5
"""Time that a run with a length in minutes reserves for writing the mesh and rendering its preview. In short
runs it is a hundredth of the length."""

MIN_PREVIEWS = 4
"""Minimum number of previews per run."""

SCORED_VIEWS = 8
"""Maximum number of held-out views that are scored during a run."""

REPORT_SHARE = 0.02
"""Share of a run with a length in minutes that scoring them once may take; fewer are scored where it would be
more, but at least ``FEWEST_SCORED``."""

FEWEST_SCORED = 2

CHECKPOINT_SECONDS = 4e-7
"""Time to write a triangle's part of a checkpoint, before one was written."""

CHECKPOINT_SHARE = 0.05
"""Largest share of the time that checkpoints take."""


@dataclass(frozen=True)
class RunOptions:
    """Options that do not change the result, but for rounding: output folder, intervals of logging,
    resources."""

    folder: Path | None = None
    """Folder for checkpoint, metrics, previews and configuration. None: nothing is written."""
    resume: bool = False
    """Resume from the checkpoint in ``folder``."""
    report_every: Annotated[int, Range(0, math.inf)] = 100
    """Steps between two scores on held-out views. 0: only at the end."""
    preview_every: Annotated[int, Range(0, math.inf)] = 500
    """Steps between two preview images; also one after each quarter of the run. 0: none."""
    checkpoint_seconds: Annotated[float, Range(0, math.inf)] = 30.0
    """Seconds between two checkpoints."""
    threads: Annotated[int | None, Range(1, math.inf)] = None
    """Maximum number of threads. None: all processors."""
    device: Device = "cpu"
    """Where images are rendered, and gradients computed: 'cpu' or 'gpu'. Opacity 'cutoff' needs 'cpu'."""
    spent: Annotated[float, Range(0, math.inf)] = 0.0
    """Seconds already spent. They count towards ``minutes``."""
    reserve: Annotated[float, Range(0, math.inf)] = 0.0
    """Seconds that the caller needs afterwards. They count, too."""
    cache_bytes: Annotated[int, Range(0, math.inf)] = CACHE_BYTES
    """Limit of the data set's image cache, for the memory estimate."""

    def __post_init__(self) -> None:
        if self.folder is not None:
            need_path(folder=self.folder)
            object.__setattr__(self, "folder", Path(self.folder))
        check_options(self)
        if self.resume and self.folder is None:
            raise ValueError("resume needs the folder of the run")


@dataclass(frozen=True)
class Progress:
    """Progress of a run, after a step."""

    step: int
    """Number of steps taken."""
    steps: int | None
    """Total number of steps; None if the length is given in minutes."""
    fraction: float
    """Share of the run that is over, 0 to 1."""
    loss: float | None
    """Loss of the last step; None before the first."""
    held_out: float | None
    """Last mean PSNR on held-out views, in dB; None without such views."""
    seconds: float
    """Time used so far."""
    seconds_left: float | None
    """Estimated remaining time; None if unknown."""
    triangles: int
    """Number of triangles, which pruning reduces."""


def finetune(
    mesh: SplatMesh,
    dataset: Dataset,
    config: FinetuneConfig | None = None,
    *,
    run: RunOptions | None = None,
    frozen: np.ndarray | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    **changes: Unpack[FinetuneChanges],
) -> SplatMesh:
    """Optimises positions, colours and opacities of ``mesh`` on the training views of ``dataset``.

    The targets are photographs (``load_dataset``) or images of the splats themselves (``splat_dataset``). The
    result has the triangles of ``mesh`` except those that were pruned; with ``opacity='cutoff'`` they are
    opaque and cut where their opacity crosses the cutoff, apart from those that ``soft_share`` keeps blended.
    It has no normals, since those of ``mesh`` would not fit it.

    Args:
        config: the configuration; the preset 'default' by default.
        run: output folder, resumption from a checkpoint, logging and resources.
        frozen: (v,) bool, True for vertices of ``mesh`` that keep their positions and colours; none by
            default. Not with opacity 'cutoff'.
        on_progress: called after every step.
        changes: fields of ``FinetuneConfig`` in place of those of ``config``: ``finetune(mesh, data,
            minutes=2)``.

    Raises:
        TypeError: a field that does not exist.
        ValueError: no training view, an empty mesh, ``frozen`` of another shape, mesh and views of different
            origins.
        OtherRunError: the checkpoint is of another run.
        MemoryError: the estimated memory is not available, or the mesh does not fit on the GPU; of a run that
            starts, nothing was written.
        DivergenceError: the loss or a gradient is not finite; the message names the view.
        MissingDependencyError: device 'gpu' without a GPU, or no library for it; nothing was written.
        DeviceError: the mesh has too many triangles at a vertex, or in a splat with a filter, for the GPU; of
            a run that starts, nothing was written. Or the GPU failed, or did not finish an image.
        Interrupted: SIGINT or SIGTERM arrived; a checkpoint is in the folder, if there is one.
    """
    need(SplatMesh, mesh=mesh)
    need(Dataset, dataset=dataset)
    need(FinetuneConfig, config=config, optional=True)
    need(RunOptions, run=run, optional=True)
    need_one_origin({"mesh": mesh, "dataset": dataset})
    config, run = with_changes(config or FinetuneConfig(), **changes), run or RunOptions()
    if not dataset.train:
        raise ValueError("the data set has no training views")
    if not len(mesh.faces):
        raise ValueError("the mesh has no triangles: there is nothing to fine-tune")
    if frozen is not None:
        frozen = checked_array("frozen", frozen, bool, (len(mesh.vertices),))
        if config.opacity == "cutoff":
            raise ValueError("frozen vertices are not for opacity 'cutoff'")
    if run.device == "gpu":
        if config.opacity == "cutoff":
            raise ValueError("opacity 'cutoff' needs device 'cpu': the GPU has no gradients for a cutoff")
        open_device()
    check_memory(mesh, dataset, cache_bytes=run.cache_bytes)
    journal = None if run.folder is None else Journal(run.folder)
    start = run_start(mesh, dataset, config, run, journal, frozen)
    loop = TrainingLoop(start, dataset, config, run, journal, on_progress)
    del start
    return loop.run()


@dataclass(frozen=True, eq=False)
class RunStart:
    """Where a run starts: before its first step, or at a checkpoint."""

    state: State
    fingerprints: tuple[str, str]
    """Those of the mesh and the data set; empty for a run without checkpoints."""
    mesh: SplatMesh
    """The mesh before the first step."""
    step: int = 0
    """Number of steps already taken."""
    seconds: float = 0.0
    """Time used for them."""
    losses: tuple[float, ...] = ()
    """Losses of the steps since the last line of the metrics."""
    planned: dict[str, Any] | None = None
    """``Checkpoint.planned``."""


def run_start(
    mesh: SplatMesh,
    dataset: Dataset,
    config: FinetuneConfig,
    options: RunOptions,
    journal: Journal | None,
    frozen: np.ndarray | None = None,
) -> RunStart:
    """Begins or resumes the run in the folder of ``journal``."""
    views = len(dataset.train)
    if journal is None:
        state = State.begin(mesh, views, config, options.threads, frozen=frozen, device=options.device)
        return RunStart(state, ("", ""), mesh)
    fingerprints = mesh_fingerprint(mesh, frozen), dataset_fingerprint(dataset)
    if not options.resume:
        state = State.begin(mesh, views, config, options.threads, frozen=frozen, device=options.device)
        journal.begin(config.to_dict())
        return RunStart(state, fingerprints, mesh)
    total = config.total_steps(views)

    def check(found: Checkpoint) -> None:
        check_same_run(found, config, *fingerprints)
        if total is not None and found.step > total:
            raise OtherRunError(f"the run has taken {found.step:,} steps already, {total:,} were requested")

    found = journal.resume(config.to_dict(), check)
    blending = "linear" if config.blending == "linear" else mesh.blending
    state = State.resume(found.arrays, blending, views, config, options.threads, options.device)
    return RunStart(state, fingerprints, mesh, found.step, found.seconds, found.losses, planned_length(found))


class TrainingLoop:
    """The loop over all steps, with its clock and its output."""

    def __init__(
        self,
        start: RunStart,
        dataset: Dataset,
        config: FinetuneConfig,
        options: RunOptions,
        journal: Journal | None,
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        # One near plane for all steps, though vertices move.
        self.dataset = dataset.with_near_planes(start.mesh.vertices)
        self.config, self.options = config, options
        self.journal, self.on_progress = journal, on_progress
        # The start itself is not kept: pruning replaces its state, whose memory is then free.
        self.state, self.step, self.losses = start.state, start.step, list(start.losses)
        self.fingerprints, self.first_step, self.planned = start.fingerprints, start.step, start.planned
        self.steps = config.total_steps(len(dataset.train))
        self.start_time = time.perf_counter() - (start.seconds or options.spent)
        self.first_seconds = self.seconds
        self.save_time = time.perf_counter()
        self.last_loss: float | None = None
        self.held_out: float | None = None
        self.report_cost = self.save_cost = self.step_cost = 0.0
        self.scored_views: tuple[View, ...] = subsample(self.dataset.test, SCORED_VIEWS)
        self.views_limited = False
        self.quarter = int(MIN_PREVIEWS * self.fraction)
        share = config.opaque_share
        self.most_opaque = None if share == 1 else max(1, round(share * len(start.mesh.faces)))
        self.source = start.mesh if config.soft_share else None
        # A resumed run may have removed hidden triangles before its checkpoint.
        self.settled = start.step > 0 and opaque_fraction(config, self.fraction) >= 1 - config.settling

    @property
    def seconds(self) -> float:
        """Time used so far, including that before a resumed run's checkpoint."""
        return time.perf_counter() - self.start_time

    @property
    def limit(self) -> float | None:
        """Seconds after which no step begins, so that the last report and the result are written in time."""
        if self.config.minutes is None:
            return None
        total = 60 * self.config.minutes
        reserve = 1.5 * (self.report_cost + self.save_cost) + self.step_cost + self.options.reserve
        return max(total - (reserve + min(0.01 * total, WRAP_UP_SECONDS)), 0)

    @property
    def fraction(self) -> float:
        """Share of the run that is over, 0 to 1."""
        if self.limit is not None:
            return min(1.0, self.seconds / self.limit) if self.limit > 0 else 1.0
        return self.step / self.steps if self.steps else 1.0

    def run(self) -> SplatMesh:
        """Takes all steps. Interrupted, after a checkpoint, if a signal arrived."""
        with StopSignals() as signals:
            if self.step == 0:
                self._report()
                self._save_preview()
                self._save_first_checkpoint()
            while not self._done():
                if signals.received is not None:
                    self._save_checkpoint()
                    raise Interrupted(self.step, signals.received)
                start, step = time.perf_counter(), self.step
                loss = make_step(self.state, self._views(), step, self.fraction)
                self.step_cost = time.perf_counter() - start
                self.step += 1
                if loss is not None:
                    self._note(step, loss)
                self._adapt()
                if self._due(self.options.report_every) and not self._done():
                    self._report()
                if self._passed_quarter() or self._due(self.options.preview_every):
                    self._save_preview()
                if time.perf_counter() - self.save_time >= self._checkpoint_interval:
                    self._save_checkpoint()
                self._notify()
            if self.step > self.first_step:
                self._report()
                self._save_checkpoint()
            self._notify()
            if signals.received is not None:
                raise Interrupted(self.step, signals.received)
        return self.result()

    def _save_first_checkpoint(self) -> None:
        """Not in a run whose time it would take: if that is interrupted, it saves one all the same."""
        if self.config.minutes is None:
            self._save_checkpoint()
        else:
            self.save_cost = CHECKPOINT_SECONDS * len(self.state.mesh.faces)

    @property
    def _checkpoint_interval(self) -> float:
        """Seconds between two checkpoints: more where writing one takes long."""
        return max(self.options.checkpoint_seconds, self.save_cost / CHECKPOINT_SHARE)

    def result(self) -> SplatMesh:
        """The current mesh, cut if it is made for a cutoff."""
        mesh = self.state.result()
        uncut = self.config.opacity == "cutoff" and self.state.solid is None
        return cut_mesh(mesh, self.config.cutoff) if uncut else mesh

    def _views(self) -> Sequence[View]:
        """The training views of the next step."""
        return self.dataset.train

    def _note(self, step: int, loss: float) -> None:
        """Notes the loss of step ``step`` (from 0)."""
        self.losses.append(loss)
        self.last_loss = loss

    def _adapt(self) -> None:
        """Removes triangles where that is due after the step that was taken."""
        if self._settles():
            self._remove_hidden()
        if self._becomes_hybrid():
            self._cut()
        if self._due(self.config.prune_interval(len(self.dataset.train))) and not self._done():
            self.state = self.state.prune(kept_faces(self.state))
        if self.state.solid is not None:
            self._limit_colors()

    def _due(self, interval: int) -> bool:
        """Whether the count of steps is a multiple of ``interval``; 0: never."""
        return bool(interval) and self.step % interval == 0

    def _settles(self) -> bool:
        """Whether it is time to remove the triangles that no training view shows: once."""
        fraction = opaque_fraction(self.config, self.fraction)
        due = self.config.opacity == "cutoff" and fraction >= 1 - self.config.settling
        now, self.settled = due and not self.settled, self.settled or due
        removes = self.config.hidden_hits > 0 or self.most_opaque is not None
        return now and removes and not self._done()

    def _remove_hidden(self) -> None:
        """Removes what no training view shows, and keeps to the budget of opaque triangles."""
        config, mesh = self.config, self.state.result()
        cutoff, views, threads = config.cutoff, self.dataset.train, self.options.threads
        if self.most_opaque is None:
            keep = visible_samples(mesh, views, cutoff, threads) >= config.hidden_hits
            if keep.any():
                self.state = self.state.prune(keep)
            return
        mesh = cut_mesh(mesh, cutoff)
        hits = visible_samples(mesh, views, cutoff, threads)
        mesh = fewer_triangles(mesh, hits, self.most_opaque, config.hidden_hits)
        if len(mesh.faces):
            self.state = State.begin_opaque(mesh, config, threads)

    def _becomes_hybrid(self) -> bool:
        """Whether it is time to cut the mesh and to add blended triangles: once."""
        due = self.state.solid is None and soft_fraction(self.config, self.fraction) >= 0
        return due and not self._done()

    def _cut(self) -> None:
        assert self.source is not None
        core = self.result()
        if len(core.faces):
            mesh = with_soft_splats(
                core, self.source, self.dataset.train, self.config.soft_share, self.options.threads
            )
            self.state = State.begin_hybrid(mesh, self.config, self.options.threads)

    def _limit_colors(self) -> None:
        state = self.state
        if state.color_limits is None:
            state.color_limits = ColorLimits.measured(state.result(), self.dataset.train)
        state.color_limits.apply(state.colors)

    def _done(self) -> bool:
        if self.limit is not None:
            return self.seconds >= self.limit
        return self.step >= (self.steps or 0)

    def _report(self) -> None:
        """Scores the held-out views and writes a line of the metrics."""
        start = time.perf_counter()
        loss = float(np.mean(self.losses)) if self.losses else None
        mean_ssim = None
        if self.scored_views:
            self._limit_scored_views()
            self.held_out, mean_ssim = self._score(self.scored_views)
        if self.journal is not None:
            self.journal.log_metrics(
                self.step,
                loss=loss,
                psnr=self.held_out,
                ssim=mean_ssim,
                views=len(self.scored_views),
                triangles=len(self.state.mesh.faces),
                seconds=round(self.seconds, 3),
            )
        self.losses.clear()
        self.report_cost = time.perf_counter() - start

    def _limit_scored_views(self) -> None:
        """Leaves as many views to be scored as there is time for; all reports of a run have the same."""
        if self.views_limited or self.config.minutes is None or len(self.scored_views) < 2:
            return
        self.views_limited = True
        scored = None if self.journal is None else scored_count(self.journal)
        if scored is not None and self.first_step:
            self.scored_views = subsample(self.dataset.test, scored)
            return
        start = time.perf_counter()
        self._score(self.scored_views[:1])
        cost = time.perf_counter() - start
        count = int(REPORT_SHARE * 60 * self.config.minutes / cost) if cost > 0 else SCORED_VIEWS
        self.scored_views = subsample(self.dataset.test, min(max(count, FEWEST_SCORED), SCORED_VIEWS))

    def _score(self, views: Sequence[View]) -> tuple[float, float]:
        options = self.options
        return held_out_scores(self.result(), views, self.config, options.threads, options.device)

    def _passed_quarter(self) -> bool:
        quarter = int(MIN_PREVIEWS * self.fraction)
        passed, self.quarter = quarter > self.quarter, quarter
        return passed

    def _save_preview(self) -> None:
        if self.journal is None or not self.options.preview_every:
            return
        view = (self.scored_views or self.dataset.train)[0]
        options, samples = self.options, samples_of(view, self.config)
        image, target = images_of_view(
            self.result(), view, samples=samples, threads=options.threads, device=options.device
        )
        self.journal.save_preview(self.step, target, image)

    def _save_checkpoint(self) -> None:
        self.save_time = time.perf_counter()
        if self.journal is None:
            return
        self.journal.save(
            Checkpoint(
                self.step,
                self.seconds,
                self.config.to_dict(),
                *self.fingerprints,
                self.state.arrays(),
                tuple(self.losses),
                self.planned,
            )
        )
        self.save_cost = time.perf_counter() - self.save_time

    def _notify(self) -> None:
        """Calls ``on_progress``."""
        if self.on_progress is None:
            return
        left = None
        if self.limit is not None:
            left = max(self.limit - self.seconds, 0.0)
        elif self.steps is not None and self.step > self.first_step:
            pace = (self.seconds - self.first_seconds) / (self.step - self.first_step)
            left = pace * (self.steps - self.step)
        self.on_progress(
            Progress(
                self.step,
                self.steps,
                self.fraction,
                self.last_loss,
                self.held_out,
                self.seconds,
                left,
                len(self.state.mesh.faces),
            )
        )


def scored_count(journal: Journal) -> int | None:
    """How many views the last scores in ``journal`` are means over; None if there are none."""
    lines = [line.get("views") for line in journal.metrics()]
    return lines[-1] if lines and isinstance(lines[-1], int) and lines[-1] > 0 else None


def held_out_scores(
    mesh: SplatMesh,
    views: Sequence[View],
    config: FinetuneConfig,
    threads: int | None,
    device: Device = "cpu",
) -> tuple[float, float]:
    """Means of PSNR, in dB and at most 200, and SSIM of ``mesh`` in ``views``, at least one."""
    scores = []
    for view in views:
        samples = samples_of(view, config)
        image, target = images_of_view(mesh, view, samples=samples, threads=threads, device=device)
        decibels = min(psnr(image, target, mask=view.mask), 200.0)
        scores.append((decibels, masked_ssim(image, target, view.mask, threads)))
    mean_psnr, mean_ssim = (float(mean) for mean in np.mean(scores, axis=0))
    return mean_psnr, mean_ssim
