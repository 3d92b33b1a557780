"""finetune: the training loop, with scores, previews, checkpoints and interruption."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from meshsplats._common.arrays import checked_array
from meshsplats._common.kinds import need
from meshsplats.datasets.splat_targets import are_rendered
from meshsplats.datasets.views import Dataset
from meshsplats.errors import OtherRunError
from meshsplats.finetuning.checkpoint import (
    Checkpoint,
    check_same_run,
    dataset_fingerprint,
    mesh_fingerprint,
    planned_length,
)
from meshsplats.finetuning.clock import Clock
from meshsplats.finetuning.config import FinetuneConfig, with_changes
from meshsplats.finetuning.initial import order_of
from meshsplats.finetuning.interruption import Interrupted, StopSignals
from meshsplats.finetuning.journal import Journal, claimed
from meshsplats.finetuning.loss import Loss, check_loss, loss_name
from meshsplats.finetuning.memory import check_memory
from meshsplats.finetuning.phases.choice import PHASE_ARRAYS, check_phases, first_phase
from meshsplats.finetuning.phases.phase import Moment, Phase
from meshsplats.finetuning.plain import most_images, with_plain_colors
from meshsplats.finetuning.reports import Reports, scored_count
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import for_views, make_step
from meshsplats.rendering.devices import engine
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.origin import need_one_origin

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from meshsplats.finetuning.config import FinetuneChanges

MIN_PREVIEWS = 4
"""Minimum number of previews per run."""

CHECKPOINT_SECONDS = 4e-7
"""Time to write a triangle's part of a checkpoint, before one was written."""

