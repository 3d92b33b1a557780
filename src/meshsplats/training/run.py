"""train: photographs with cameras to a tuned mesh, without splats to start from."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from meshsplats._common.kinds import need
from meshsplats.cameras.framing import guess_up
from meshsplats.datasets.points import ScenePoints
from meshsplats.datasets.reduced import reduced_views
from meshsplats.datasets.silhouettes import has_silhouettes, with_clear_pixels_masked
from meshsplats.datasets.views import Dataset, ImageCache, View, check_counting
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.finetuning.interruption import Interrupted
from meshsplats.finetuning.journal import Journal, claimed
from meshsplats.finetuning.memory import HARMONIC_BYTES, SHADED_BYTES, check_bytes, estimate_bytes
from meshsplats.finetuning.run import Progress, TrainingLoop, run_start
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.finetuning.step import for_views
from meshsplats.formats.meshes import load_mesh, save_mesh
from meshsplats.images.writing import save_image
from meshsplats.rendering.devices import engine
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.spherical_harmonics import TERMS
from meshsplats.training.config import TrainConfig, with_train_changes
from meshsplats.training.coverage import coverage_picture
from meshsplats.training.exposures import exposures_differ
from meshsplats.training.growing import REDUCED_PART, Growing
from meshsplats.training.growth import SHELL
from meshsplats.training.hull import carving_bytes
from meshsplats.training.initial import colored, fans_of, lost_points, starting_patches
from meshsplats.training.patches import Patches, flat_splats
from meshsplats.training.stereo import matching_bytes
from meshsplats.training.suspects import find_suspects

LATE = 0.5
"""Share of the minutes of a run that may be over before its first step without a word."""
START_SHARE = 0.15
"""Share of the schedule of a run by minutes that its start may take. What it takes beyond that is no part of
the schedule: with a quarter, half of the growth would be left out. All of it as a part is better than none
(saharov, two minutes: 20.9 dB, else 20.5)."""
SHOWN_NAMES = 10
"""Maximum number of such photographs that are named."""
START, SO_FAR, COVERAGE = "start.npz", "interrupted.npz", "coverage.png"
"""Files in the folder of a run: the fans that it started from, those at an interruption, and how many
photographs show each place."""


def train(
    dataset: Dataset,
    config: TrainConfig | None = None,
    *,
    points: ScenePoints | None = None,
    run: RunOptions | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    on_phase: Callable[[str], None] | None = None,
    **changes: Any,
) -> SplatMesh:
    """Makes a mesh from the training views of ``dataset`` alone.

    Fans start on the surfaces that matched photographs, known points and silhouettes show, and on a shell
    around everything where nothing masks the background. Then they are optimised as by ``finetune``, on
    images from a quarter of the size to the full one, while their set grows: fans with errors that several
    views see are halved, those that contribute nothing are dropped.

    Args:
        dataset: the training views, and held-out views to score. Photographs without alpha count as opaque:
            the random background of some steps must be covered. Alpha cuts out a subject if a tenth of the
            image is clear in at least half of the training views.
        config: the configuration; ``train_config()`` by default.
        points: known points of the scene, relative to the origin of ``dataset``:
            ``load_points(path, origin=dataset.origin)``.
        run: output folder, resumption from a checkpoint, logging and resources.
        on_progress: called after every step.
        on_phase: called before the first step, with each thing that begins, in words.
        changes: fields of ``TrainConfig`` in place of those of ``config``.

    Returns:
        Fans of ``config.sides`` triangles, at most ``config.max_splats`` of them, one after the other
        (``face_splat``).

    Raises:
        TypeError: a field that does not exist.
        ValueError: fewer than two training views, none in which a pixel counts, points that are not finite,
            or masks that do not fit the cameras.
        FileExistsError, OtherRunError, MemoryError, DivergenceError, MissingDependencyError, DeviceError,
            Interrupted: as by ``finetune``. Interrupted leaves the mesh so far in the folder, too, as
            ``interrupted.npz``.

    Warns with a DataWarning of points if no photograph shows most of them, if most of the time is over before
    the first step, and of photographs that do not fit the others: before the first step of those that have
    clear pixels though no subject is cut out, which do not count then, and of those that are blurred or
    double; at the end of those that the mesh cannot show.
    """
    need(Dataset, dataset=dataset)
    need(TrainConfig, config=config, optional=True)
    need(ScenePoints, points=points, optional=True)
    need(RunOptions, run=run, optional=True)
    began, say = time.perf_counter(), on_phase or (lambda text: None)
    config, run = with_train_changes(config or TrainConfig(), **changes), run or RunOptions()
    if len(dataset.train) < 2:
        raise ValueError(f"at least 2 training views are needed, the data set has {len(dataset.train)}")
    check_counting(dataset.train)
    dataset = with_clear_pixels_masked(dataset).scorable()
    config = for_views(with_number_of_fans(config, dataset.train), dataset.train)
    engine(run.device, run.threads).check()
    check_training_memory(dataset, config, cache_bytes=run.cache_bytes)
    with claimed(run, (START, SO_FAR, COVERAGE)):
        journal = None if run.folder is None else Journal(run.folder)
        if run.resume and journal is not None:
            mesh = _stored_start(journal)
        else:
            lost = 0.0 if points is None else lost_points(dataset.train, points)
            if lost > 0.5:
                warnings.warn(
                    f"{lost:.0%} of the points lie where no photograph shows them: load_points(...,"
                    " origin=data.origin) has them beside the cameras of a data set",
                    DataWarning,
                    stacklevel=2,
                )
            say("matching photographs")
            mesh = starting_fans(dataset, config, points, run.threads)
            say("looking for blurred photographs")
            for message in find_suspects(dataset.views).messages():
                warnings.warn(message, DataWarning, stacklevel=2)
        if config.exposure is None:
            say("comparing exposures")
            config = replace(config, exposure=exposures_differ(mesh, dataset.train, run.threads))
            if config.exposure:
                warnings.warn(
                    "the photographs differ in exposure or white balance: a gain and an offset of each are"
                    " fitted (``exposure`` False: not)",
                    DataWarning,
                    stacklevel=2,
                )
        picture = None
        if journal is not None and not run.resume:
            say("counting the photographs of each place")
            picture = coverage_picture(mesh, dataset.train, run.threads)
        before, run = run.spent, replace(run, spent=run.spent + time.perf_counter() - began)
        if not run.resume and config.minutes is not None and run.spent > LATE * 60 * config.minutes:
            warnings.warn(
                f"{run.spent / 60:.1f} of {config.minutes:g} minutes were spent before the first step: allow"
                " more ``minutes`` (cameras are found only once)",
                DataWarning,
                stacklevel=2,
            )
        start = run_start(mesh, dataset, config, run, journal)
        if not run.resume:
            own = 0.0 if config.minutes is None else START_SHARE * max(60 * config.minutes - before, 0)
            start = replace(start, setup_seconds=max(before, run.spent - own))
        if journal is not None and picture is not None:
            (journal.folder / SO_FAR).unlink(missing_ok=True)
            save_mesh(mesh, journal.folder / START)
            save_image(journal.folder / COVERAGE, picture)
        clock, views = start.clock(run), start.dataset.train
        phase = Growing(config, mesh, views, clock.fraction, run.cache_bytes)
        loop = TrainingLoop(start, clock, phase, run, on_progress)
        del start
        try:
            mesh = loop.run()
        except Interrupted:
            if journal is not None:
                save_mesh(loop.finished(), journal.folder / SO_FAR)
            raise
        if journal is not None:
            (journal.folder / SO_FAR).unlink(missing_ok=True)
    if names := phase.misfits(views):
        shown = ", ".join(names[:SHOWN_NAMES]) + (" ..." if len(names) > SHOWN_NAMES else "")
        warnings.warn(
            f"{len(names)} of {len(dataset.train)} photographs do not fit the others: {shown}. Their cameras"
            " may be wrong, or the scene or its light has changed. Without them, the mesh may be better",
            DataWarning,
            stacklevel=2,
        )
    return mesh


def with_number_of_fans(config: TrainConfig, views: Sequence[View]) -> TrainConfig:
    """``config`` with a ``max_splats`` that suits training ``views``."""
    if config.max_splats is not None:
        return config
    masked = has_silhouettes(views)
    return config.for_pixels(0 if masked else sum(view.camera.width * view.camera.height for view in views))


def check_training_memory(dataset: Dataset, config: TrainConfig, *, cache_bytes: int) -> int:
    """Estimated peak memory in bytes of a process that trains. MemoryError if there is less."""
    fans = config.most_splats
    vertices = fans * (1 + config.sides)
    needed = estimate_bytes(vertices, fans * config.sides, dataset, cache_bytes)
    if config.sh_degree:
        coefficients = 3 * TERMS[config.sh_degree - 1]
        needed += vertices * SHADED_BYTES + fans * coefficients * HARMONIC_BYTES
    views, store = dataset.train, ImageCache(0)
    reduced = [*reduced_views(views, 0.25, store), *reduced_views(views, 0.5, store)]
    needed += min(sum(view.source.nbytes for view in reduced), cache_bytes // REDUCED_PART)
    needed += max(matching_bytes(views), carving_bytes(views, config.first_splats(masked=True)))
    what = f"training {fans:,} fans on {len(dataset.views):,} images"
    check_bytes(needed, what, "allow fewer fans (``max_splats``)")
    return needed


def starting_fans(
    dataset: Dataset, config: TrainConfig, points: ScenePoints | None = None, threads: int | None = None
) -> SplatMesh:
    """The fans that a training starts from, coloured from the training views; see ``train``."""
    views = dataset.train
    config = with_number_of_fans(config, views)
    count = config.first_splats(has_silhouettes(views))
    patches, shell = starting_patches(views, count, points, threads)
    parts = [part for part in (patches, shell) if part is not None]
    if not parts:
        raise ValueError("the photographs have nothing in common that a mesh could start from")
    joined = Patches.joined(*parts)
    found = len(joined.points)
    chosen = np.linspace(0, found - 1, min(found, config.most_splats)).astype(int)
    mesh = fans_of(flat_splats(joined.select(chosen)), config.sides)
    up = guess_up(cameras=[view.upright for view in views])
    harmonics = None
    if config.sh_degree:
        harmonics = np.zeros((len(chosen), TERMS[config.sh_degree - 1], 3), np.float32)
    mesh = replace(mesh, up=up, origin=dataset.origin, harmonics=harmonics)
    if shell is None:
        return colored(mesh, views, threads)
    in_shell = np.repeat(chosen >= found - len(shell.points), 1 + config.sides)
    mesh = colored(mesh, views, threads, int(np.count_nonzero(~in_shell)))
    return replace(mesh, attributes={SHELL: in_shell.astype(np.float32)})


def _stored_start(journal: Journal) -> SplatMesh:
    path = journal.folder / START
    if not path.is_file():
        raise FileNotFoundError(f"no {path}: leave out ``resume`` to begin anew")
    mesh = load_mesh(path)
    if mesh.face_splat is None or not len(mesh.faces):
        raise FileFormatError(f"{path}: not the fans that a training started from")
    return mesh
