"""Meshes and splats from files scored on held-out views, of photographs or of splats, and of benchmarks."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.kinds import as_path
from meshsplats._common.words import optional_color
from meshsplats.cameras.files import load_cameras
from meshsplats.cluster import Workers
from meshsplats.conversion.gaps import without_gaps
from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.splat_targets import splat_views
from meshsplats.datasets.views import WHITE, Dataset
from meshsplats.errors import FileFormatError, OptionsError
from meshsplats.evaluation.backgrounds import Background, choose_background
from meshsplats.evaluation.benchmarks import (
    BENCHMARKS,
    Benchmark,
    Candidates,
    convert_scene,
    find_input,
    run_benchmark,
)
from meshsplats.evaluation.lpips import load_lpips
from meshsplats.evaluation.report import Report, ScoredView, evaluate
from meshsplats.evaluation.results import (
    PER_VIEW,
    REPORT,
    RESULTS,
    TABLE,
    Strips,
    save_benchmark,
    save_report,
)
from meshsplats.evaluation.strips import image_folder, mesh_names
from meshsplats.evaluation.trained_views import find_trained_on, find_trained_width, warn_of_trained_on
from meshsplats.finetuning.candidates import tuned_candidates
from meshsplats.finetuning.targets import Targets
from meshsplats.formats.outputs import CONFIGURATION, check_outputs, view_names
from meshsplats.operations.options import ScoringOptions
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.origin import shared_origin

Progress = Callable[[Iterable[Any], int], Iterable[Any]]


@dataclass(frozen=True)
class Scoring:
    """Scores as the files of ``folder``.

    ``threads``: maximum number of threads. ``progress``: shows the progress of views, of which there are so
    many, and passes them on.
    """

    options: ScoringOptions
    folder: Path
    threads: int | None = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", as_path("folder", self.folder))

    def run(self, paths: Sequence[str | os.PathLike[str]], *, force: bool = False) -> Report:
        """Scores the meshes at ``paths`` and writes the files of them. ``force``: in place of older ones.

        Raises what ``ScoringOptions.check`` and ``check_outputs`` raise, and FileFormatError for splats in
        place of a mesh.
        """
        chosen, files = self.options, [as_path(f"paths[{i}]", path) for i, path in enumerate(paths)]
        chosen.check(files)
        self.check_outputs(force)
        meshes = {name: self._load_mesh(path) for name, path in mesh_names(files).items()}
        before = None if chosen.before is None else self._load_mesh(chosen.before)
        splats = None
        if chosen.splats is not None:
            splats = chosen.reading.load(chosen.splats, threads=self.threads)
            if chosen.data is None and chosen.look is None:
                splats = without_gaps(splats, self.threads)
        known = [each for each in (splats, *meshes.values(), before) if each is not None]
        origin = shared_origin(each.origin for each in known)
        splats = None if splats is None else splats.relative_to(origin)
        before = None if before is None else before.relative_to(origin)
        meshes = {name: mesh.relative_to(origin) for name, mesh in meshes.items()}
        dataset = self._dataset(splats, origin if known else None)
        about: dict[str, Any] = {}
        if chosen.data is not None:
            made = [*files, *([] if chosen.before is None else [chosen.before])]
            about = self._training(made, chosen.splats, dataset, chosen.data, 1, chosen.test_every)
        scenes = {"splats": splats, **meshes, "mesh before": before}
        background = choose_background(
            optional_color(chosen.background),
            None if chosen.data is None else dataset,
            {name: scene for name, scene in scenes.items() if scene is not None},
            chosen.splats or (files[0] if files else None),
            self.threads,
        )
        if chosen.data is None and splats is not None:
            # Their images are the ground truth; a mesh can reach degree 0 of it.
            more = splats.sh_degree > 0 and chosen.sh_degree != 0
            splats = replace(splats, sh=splats.sh[:, :1]) if more else None
        return self._score(dataset, background, meshes, splats, before, about)

    def run_benchmark(
        self,
        models: Path,
        workers: Callable[[int | None], AbstractContextManager[Workers]],
        *,
        force: bool = False,
    ) -> list[Report]:
        """Scores the scenes of the protocol in the folder ``models``, by ``workers`` of so many threads, and
        writes the files of each and those of all. ``force``: in place of older ones. Raises as ``run``."""
        chosen = self.options
        chosen.check([models])
        if chosen.protocol is None or chosen.data is None:
            raise OptionsError("give ``protocol``, and ``data`` with its scenes")
        self.check_outputs(force)
        benchmark = BENCHMARKS[chosen.protocol]
        with workers(self.threads) as found:
            task, prepare = replace(self, threads=found.threads), convert_scene
            if chosen.tune is not None:
                prepare = partial(tuned_candidates, preset=chosen.tune, threads=found.threads)
            result = run_benchmark(
                benchmark,
                models,
                chosen.data,
                chosen.reading.load_scene,
                prepare=prepare,
                score=partial(task.score_scene, benchmark, models, chosen.data),
                background=optional_color(chosen.background),
                downscale=chosen.downscale,
                workers=found,
            )
        save_benchmark(result, self.folder, chosen.protocol)
        return list(result.reports)

    def check_outputs(self, force: bool) -> None:
        """OSError if something would be overwritten or cannot be written."""
        names = (RESULTS, PER_VIEW, REPORT, TABLE, CONFIGURATION)
        check_outputs([self.folder / name for name in names], force, self.folder)

    def score_scene(
        self,
        benchmark: Benchmark,
        models: Path,
        data: Path,
        scene: str,
        dataset: Dataset,
        background: Background,
        candidates: Candidates,
    ) -> Report:
        """Scores the ``candidates`` of a ``scene`` of a ``benchmark``, made from what is in the folder
        ``models``, against its ``dataset`` of the folder ``data``, with a folder of its own."""
        mesh, splats, before = candidates
        source = find_input(models, scene)
        meshes = [source] if source is not None and splats is None else []
        usual = benchmark.scenes[scene], benchmark.test_every
        own_splats = None if splats is None else source
        about = self._training(meshes, own_splats, dataset, data / scene, *usual)
        self.folder.mkdir(exist_ok=True)
        own = replace(self, folder=self.folder / scene)
        return own._score(dataset, background, {"mesh": mesh}, splats, before, about)

    def _training(
        self,
        meshes: Sequence[Path],
        splats: Path | None,
        dataset: Dataset,
        data: Path,
        downscale: int,
        test_every: int,
    ) -> dict[str, Any]:
        """For the record, what ``meshes`` and ``splats`` were trained on, if that is not what ``dataset``
        should be for them: the photographs in ``data``, made smaller by ``downscale`` unless the options say
        otherwise, with the split ``test_every``."""
        if self.options.downscale is not None:
            downscale = self.options.downscale

        @cache
        def load(test_every: int) -> Dataset:
            missing = self.options.missing
            return load_dataset(data, downscale=downscale, test_every=test_every, missing=missing)

        about: dict[str, Any] = {}
        paths = [*meshes, *([] if splats is None else [splats])]
        found = {str(path): find_trained_on(path, dataset, test_every, load) for path in paths}
        if trained_on := {path: views for path, views in found.items() if views is not None}:
            warn_of_trained_on(trained_on)
            about["held_out"] = False if any(views.sure for views in trained_on.values()) else None
            about["trained_on"] = {path: views.in_words() for path, views in trained_on.items()}
        if splats is not None and (width := find_trained_width(splats, dataset, downscale)) is not None:
            about["splats_trained_width"] = width
        return about

    def _load_mesh(self, path: Path) -> SplatMesh:
        found, order = self.options.reading.load_scene(path), self.options.order
        if not isinstance(found, SplatMesh):
            raise FileFormatError(
                f"{path}: splats, not a mesh; give them with ``splats``, or convert them first"
            )
        return found if order is None else replace(found, order=order)

    def _dataset(self, splats: GaussianCloud | None, origin: np.ndarray | None) -> Dataset:
        chosen = self.options
        if chosen.data is not None:
            return load_dataset(
                chosen.data,
                downscale=1 if chosen.downscale is None else chosen.downscale,
                test_every=chosen.test_every,
                missing=chosen.missing,
                masks=chosen.masks,
                origin=origin,
            )
        background, look = optional_color(chosen.background) or WHITE, chosen.look or "area"
        assert splats is not None
        assert chosen.splats is not None
        if chosen.cameras is not None:
            views = splat_views(
                splats,
                load_cameras(chosen.cameras, origin=splats.origin),
                look=look,
                sh_degree=chosen.sh_degree,
                background=background,
                threads=self.threads,
            )
            return Dataset((), views, "splats", look, splats.origin)
        targets = Targets(look=look, sh_degree=chosen.sh_degree)
        return replace(targets.make(splats, chosen.splats, background, self.threads), train=())

    def _score(
        self,
        dataset: Dataset,
        background: Background,
        meshes: Mapping[str, SplatMesh],
        splats: GaussianCloud | None,
        before: SplatMesh | None,
        training: Mapping[str, Any],
    ) -> Report:
        """Evaluates one scene over ``background`` and writes its files. ``training``: what ``_training``
        says."""
        chosen, dataset = self.options, dataset.over(background.color)
        views = dataset.test or dataset.views
        images = None if chosen.images is None else image_folder(chosen.images, [v.camera for v in views])
        weights, convention = list(chosen.lpips) or None, chosen.lpips_convention
        lpips = load_lpips(weights, network=chosen.network, convention=convention)
        self.folder.mkdir(exist_ok=True)
        shown = iter(self.progress(range(len(views)), len(views)) if self.progress else range(len(views)))
        next(shown, None)
        save_strips = Strips(self.folder, view_names(len(views)), chosen.strips, chosen.amplify)

        def keep(scored: ScoredView) -> None:
            save_strips(scored)
            next(shown, None)

        report = evaluate(
            meshes,
            dataset,
            before=before,
            splats=splats,
            images=images,
            samples=chosen.samples,
            lpips=lpips,
            fit_exposure=chosen.fit_exposure,
            threads=self.threads,
            on_view=keep,
        )
        about: dict[str, Any] = dict(background.to_dict())
        about["lpips_network"] = None if lpips is None else lpips.network
        about["lpips_convention"] = None if lpips is None else lpips.convention
        if chosen.cameras is not None:
            about["held_out"] = None  # it is unknown what a mesh was trained on
        report = replace(report, about={**report.about, **about, **training})
        save_report(report, self.folder)
        return report