CHECKPOINT_SHARE = 0.05
"""Largest share of the time that checkpoints take."""


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
    loss: Loss | None = None,
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
        loss: in place of the default one (see ``FinetuneConfig``): a function ``loss(image, target)`` that
            returns the loss of an image and its gradient (``finetuning.loss.Loss``). On the GPU, too, it runs
            on the processor. Checkpoints know it by its name.
        on_progress: called after every step.
        changes: fields of ``FinetuneConfig`` in place of those of ``config``: ``finetune(mesh, data,
            minutes=2)``.

    Raises:
        TypeError: a field that does not exist; a ``loss`` that is no function, or returns something else.
        ValueError: no training view, an empty mesh, ``frozen`` of another shape, mesh and views of different
            origins; weights of the default loss beside another; a gradient of ``loss`` that does not have the
            shape of the image.
        OtherRunError: the checkpoint is of another run.
        FileExistsError: the folder has the checkpoint of an earlier run (``RunOptions.replace_old``), files
            of no run that would be replaced, or another process at work; nothing was written.
        MemoryError: the estimated memory is not available, or the mesh does not fit on the GPU; of a run that
            starts, nothing was written.
        DivergenceError: the loss or a gradient is not finite; the message names the view.
        MissingDependencyError: device 'gpu' without a GPU, or no library for it; nothing was written.
        DeviceError: the mesh has too many triangles at a vertex, or in a splat with a filter, for the GPU; of
            a run that starts, nothing was written. Or the GPU failed, or did not finish an image.
        Interrupted: SIGINT, SIGTERM or SIGHUP arrived; a checkpoint is in the folder, if there is one.
    """
    need(FinetuneConfig, config=config, optional=True)
    config = with_changes(config or FinetuneConfig(), **changes)
    if config.order == "file":
        raise ValueError("order 'file' gives a mesh and the order of its triangles: call finetune_ordered")
    if loss is not None:
        check_loss(loss, config, changes)
    with claimed(run):
        loop = ready_loop(mesh, dataset, config, run, frozen=frozen, loss=loss, on_progress=on_progress)
        return loop.run()


def ready_loop(
    mesh: SplatMesh,
    dataset: Dataset,
    config: FinetuneConfig,
    run: RunOptions | None = None,
    *,
    frozen: np.ndarray | None = None,
    loss: Loss | None = None,
    listing: DrawOrder | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> TrainingLoop:
    """The loop of a run, checked and begun or resumed in a folder that is ``claimed``. Arguments and errors
    as in ``finetune``; ``listing``: of a run with order 'file', which needs one unless it is resumed."""
    need(SplatMesh, mesh=mesh)
    need(Dataset, dataset=dataset)
    need(RunOptions, run=run, optional=True)
    need_one_origin({"mesh": mesh, "dataset": dataset})
    run = run or RunOptions()
    if not dataset.train:
        raise ValueError("the data set has no training views")
    if not len(mesh.faces):
        raise ValueError("the mesh has no triangles: there is nothing to fine-tune")
    if frozen is not None:
        frozen = checked_array("frozen", frozen, bool, (len(mesh.vertices),))
    check_phases(config, mesh, engine(run.device, run.threads), frozen)
    if not are_rendered(dataset.test):
        dataset = dataset.scorable()
    check_memory(mesh, dataset, cache_bytes=run.cache_bytes)
    config = for_views(config, dataset.train)
    journal = None if run.folder is None else Journal(run.folder)
    start = run_start(mesh, dataset, config, run, journal, frozen=frozen, loss=loss)
    clock = start.clock(run)
    resumed = clock.fraction if start.step else None
    phase = first_phase(config, mesh, start.state, resumed=resumed, arrays=start.arrays, listing=listing)
    return TrainingLoop(start, clock, phase, run, on_progress)


@dataclass(frozen=True, eq=False)
class RunStart:
    """Where a run starts: before its first step, or at a checkpoint."""

    config: FinetuneConfig
    dataset: Dataset
    """With one near plane for all steps, though vertices move."""
    mesh: SplatMesh
    """The mesh before the first step."""
    state: State
    journal: Journal | None
    fingerprints: tuple[str, str]
    """Those of the mesh and the data set; empty for a run without checkpoints."""
    loss: Loss | None
    step: int = 0
    """Number of steps already taken."""
    seconds: float = 0.0
    """Time used for them."""
    losses: tuple[float, ...] = ()
    """Losses of the steps since the last line of the metrics."""
    planned: dict[str, Any] | None = None
    """``Checkpoint.planned``."""
    arrays: dict[str, np.ndarray] | None = None
    """Those of the phase, from a checkpoint."""
    setup_seconds: float = 0.0
    """``Clock.setup_seconds``."""

    def clock(self, options: RunOptions) -> Clock:
        """The clock of the run, which is now at its start."""
        return Clock(
            self.config,
            len(self.dataset.train),
            step=self.step,
            seconds=self.seconds or options.spent,
            setup_seconds=self.setup_seconds,
            reserve=options.reserve,
        )


def run_start(
    mesh: SplatMesh,
    dataset: Dataset,
    config: FinetuneConfig,
    options: RunOptions,
    journal: Journal | None,
    *,
    frozen: np.ndarray | None = None,
    loss: Loss | None = None,
    kind: type[State] = State,
) -> RunStart:
    """Begins or resumes the run in the folder of ``journal``, with a state of this ``kind``."""
    views, near = len(dataset.train), dataset.with_near_planes(mesh.vertices)
    fingerprints = ("", "")
    if journal is not None:
        fingerprints = mesh_fingerprint(mesh, frozen), dataset_fingerprint(dataset)
    if journal is None or not options.resume:
        cameras = [view.camera for view in dataset.train]
        state = kind.begin(
            mesh, views, config, options.threads, cameras=cameras, frozen=frozen, device=options.device
        )
        if journal is not None:
            journal.begin(config.to_dict())
        return RunStart(config, near, mesh, state, journal, fingerprints, loss)
    total = config.total_steps(views)

    def check(found: Checkpoint) -> None:
        check_same_run(found, config, *fingerprints, loss_name(loss))
        if total is not None and found.step > total:
            raise OtherRunError(f"the run has taken {found.step:,} steps already, {total:,} were requested")

    found = journal.resume(config.to_dict(), check)
    blending = "linear" if config.blending == "linear" else mesh.blending
    state = kind.resume(
        found.arrays, blending, order_of(mesh, config), views, config, options.threads, options.device
    )
    return RunStart(
        config,
        near,
        mesh,
        state,
        journal,
        fingerprints,
        loss,
        found.step,
        found.seconds,
        found.losses,
        planned_length(found),
        {name: found.arrays[name] for name in PHASE_ARRAYS if name in found.arrays},
        found.setup_seconds,
    )


class TrainingLoop:
    """The loop over all steps, with its output. The phase decides what a step is, and what follows it."""

    def __init__(
        self,
        start: RunStart,
        clock: Clock,
        phase: Phase,
        options: RunOptions,
        on_progress: Callable[[Progress], None] | None = None,
        *,
        plain: bool = True,
    ) -> None:
        """``plain``: the mesh gets plain colours, which take some of the time."""
        self.plain = plain
        self.config, self.dataset, self.journal = start.config, start.dataset, start.journal
        self.clock, self.phase, self.options, self.on_progress = clock, phase, options, on_progress
        # The start itself is not kept: pruning replaces its state, whose memory is then free.
        self.state, self.loss, self.losses = start.state, start.loss, list(start.losses)
        self.fingerprints, self.first_step, self.planned = start.fingerprints, start.step, start.planned
        self.save_time = time.perf_counter()
        self.last_loss: float | None = None
        self.held_out: float | None = None
        scored = scored_count(start.journal) if start.journal is not None and start.step else None
        self.reports = Reports(self.dataset, self.config, options.threads, options.device, scored)
        self._plan_plain_images()
        self.quarter = int(MIN_PREVIEWS * clock.fraction)

    def run(self) -> SplatMesh:
        """Takes all steps. Interrupted, after a checkpoint, if a signal arrived."""
        clock, options = self.clock, self.options
        with StopSignals() as signals:
            if clock.step == 0:
                self._report()
                self._save_preview()
                self._save_first_checkpoint()
            while not clock.done:
                if signals.received is not None:
                    self._save_checkpoint()
                    raise Interrupted(clock.step, signals.received)
                self._step()
                if clock.due(options.report_every) and not clock.done:
                    self._report()
                if self._passed_quarter() or clock.due(options.preview_every):
                    self._save_preview()
                if time.perf_counter() - self.save_time >= self._checkpoint_interval:
                    self._save_checkpoint()
                if signals.received is None:  # else the terminal may be gone
                    self._notify()
            if clock.step > self.first_step:
                self._report()
                self._save_checkpoint()
            if signals.received is not None:
                raise Interrupted(clock.step, signals.received)
            self._notify()
        return self.finished()

    def _step(self) -> None:
        clock, phase = self.clock, self.phase
        start, fraction = time.perf_counter(), clock.fraction
        views = phase.views(self.dataset.train, fraction)
        self.state = phase.before_step(self.state, fraction)
        loss = make_step(self.state, views, clock.step, fraction, phase, self.loss)
        clock.step_cost = time.perf_counter() - start
        clock.step += 1
        self._plan_plain_images()
        if loss is not None:
            self.losses.append(loss)
            self.last_loss = loss
        moment = Moment(clock, self.dataset.train, loss)
        self.phase, self.state = phase.after_step(self.state, moment)

    def _save_first_checkpoint(self) -> None:
        """Not in a run whose time it would take: if that is interrupted, it saves one all the same."""
        if self.config.minutes is None:
            self._save_checkpoint()
        else:
            self.clock.save_cost = CHECKPOINT_SECONDS * len(self.state.mesh.faces)

    @property
    def _checkpoint_interval(self) -> float:
        """Seconds between two checkpoints: more where writing one takes long."""
        return max(self.options.checkpoint_seconds, self.clock.save_cost / CHECKPOINT_SHARE)

    def result(self) -> SplatMesh:
        """The current mesh, as the phase hands it over."""
        return self.phase.result(self.state)

    def _plan_plain_images(self) -> None:
        if self.plain and self.state.mesh.harmonics is not None and self.clock.step:
            self.clock.plan_plain_images(most_images(self.clock.step))

    def finished(self) -> SplatMesh:
        """``result``, with plain colours for programs that draw no harmonics."""
        mesh, images = self.result(), self.clock.plain_images
        if mesh.harmonics is None or not images:
            return mesh
        return with_plain_colors(mesh, self.dataset, self.config, images, threads=self.options.threads)

    def _report(self) -> None:
        """Scores the held-out views and writes a line of the metrics."""
        start = time.perf_counter()
        loss = float(np.mean(self.losses)) if self.losses else None
        mean_ssim = None
        if self.reports.views:
            self.held_out, mean_ssim = self.reports.scores(self.result(), self.phase.listing)
        if self.journal is not None:
            self.journal.log_metrics(
                self.clock.step,
                loss=loss,
                psnr=self.held_out,
                ssim=mean_ssim,
                views=len(self.reports.views),
                triangles=len(self.state.mesh.faces),
                seconds=round(self.clock.seconds, 3),
            )
        self.losses.clear()
        self.clock.report_cost = time.perf_counter() - start

    def _passed_quarter(self) -> bool:
        quarter = int(MIN_PREVIEWS * self.clock.fraction)
        passed, self.quarter = quarter > self.quarter, quarter
        return passed

    def _save_preview(self) -> None:
        if self.journal is not None and self.options.preview_every:
            self.reports.save_preview(self.journal, self.clock.step, self.result(), self.phase.listing)

    def _save_checkpoint(self) -> None:
        self.save_time = time.perf_counter()
        if self.journal is None:
            return
        self.journal.save(
            Checkpoint(
                self.clock.step,
                self.clock.seconds,
                self.config.to_dict(),
                *self.fingerprints,
                self.state.arrays() | self.phase.arrays(),
                tuple(self.losses),
                self.planned,
                loss_name(self.loss),
                self.clock.setup_seconds,
            )
        )
        self.clock.save_cost = time.perf_counter() - self.save_time

    def _notify(self) -> None:
        """Calls ``on_progress``."""
        if self.on_progress is None:
            return
        clock = self.clock
        self.on_progress(
            Progress(
                clock.step,
                clock.steps,
                clock.fraction,
                self.last_loss,
                self.held_out,
                clock.seconds,
                clock.seconds_left,
                len(self.state.mesh.faces),
            )
        )
