"""train: photographs with cameras to a tuned mesh, without splats to start from."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from meshsplats._kinds import need
from meshsplats.cameras.framing import guess_up
from meshsplats.datasets.points import ScenePoints
from meshsplats.datasets.reduced import opaque_views, reduced_views
from meshsplats.datasets.views import Dataset, ImageCache, View
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.finetuning.config import learning_rates
from meshsplats.finetuning.interruption import Interrupted
from meshsplats.finetuning.journal import Journal
from meshsplats.finetuning.memory import check_bytes, estimate_bytes
from meshsplats.finetuning.run import Progress, RunOptions, RunStart, TrainingLoop, run_start
from meshsplats.finetuning.step import view_of_step
from meshsplats.formats.meshes import load_mesh, save_mesh
from meshsplats.mesh import SplatMesh
from meshsplats.training.config import TrainConfig, with_train_changes
from meshsplats.training.growth import (
    SHELL,
    NearFields,
    corners_of,
    fan_count,
    grow,
    score,
    select_fans,
)
from meshsplats.training.hull import carving_bytes
from meshsplats.training.initial import colored, fans_of, flat_splats, starting_patches
from meshsplats.training.patches import Patches
from meshsplats.training.schedule import budget, events_passed, image_factor
from meshsplats.training.stereo import MATCHING_BYTES
from meshsplats.webgpu.device import open_device

MISFIT = 3.0
"""A photograph whose mean loss is this many times the median of all does not fit the others."""
SHOWN_NAMES = 10
"""Maximum number of such photographs that are named."""
START, SO_FAR = "start.npz", "mesh.npz"
"""Files in the folder of a run: the fans that it started from, and those at an interruption."""
REDUCED_PART = 3
"""Reduced images are kept up to the limit of the image cache divided by this."""


def train(
    dataset: Dataset,
    config: TrainConfig | None = None,
    *,
    points: ScenePoints | None = None,
    run: RunOptions | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    **changes: Any,
) -> SplatMesh:
    """Makes a mesh from the training views of ``dataset`` alone.

    Fans start on the surfaces that matched photographs, known points and silhouettes show, and on a shell
    around everything where nothing masks the background. Then they are optimised as by ``finetune``, on
    images from a quarter of the size to the full one, while their set grows: fans with errors that several
    views see are halved, those that contribute nothing are dropped.

    Args:
        dataset: the training views, and held-out views to score. Photographs without alpha count as opaque:
            the random background of some steps must be covered.
        config: the configuration; ``train_config()`` by default.
        points: known points of the scene, from ``load_points``.
        run: output folder, resumption from a checkpoint, logging and resources.
        on_progress: called after every step.
        changes: fields of ``TrainConfig`` in place of those of ``config``.

    Returns:
        Fans of ``config.sides`` triangles, at most ``config.max_splats`` of them, one after the other
        (``face_splat``).

    Raises:
        TypeError: a field that does not exist.
        ValueError: fewer than two training views, or masks that do not fit the cameras.
        OtherRunError, MemoryError, DivergenceError, MissingDependencyError, DeviceError, Interrupted: as by
            ``finetune``. Interrupted leaves the mesh so far in the folder, too.

    Warns with a DataWarning of photographs that do not fit the others.
    """
    need(Dataset, dataset=dataset)
    need(TrainConfig, config=config, optional=True)
    need(ScenePoints, points=points, optional=True)
    need(RunOptions, run=run, optional=True)
    began = time.perf_counter()
    config, run = with_train_changes(config or TrainConfig(), **changes), run or RunOptions()
    if len(dataset.train) < 2:
        raise ValueError(f"at least 2 training views are needed, the data set has {len(dataset.train)}")
    if run.device == "gpu":
        open_device()
    check_training_memory(dataset, config, cache_bytes=run.cache_bytes)
    journal = None if run.folder is None else Journal(run.folder)
    if run.resume and journal is not None:
        mesh = _stored_start(journal)
    else:
        mesh = starting_fans(dataset, config, points, run.threads)
    run = replace(run, spent=run.spent + time.perf_counter() - began)
    start = run_start(mesh, dataset, config, run, journal)
    if journal is not None and not run.resume:
        (journal.folder / SO_FAR).unlink(missing_ok=True)
        save_mesh(mesh, journal.folder / START)
    loop = GrowingLoop(start, dataset, config, run, journal, on_progress)
    try:
        mesh = loop.run()
    except Interrupted:
        if journal is not None:
            save_mesh(loop.result(), journal.folder / SO_FAR)
        raise
    if journal is not None:
        (journal.folder / SO_FAR).unlink(missing_ok=True)
    if names := loop.misfits():
        shown = ", ".join(names[:SHOWN_NAMES]) + (" ..." if len(names) > SHOWN_NAMES else "")
        warnings.warn(
            f"{len(names)} of {len(dataset.train)} photographs do not fit the others: {shown}. Their cameras"
            " may be wrong, or the scene or its light has changed. Without them, the mesh may be better",
            DataWarning,
            stacklevel=2,
        )
    return mesh


def check_training_memory(dataset: Dataset, config: TrainConfig, *, cache_bytes: int) -> int:
    """Estimated peak memory in bytes of a process that trains. MemoryError if there is less."""
    fans = max(config.max_splats, config.start_splats)
    needed = estimate_bytes(fans * (1 + config.sides), fans * config.sides, dataset, cache_bytes)
    views, store = dataset.train, ImageCache(0)
    reduced = [*reduced_views(views, 0.25, store), *reduced_views(views, 0.5, store)]
    needed += min(sum(view.source.nbytes for view in reduced), cache_bytes // REDUCED_PART)
    needed += max(MATCHING_BYTES, carving_bytes(views, min(config.start_splats, config.max_splats)))
    what = f"training {config.max_splats:,} fans on {len(dataset.views):,} images"
    check_bytes(needed, what, "allow fewer fans (--max-splats)")
    return needed


def starting_fans(
    dataset: Dataset, config: TrainConfig, points: ScenePoints | None = None, threads: int | None = None
) -> SplatMesh:
    """The fans that a training starts from, coloured from the training views; see ``train``."""
    views = dataset.train
    count = min(config.start_splats, config.max_splats)
    patches, shell = starting_patches(views, count, points)
    parts = [part for part in (patches, shell) if part is not None]
    if not parts:
        raise ValueError("the photographs have nothing in common that a mesh could start from")
    joined = Patches.joined(*parts)
    count = len(joined.points)
    chosen = np.linspace(0, count - 1, min(count, config.max_splats)).astype(int)
    mesh = fans_of(flat_splats(joined.select(chosen)), config.sides)
    up = guess_up(cameras=[view.camera for view in views])
    mesh = replace(mesh, up=up, origin=dataset.origin)
    if shell is None:
        return colored(mesh, views, threads)
    in_shell = np.repeat(chosen >= count - len(shell.points), 1 + config.sides)
    mesh = colored(mesh, views, threads, int(np.count_nonzero(~in_shell)))
    return replace(mesh, attributes={SHELL: in_shell.astype(np.float32)})


def _stored_start(journal: Journal) -> SplatMesh:
    path = journal.folder / START
    if not path.is_file():
        raise FileNotFoundError(f"no {path}: leave out --resume to begin anew")
    mesh = load_mesh(path)
    if mesh.face_splat is None or not len(mesh.faces):
        raise FileFormatError(f"{path}: not the fans that a training started from")
    return mesh


class GrowingLoop(TrainingLoop):
    """The loop of fine-tuning, on images that become larger, with a set of fans that grows."""

    config: TrainConfig

    def __init__(
        self,
        start: RunStart,
        dataset: Dataset,
        config: TrainConfig,
        options: RunOptions,
        journal: Journal | None,
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        super().__init__(start, dataset, config, options, journal, on_progress)
        self._store = ImageCache(options.cache_bytes // REDUCED_PART)
        self._reduced: dict[float, Sequence[View]] = {}
        self.first_fans = fan_count(start.mesh)
        self.near = NearFields.around(self.dataset.train, start.mesh)
        self.events = events_passed(config, self.fraction)
        self._loss_sums, self._loss_counts = np.zeros((2, len(dataset.train)))

    def misfits(self) -> list[str]:
        """Names of the training views whose images the mesh cannot show as it shows the others, judged by
        the losses since the last growth event. Those of a resumed run since then do not count."""
        known = np.flatnonzero(self._loss_counts)
        if not len(known):
            return []
        means = self._loss_sums[known] / self._loss_counts[known]
        return [self.dataset.train[i].name for i in known[means > MISFIT * np.median(means)]]

    def _note(self, step: int, loss: float) -> None:
        super()._note(step, loss)
        if self.fraction >= max(self.config.growth_end, self.config.half_share):
            view = view_of_step(self.config, step, len(self.dataset.train))
            self._loss_sums[view] += loss
            self._loss_counts[view] += 1

    def result(self) -> SplatMesh:
        """The current fans, but those in the near field of a camera."""
        mesh = replace(super().result(), attributes={})
        assert mesh.face_splat is not None
        stray = self.near.contain(mesh)
        return mesh.take(~stray[mesh.face_splat]) if stray.any() and not stray.all() else mesh

    def _views(self) -> Sequence[View]:
        factor = image_factor(self.config, self.fraction)
        if factor not in self._reduced:
            # With alpha, some steps have a random background: what is opaque must be covered.
            views = opaque_views(self.dataset.train)
            self._reduced[factor] = reduced_views(views, factor, self._store)
        return self._reduced[factor]

    def _adapt(self) -> None:
        if self.config.shape_decay:
            # In proportion to the learning rate, as the steps that it is weighed against.
            color_rate, _ = learning_rates(self.config, self.step - 1, self.fraction)
            share = self.config.shape_decay * color_rate / self.config.color_rate
            self.state.round_fans(corners_of(self.state.mesh), min(share, 1.0))
        # In a run by minutes, a slow step or report may put the fraction back.
        before, self.events = self.events, max(self.events, events_passed(self.config, self.fraction))
        if self.events <= before or self._done():
            return
        state = self.state
        stray = self.near.contain(state.result())
        if stray.any() and not stray.all():
            state = select_fans(state, np.flatnonzero(~stray))
        target = budget(self.config, self.events, self.first_fans)
        self.state = grow(state, score(state, self._views(), self.events), target)
