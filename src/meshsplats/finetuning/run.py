"""finetune: the loop, with reports, checkpoints and a way to stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meshsplats._arrays import subsample
from meshsplats.datasets.views import CACHE_BYTES, Dataset, View
from meshsplats.evaluation.metrics import psnr
from meshsplats.evaluation.report import image_of, masked_ssim
from meshsplats.finetuning.checkpoint import (
    Checkpoint,
    OtherRunError,
    check_same_run,
    dataset_fingerprint,
    mesh_fingerprint,
)
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.finetuning.interruption import Interrupted, StopSignals
from meshsplats.finetuning.journal import Journal
from meshsplats.finetuning.memory import check_memory
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import kept_faces, make_step, relocate, samples_of
from meshsplats.mesh import SplatMesh

RELOCATED = 0.5
"""Splats are moved in this share of the run: those moved later would not settle any more."""

WRITING = 1.5
"""Seconds kept back, of a run whose length is a time, for what follows it: writing the mesh, drawing its
preview. In short runs a hundredth of the time."""

PREVIEWS = 4
"""Previews that each run has at least."""

WATCHED_VIEWS = 8
"""Most held-out views that are scored while a run goes on."""


@dataclass(frozen=True)
class RunOptions:
    """What does not change the result: where the run is written down, how often, and with what."""

    folder: Path | None = None
    """Folder for checkpoint, metrics, previews and configuration; None: nothing is written."""
    resume: bool = False
    """Go on from the checkpoint in ``folder``."""
    report_every: int = 100
    """Steps from one score on held-out views to the next; 0: only at the end."""
    preview_every: int = 500
    """Steps from one preview picture to the next; in short runs there is one after each quarter. 0: none."""
    checkpoint_seconds: float = 30.0
    """Time from one checkpoint to the next."""
    threads: int | None = None
    """At most so many; all processors by default."""
    spent: float = 0.0
    """Seconds already used, which count where the length is given in minutes."""
    cache_bytes: int = CACHE_BYTES
    """Of the data set, for the memory estimate."""

    def __post_init__(self) -> None:
        for name in ("report_every", "preview_every"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must be a number of steps, >= 0, got {getattr(self, name)}")
        if not self.checkpoint_seconds > 0:
            raise ValueError(f"checkpoint_seconds must be positive, got {self.checkpoint_seconds}")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}")
        if self.resume and self.folder is None:
            raise ValueError("resume needs the folder of the run")


@dataclass(frozen=True)
class Progress:
    """How far a run is."""

    step: int
    steps: int | None
    """In all; None where time is the limit."""
    fraction: float
    """0 to 1."""
    loss: float | None
    """Of the last step; None before the first."""
    held_out: float | None
    """Mean PSNR on held-out views, dB, when last scored; None without such views."""
    seconds: float
    """Used so far."""
    seconds_left: float | None
    """Estimate."""
    triangles: int


def finetune(
    mesh: SplatMesh,
    dataset: Dataset,
    config: FinetuneConfig | None = None,
    *,
    run: RunOptions | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> SplatMesh:
    """``mesh`` with positions, colours and opacities optimised so that its pictures are those of the training
    views of ``dataset``: photographs (``load_dataset``) or the splats' own pictures (``splat_dataset``).

    Triangles stay as they are, apart from those that are pruned. The result has no normals, for the old ones
    would not fit it.

    Args:
        config: what is done; the preset 'default' by default.
        run: where it is written down, and whether it goes on from a checkpoint.
        on_progress: called after every step.

    Raises:
        ValueError: no training view, an empty mesh. OtherRunError: the checkpoint is of another run.
        MemoryError: it would not fit; nothing was written.
        DivergenceError: a view gave values that are not finite; names it.
        Interrupted: after SIGINT or SIGTERM, with a checkpoint, if there is a folder.
    """
    config, run = config or FinetuneConfig(), run or RunOptions()
    if not dataset.train:
        raise ValueError("the data set has no training views")
    if not len(mesh.faces):
        raise ValueError("the mesh has no triangles: there is nothing to fine-tune")
    check_memory(mesh, dataset, cache_bytes=run.cache_bytes)
    journal = None if run.folder is None else Journal(run.folder)
    prints = (mesh_fingerprint(mesh), dataset_fingerprint(dataset)) if journal is not None else ("", "")
    views = len(dataset.train)
    if journal is not None and run.resume:
        total = config.total_steps(views)

        def check(found: Checkpoint) -> None:
            check_same_run(found, config, *prints)
            if total is not None and found.step > total:
                raise OtherRunError(f"the run has made {found.step:,} steps already, {total:,} are asked for")

        found = journal.resume(config.to_dict(), check)
        blending = "linear" if config.blending == "linear" else mesh.blending
        state = State.resume(found.arrays, blending, views, config, run.threads)
        step, spent, losses = found.step, found.seconds, found.losses
    else:
        state = State.begin(mesh, views, config, run.threads)
        step, spent, losses = 0, 0.0, ()
        if journal is not None:
            journal.begin(config.to_dict())
    return _Run(state, dataset, config, run, journal, prints, step, spent, losses, on_progress).go()


class _Run:
    """The loop and its clock."""

    def __init__(
        self,
        state: State,
        dataset: Dataset,
        config: FinetuneConfig,
        run: RunOptions,
        journal: Journal | None,
        prints: tuple[str, str],
        step: int,
        spent: float,
        losses: Sequence[float],
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        self.state, self.dataset, self.config, self.run, self.journal = state, dataset, config, run, journal
        self.prints, self.step, self.on_progress = prints, step, on_progress
        self.steps = config.total_steps(len(dataset.train))
        self.began = time.perf_counter() - (spent or run.spent)
        self.saved_at = time.perf_counter()
        self.first, self.first_seconds = step, self.seconds
        self.losses = list(losses)
        self.last_loss: float | None = None
        self.held_out: float | None = None
        self.report_cost = self.save_cost = self.step_cost = 0.0
        watched = subsample(dataset.test, WATCHED_VIEWS)
        self.watched: tuple[View, ...] = watched
        self.quarter = int(PREVIEWS * self.fraction)

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.began

    @property
    def limit(self) -> float | None:
        """Seconds after which no step begins; what follows the last step has to fit, too."""
        if self.config.minutes is None:
            return None
        whole = 60 * self.config.minutes
        closing = 1.5 * (self.report_cost + self.save_cost) + self.step_cost + min(0.01 * whole, WRITING)
        return max(whole - closing, 0)

    @property
    def fraction(self) -> float:
        if self.limit is not None:
            return min(1.0, self.seconds / self.limit) if self.limit > 0 else 1.0
        return self.step / self.steps if self.steps else 1.0

    def go(self) -> SplatMesh:
        views = self.dataset.train
        interval = self.config.prune_interval(len(views))
        moves = self.config.relocate_interval(len(views))
        with StopSignals() as signals:
            if self.step == 0:
                self._report()
                self._preview()
                self._save()
            while not self._done():
                if signals.received is not None:
                    self._save()
                    raise Interrupted(self.step, signals.received)
                start = time.perf_counter()
                loss = make_step(self.state, views, self.step, self.fraction)
                self.step_cost = time.perf_counter() - start
                self.step += 1
                if loss is not None:
                    self.losses.append(loss)
                    self.last_loss = loss
                if interval and self.step % interval == 0 and not self._done():
                    self.state = self.state.prune(kept_faces(self.state, views))
                if moves and self.step % moves == 0 and self.fraction <= RELOCATED:
                    relocate(self.state, views)
                every = self.run.report_every
                if every and self.step % every == 0 and not self._done():
                    self._report()
                if self._preview_is_due():
                    self._preview()
                if time.perf_counter() - self.saved_at >= self.run.checkpoint_seconds:
                    self._save()
                self._tell()
            if not self.run.resume or self.step > self.first:
                self._report()
                self._save()
            self._tell()
            if signals.received is not None:
                raise Interrupted(self.step, signals.received)
        return self.state.result()

    def _done(self) -> bool:
        if self.limit is not None:
            return self.seconds >= self.limit
        return self.step >= (self.steps or 0)

    def _report(self) -> None:
        start = time.perf_counter()
        loss = float(np.mean(self.losses)) if self.losses else None
        similar = None
        if self.watched:
            mesh = self.state.result()
            scores = []
            for view in self.watched:
                picture, truth = np.clip(self._picture(mesh, view), 0, 1), np.clip(view.image, 0, 1)
                decibels = min(psnr(picture, truth, mask=view.mask), 200.0)
                scores.append((decibels, masked_ssim(picture, truth, view.mask, self.run.threads)))
            self.held_out, similar = (float(mean) for mean in np.mean(scores, axis=0))
        if self.journal is not None:
            self.journal.note(
                self.step,
                loss=loss,
                psnr=self.held_out,
                ssim=similar,
                triangles=len(self.state.mesh.faces),
                seconds=round(self.seconds, 3),
            )
        self.losses.clear()
        self.report_cost = time.perf_counter() - start

    def _preview_is_due(self) -> bool:
        quarter, every = int(PREVIEWS * self.fraction), self.run.preview_every
        passed, self.quarter = quarter > self.quarter, quarter
        return bool(every) and (passed or self.step % every == 0)

    def _preview(self) -> None:
        if self.journal is None or not self.run.preview_every:
            return
        view = (self.watched or self.dataset.train)[0]
        picture = np.clip(self._picture(self.state.result(), view), 0, 1)
        self.journal.preview(self.step, np.clip(view.image, 0, 1), picture)

    def _picture(self, mesh: SplatMesh, view: View) -> np.ndarray:
        samples, threads = samples_of(view, self.config), self.run.threads
        return image_of(mesh, view.camera, view.background, samples=samples, threads=threads)[0]

    def _save(self) -> None:
        self.saved_at = time.perf_counter()
        if self.journal is None:
            return
        arrays = self.state.arrays()
        config = self.config.to_dict()
        self.journal.save(
            Checkpoint(
                self.step,
                self.seconds,
                config,
                *self.prints,
                arrays,
                tuple(self.losses),
                len(self.dataset.train),
            )
        )
        self.save_cost = time.perf_counter() - self.saved_at

    def _tell(self) -> None:
        if self.on_progress is None:
            return
        left = None
        if self.limit is not None:
            left = max(self.limit - self.seconds, 0.0)
        elif self.steps is not None and self.step > self.first:
            pace = (self.seconds - self.first_seconds) / (self.step - self.first)
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
