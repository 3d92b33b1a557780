"""finetune_cells: a scene of any size, fine-tuned in cells, so that memory is that of a cell.

The splats are divided into boxes of equal count. Besides its own splats, a cell draws those of its neighbours
within a margin, and all others merged to a few, so that its images are complete. It is trained on the windows
of the views that show it. The result takes each splat from the cell that owns it.

Seams come from two cells that correct the same error. So no two neighbours are tuned at the same time. A
finished neighbour's margin is drawn, frozen. A later neighbour's margin is tuned with the cell and then
discarded. What stands for the rest of the scene is frozen.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.json_files import json_object
from meshsplats._files.atomic import write_text
from meshsplats.cluster import Shared, Workers
from meshsplats.conversion import ConversionOptions
from meshsplats.conversion.merging import simplify
from meshsplats.datasets.views import Dataset, ImageCache, View
from meshsplats.datasets.windows import window_of
from meshsplats.errors import OtherRunError
from meshsplats.finetuning.checkpoint import cloud_digest, dataset_fingerprint
from meshsplats.finetuning.config import FinetuneConfig, with_changes
from meshsplats.finetuning.dividing import Cells, divide, waves
from meshsplats.finetuning.initial import starting_mesh
from meshsplats.finetuning.journal import CHECKPOINT, RECORD, Journal, claimed
from meshsplats.finetuning.run import Progress, finetune
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.formats.meshes import load_mesh, save_mesh
from meshsplats.rendering.devices import engine
from meshsplats.rendering.engine import visible_pixels
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

FAR_SHARE = 0.25
"""Splats that stand for the scene beyond the margin, as a share of those of a cell."""
SHOWN = 0.01
"""A view belongs to a cell if the cell's own splats fill at least this share of its image."""
SIDE = 160
"""Longest side in pixels of the images that this is found in."""
BORDER = 16
"""Pixels around the window of a cell in a view."""
CELLS = "cells"
"""Folder of the cells, in that of the run."""
RECORD_BYTES = 1 << 20
"""Largest size of a ``RECORD``."""
_CELL_FILE = re.compile(r"cell-\d{5,}(\.npz)?|coarse-\d{5,}\.ply")
"""Names in the folder of the cells: tuned meshes, folders of runs, splats that stand for a cell."""


@dataclass(frozen=True)
class CellOptions:
    """How a scene is divided."""

    splats: int
    """Largest number of splats of a cell, without its margin."""
    conversion: ConversionOptions | None = None
    """How splats are converted, as in ``starting_mesh``; without limits on their number."""
    preset: str = "default"
    """Preset of the conversion."""

    def __post_init__(self) -> None:
        if isinstance(self.splats, bool) or self.splats < 1:
            raise ValueError(f"a cell must have at least 1 splat, got {self.splats!r}")
        chosen = self.conversion or ConversionOptions()
        if chosen.max_splats is not None or chosen.max_triangles is not None:
            raise ValueError("limits on splats or triangles are for a whole scene, not for cells")


@dataclass(frozen=True, eq=False)
class CellScene:
    """Splats and views, which every process of a run needs."""

    cloud: GaussianCloud
    dataset: Dataset
    _divided: dict[int, Cells] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        # By the whole scene, not by the splats of a cell.
        object.__setattr__(self, "dataset", self.dataset.with_near_planes(self.cloud.means))

    def cells(self, most: int) -> Cells:
        """The splats in cells of at most ``most``; divided once."""
        if most not in self._divided:
            self._divided[most] = divide(self.cloud.means, most)
        return self._divided[most]


class TunedCells:
    """The tuned cells of a scene, in files.

    Args:
        files: of the meshes of the cells; their ``face_splat`` are rows of the whole scene.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self.files = tuple(files)

    def blocks(self) -> Iterator[SplatMesh]:
        """The mesh of each cell."""
        for file in self.files:
            yield load_mesh(file)

    def mesh(self) -> SplatMesh:
        """The whole mesh; triangles are in the order of their splats, vertices in that of the cells."""
        parts = [part for part in self.blocks() if len(part.faces)] or list(self.blocks())[:1]
        return SplatMesh.joined(parts, same_splats=True)


def finetune_cells(
    scene: Shared[CellScene],
    config: FinetuneConfig,
    options: CellOptions,
    run: RunOptions,
    *,
    workers: Workers | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> TunedCells:
    """Fine-tunes splats in cells, each in a task; memory is that of a cell besides the splats themselves.

    The folder of the run keeps a folder ``cells`` with a checkpoint of each cell that has begun and the mesh
    of each that is done, from which ``run.resume`` continues. The result has the same bits with any number of
    workers and after any number of interruptions.

    Args:
        scene: splats and views. On a cluster, each worker makes them.
        config: as of ``finetune``, for the whole scene: a cell takes the share of the steps that its share of
            the views is. Not the length in minutes, exposures or opacity 'cutoff'.
        options: how the scene is divided.
        run: the folder, which must be given and exist, resumption, checkpoints, threads. There are no
            previews, and no scores on the way.
        workers: tune the cells; this process by default, with ``run.threads``. All of them have the folder at
            the same path.
        on_progress: called after every cell.

    Returns:
        The meshes of the cells.

    Raises:
        ValueError: options that are for whole scenes, no training views, no splats.
        OtherRunError: the folder is of another run.
        FileFormatError: the record of the run that is resumed is broken.
        FileExistsError: as ``finetune``.
        MemoryError, DivergenceError, Interrupted: as ``finetune``.
        ClusterError: the workers are lost; finished work is kept.
    """
    if run.folder is None:
        raise ValueError("cells need a folder for the run")
    check_for_cells(config)
    workers = workers or Workers(run.threads)
    here = scene.get()
    train = len(here.dataset.train)
    if not train:
        raise ValueError("the data set has no training views")
    if not len(here.cloud):
        raise ValueError("there is no splat to fine-tune")
    cells = here.cells(options.splats)
    count = len(cells.low)
    with claimed(run, (RECORD, CELLS)):
        folder = run.folder / CELLS
        _begin(run, folder, config, options, here, count)
        start = time.perf_counter()
        task = _Tuning(scene, config, options, replace(run, folder=folder, threads=workers.threads))
        coarse = [cell for cell in range(count) if count > 1 and not task.coarse_file(cell).is_file()]
        for _ in workers.run(task.coarsen, coarse):
            pass
        before: tuple[int, ...] = ()
        done = {cell for cell in range(count) if task.file(cell).is_file()}
        journal = Journal(run.folder)
        fresh, steps = 0, max((line["step"] for line in journal.metrics()), default=0)
        for wave in waves(cells, here.cloud.means):
            todo = [(cell, before) for cell in wave if cell not in done]
            for i, taken in workers.run(task.tune, todo):
                done.add(todo[i][0])
                fresh += 1
                steps += taken
                journal.log_metrics(steps, cell=todo[i][0], cells=count, done=len(done))
                if on_progress is not None:
                    seconds = time.perf_counter() - start
                    left = seconds / fresh * (count - len(done))
                    share = len(done) / count
                    on_progress(Progress(steps, None, share, None, None, seconds, left, 0))
            before += tuple(wave)
        return TunedCells([task.file(cell) for cell in range(count)])


def check_for_cells(config: FinetuneConfig) -> None:
    """ValueError for options that need the whole scene at once."""
    for name, possible in (
        ("minutes", (None,)),
        ("exposure", (False,)),
        ("opacity", ("blended",)),
        ("blending", ("mesh", "display")),
        ("order", ("mesh", "fragment", "splat")),
    ):
        if getattr(config, name) not in possible:
            raise ValueError(f"{name} is for a whole scene, not for cells")


def _begin(
    run: RunOptions,
    folder: Path,
    config: FinetuneConfig,
    options: CellOptions,
    scene: CellScene,
    count: int,
) -> None:
    """Notes what the run is about, or refuses to resume another one."""
    assert run.folder is not None
    chosen = ConversionOptions(**asdict(options.conversion or ConversionOptions()))  # not a subclass
    facts: dict[str, Any] = {
        "configuration": config.to_dict(),
        "cell_splats": options.splats,
        "conversion": hashlib.sha256(repr((chosen, options.preset)).encode()).hexdigest(),
        "splats": cloud_digest(scene.cloud),
        "views": dataset_fingerprint(scene.dataset),
        "cells": count,
    }
    path = run.folder / RECORD
    if run.resume:
        with open(path, "rb") as file:
            before = json_object(file.read(RECORD_BYTES + 1), RECORD_BYTES, path)
        for name, value in facts.items():
            if before.get(name) != value:
                raise OtherRunError(f"the cells in {folder} are of another run: other {name}")
        return
    path.unlink(missing_ok=True)
    Journal(run.folder).begin(config.to_dict())
    folder.mkdir(exist_ok=True)
    _remove_cells(folder)
    write_text(path, json.dumps(facts, indent=1) + "\n")


def _remove_cells(folder: Path) -> None:
    """Removes what an earlier run has left in the ``folder`` of its cells, and nothing else."""
    for path in list(folder.iterdir()):
        if not _CELL_FILE.fullmatch(path.name):
            continue
        if path.is_dir():
            Journal(path).remove()
        else:
            path.unlink()


@dataclass(frozen=True, eq=False)
class _Tuning:
    """The tasks of a run."""

    scene: Shared[CellScene]
    config: FinetuneConfig
    options: CellOptions
    run: RunOptions
    """Its folder is that of the cells."""

    def file(self, cell: int) -> Path:
        """Of the tuned mesh of ``cell``."""
        assert self.run.folder is not None
        return self.run.folder / f"cell-{cell:05d}.npz"

    def coarse_file(self, cell: int) -> Path:
        """Of the few splats that stand for ``cell`` from afar."""
        assert self.run.folder is not None
        return self.run.folder / f"coarse-{cell:05d}.ply"

    def coarsen(self, cell: int) -> None:
        """Writes the splats that stand for ``cell``."""
        scene = self.scene.get()
        own = scene.cells(self.options.splats).own(cell)
        save_gaussians(self._few(scene.cloud.take(own), len(scene.cloud)), self.coarse_file(cell))

    def _few(self, part: GaussianCloud, every: int) -> GaussianCloud:
        """``part`` of ``every`` splats, merged."""
        share = min(1.0, FAR_SHARE * self.options.splats / every)
        count = max(1, round(share * len(part)))
        return simplify(part, count, low_pass=0.0, threads=self.run.threads)

    def tune(self, task: tuple[int, tuple[int, ...]]) -> int:
        """Writes the tuned mesh of a cell after those ``before``; the count of its steps."""
        cell, before = task
        scene = self.scene.get()
        cells = scene.cells(self.options.splats)
        own, margin = cells.own(cell), cells.margin(cell, scene.cloud.means)
        done = np.isin(cells.owner[margin], before)
        views = _views_that_see(scene.cloud.means[own], scene.dataset.train)
        mesh = self._mesh(cells, cell, own, margin[~done], margin[done], [view.camera for view in views])
        shown = _views_that_show(mesh, _vertices_of(mesh, len(own)), views, self.run)
        tuned, steps = mesh, 0
        if shown:
            dataset = replace(scene.dataset, train=shown, test=())
            steps = self._steps(len(shown), len(scene.dataset.train))
            config = with_changes(self.config, steps=steps)
            frozen = ~_vertices_of(mesh, len(own) + int((~done).sum()))
            tuned = self._tuned(cell, mesh, dataset, config, frozen)
        tuned = tuned.take(_owners(tuned) < len(own))
        save_mesh(replace(tuned, normals=None, face_splat=own[_owners(tuned)]), self.file(cell))
        (self._folder(cell) / CHECKPOINT).unlink(missing_ok=True)
        return steps

    def _folder(self, cell: int) -> Path:
        return self.file(cell).with_suffix("")

    def _steps(self, shown: int, every: int) -> int:
        """Of a cell that ``shown`` of ``every`` views show."""
        return max(1, round((self.config.total_steps(every) or 0) * shown / every))

    def _tuned(
        self, cell: int, mesh: SplatMesh, dataset: Dataset, config: FinetuneConfig, frozen: np.ndarray
    ) -> SplatMesh:
        folder = self._folder(cell)
        resume = (folder / CHECKPOINT).is_file()
        run = replace(self.run, folder=folder, resume=resume, report_every=0, preview_every=0)
        return finetune(mesh, dataset, config, run=run, frozen=frozen)

    def _mesh(
        self,
        cells: Cells,
        cell: int,
        own: np.ndarray,
        along: np.ndarray,
        done: np.ndarray,
        cameras: Sequence[Camera],
    ) -> SplatMesh:
        """The mesh of ``cell``: its own splats, numbered from 0, the rows of its margin that are tuned
        ``along``, those that are ``done``, and all others."""
        scene = self.scene.get()
        cloud, look = scene.cloud, scene.dataset.look
        chosen = replace(self.options.conversion or ConversionOptions(), crop=None)
        make = partial(starting_mesh, preset=self.options.preset, look=look)
        parts = [make(cloud.take(np.concatenate([own, along])), cameras, chosen)]
        margin = np.concatenate([along, done])
        few: list[GaussianCloud] = []
        for other in range(len(cells.low)):
            theirs = margin[cells.owner[margin] == other]
            if other == cell:
                continue
            if not len(theirs):
                few.append(load_gaussians(self.coarse_file(other), origin=cloud.origin))
                continue
            rest = np.setdiff1d(cells.own(other), theirs, assume_unique=True)
            if len(rest):
                few.append(self._few(cloud.take(rest), len(cloud)))
            if np.isin(theirs, done).any():
                tuned = load_mesh(self.file(other))
                parts.append(tuned.take(np.isin(_owners(tuned), theirs)))
        if few:
            even = replace(chosen, detail="even", min_opacity=None)
            beyond = GaussianCloud.joined([replace(one, kernel=cloud.kernel) for one in few])
            parts.append(make(beyond, cameras, even))
        # All parts but the first are numbered behind it: which of their splats is which does not matter.
        first = len(own) + len(along)
        for i, part in enumerate(parts[1:], 1):
            parts[i] = replace(part, face_splat=first + part.splats.of_face)
            first += len(part.splats)
        return SplatMesh.joined(parts, same_splats=True)


def _vertices_of(mesh: SplatMesh, splats: int) -> np.ndarray:
    """(v,) bool: the vertices of the first ``splats``."""
    return mesh.vertices_of(_owners(mesh) < splats)


def _views_that_see(points: np.ndarray, views: Sequence[View]) -> list[View]:
    """The ``views`` with any of ``points`` (n, 3) in the image; all of them if there is none."""
    return [view for view in views if view.camera.sees(points).any()] or list(views)


def _views_that_show(
    mesh: SplatMesh, own: np.ndarray, views: Sequence[View], run: RunOptions
) -> tuple[View, ...]:
    """The windows of ``views`` that show the vertices marked in ``own`` (v,) bool."""
    found = []
    store, drawing = ImageCache(run.cache_bytes), engine(run.device, run.threads)
    for view in views:
        camera = view.camera.within(SIDE)
        pixels = visible_pixels(drawing, mesh.triangles, camera)
        shown = own & (pixels > 0)
        if pixels[shown].sum() < SHOWN * camera.width * camera.height:
            continue
        at = view.camera.project(mesh.vertices[shown])[0]
        at = at[np.isfinite(at).all(axis=1)]
        if not len(at):
            continue
        size = np.array([view.camera.width, view.camera.height])
        left, top = np.clip(np.floor(at.min(axis=0)) - BORDER, 0, size - 1).astype(int).tolist()
        right, bottom = np.clip(np.ceil(at.max(axis=0)) + BORDER, 1, size).astype(int).tolist()
        if right > left and bottom > top:
            found.append(window_of(view, left, top, right, bottom, store))
    return tuple(found)


def _owners(mesh: SplatMesh) -> np.ndarray:
    assert mesh.face_splat is not None  # converted from splats
    return mesh.face_splat
