"""Fine-tuning of the splats or the mesh in a file: targets, start and run, as options say."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from meshsplats._common.choices import Device
from meshsplats._common.words import plural
from meshsplats.cluster import Shared, Workers
from meshsplats.conversion import ConversionOptions
from meshsplats.conversion.gaps import without_gaps
from meshsplats.conversion.selection import choose_splats
from meshsplats.datasets.scene_files import SceneReading
from meshsplats.datasets.views import Dataset, ViewImage
from meshsplats.errors import DataWarning, OptionsError
from meshsplats.evaluation.backgrounds import Background
from meshsplats.finetuning import on_splats
from meshsplats.finetuning.cells import CellOptions, CellScene, check_for_cells, finetune_cells
from meshsplats.finetuning.checkpoint import Checkpoint, as_begun
from meshsplats.finetuning.config import FinetuneConfig, worthwhile_views, worthwhile_zooms
from meshsplats.finetuning.initial import for_photographs, starting_mesh, starts_with_filter
from meshsplats.finetuning.plans import Plan, Trained, over_background
from meshsplats.finetuning.run_files import RunFiles
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.finetuning.setup import Display, Setup
from meshsplats.finetuning.start_options import StartOptions
from meshsplats.finetuning.targets import Targets
from meshsplats.formats.mesh_formats import takes
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

Scene = GaussianCloud | SplatMesh


@dataclass(frozen=True)
class FileTuning:
    """A fine-tuning of the file or folder ``source`` to the file ``output``."""

    source: Path
    output: Path
    target: Targets
    begin: StartOptions
    reading: SceneReading
    fixed: Collection[str]
    """Settings that the user gave: a brief run does not change them."""
    workers: Callable[[int | None], AbstractContextManager[Workers]]
    """Opens the workers of cells, with at most so many threads each."""
    say: Callable[[str], object]
    """Gets lines about the run."""
    threads: int | None = None
    device: Device = "cpu"

    @property
    def files(self) -> RunFiles:
        """The files of the run."""
        return RunFiles(self.output, self.begin.cell_splats is not None)

    def plan(self, config: FinetuneConfig, earlier: Checkpoint | None, setup: Setup) -> Plan:
        """Reads the file and prepares the run. ``earlier``: checkpoint of a run that is resumed.

        Raises OptionsError for options without effect on this file, and the errors of what it calls.
        """
        scene = self.scene()
        background, photographs = None, self.target.data is not None
        if isinstance(scene, GaussianCloud) and not photographs and self.target.cameras is None:
            setup.phase("looking for views")
        dataset = self.targets(scene, config, earlier)
        if dataset.placed:
            self.say(dataset.placed)
        if photographs:
            whole = self.begin.conversion.crop is None
            if not whole:
                _warn_of_the_rest(dataset.train[0].load())
            dataset, background = over_background(
                dataset, scene, config, self.source, self.threads, whole=whole, say=self.say
            )
        if self.begin.cell_splats is not None:
            return self._plan_of_cells(config, scene, dataset, background)
        if isinstance(scene, GaussianCloud) and not photographs and self.begin.of_start == "default":
            return self._plan_on_splats(config, scene, dataset, earlier, setup)
        mesh = scene
        if isinstance(scene, GaussianCloud):
            # Photographs are few: what more triangles for them are worth was not measured.
            begun = None if photographs else as_begun(config, earlier)
            setup.phase(f"converting {len(scene):,} splats")
            mesh = starting_mesh(
                scene,
                [view.camera for view in dataset.train],
                self._conversion(scene, dataset),
                preset=self.begin.of_start,
                config=begun,
                threads=self.threads,
            )
        assert isinstance(mesh, SplatMesh)
        start = mesh

        def optimise(run: RunOptions, show: Display) -> Trained:
            return self._trained(on_splats.tuned_as_configured(start, dataset, config, run, show), config)

        reserve = on_splats.SAVE_SECONDS * len(mesh.faces)
        return Plan(mesh, dataset, _summary(mesh, scene), background, optimise, reserve=reserve)

    def scene(self) -> Scene:
        """The splats or the mesh; of splats the part that is asked for."""
        scene, crop = self.reading.load_scene(self.source, threads=self.threads), self.begin.conversion.crop
        if isinstance(scene, GaussianCloud) and crop is not None:
            # Cropped splats must not be in the targets; other selections leave gaps that the rest fills.
            scene = choose_splats(scene, crop=crop)
        if isinstance(scene, GaussianCloud) and self._as_it_looks():
            scene = without_gaps(scene, self.threads, " (``look`` area leaves them as they are)")
        return scene

    def _as_it_looks(self) -> bool:
        """Whether nothing says how wide the splats are."""
        target, conversion = self.target, self.begin.conversion
        if target.data is not None or target.cameras is not None or self.begin.cell_splats is not None:
            return False
        by_default = target.look is None and target.look_for(self.begin.preset) == "area"
        return by_default and conversion.footprint is None and conversion.footprint_px2 is None

    def targets(
        self,
        scene: Scene,
        config: FinetuneConfig,
        earlier: Checkpoint | None = None,
        zooms: Sequence[int] | None = None,
    ) -> Dataset:
        """What the run aims at; ``zooms``: of training views of splats, by default those that suit it."""
        below = config.order == "file" if self.target.below is None else self.target.below
        return replace(self.target, below=below).make(
            scene,
            self.source,
            config.behind_splats,
            self.threads,
            worthwhile_views(as_begun(config, earlier)),
            self.begin.preset,
            self._zooms(config, scene) if zooms is None else zooms,
        )

    def _plan_on_splats(
        self,
        config: FinetuneConfig,
        cloud: GaussianCloud,
        dataset: Dataset,
        earlier: Checkpoint | None,
        setup: Setup,
    ) -> Plan:
        """On images of the splats (``SplatTuning``)."""
        run = on_splats.SplatRun(
            cloud,
            lambda chosen, zooms: dataset if zooms is None else self.targets(cloud, chosen, earlier, zooms),
            config,
            self._conversion(cloud, dataset),
            self.files.folder,
            as_begun(config, earlier),
            resumed=earlier is not None,
            fixed=self.fixed,
            threads=self.threads,
            device=self.device,
        )
        tuning = on_splats.SplatTuning(run, setup)

        def optimise(options: RunOptions, show: Display) -> Trained:
            return self._trained(tuning.optimise(options, show), tuning.config)

        summary = _summary(tuning.mesh, cloud)
        mesh, dataset, reserve, rates = tuning.mesh, tuning.dataset, tuning.reserve, tuning.rates
        return Plan(mesh, dataset, summary, None, optimise, reserve=reserve, rates=rates)

    def _plan_of_cells(
        self, config: FinetuneConfig, scene: Scene, dataset: Dataset, background: Background | None
    ) -> Plan:
        if isinstance(scene, SplatMesh):
            raise OptionsError(f"{self.source} is a mesh: ``cell_splats`` divides splats")
        begin = self._conversion(scene, dataset)
        options = CellOptions(self.begin.cell_splats or 0, begin, self.begin.of_start)
        check_for_cells(config)
        count = -(-len(scene) // options.splats)
        color = None if background is None else background.color

        def optimise(run: RunOptions, show: Display) -> Trained:
            with self.workers(self.threads) as workers:
                own = replace(self, threads=workers.threads)
                shared = Shared(partial(_cell_scene, own, config, color))
                shared.hold(CellScene(scene, dataset))
                mesh = finetune_cells(shared, config, options, run, workers=workers, on_progress=show).mesh()
            on_splats.log_scores(self.files.folder, mesh, dataset, config, self.threads)
            triangles = len(mesh.faces)
            return Trained(mesh, mesh, {"triangles": triangles, "cells": count}, f"{triangles:,} triangles")

        summary = f"{len(scene):,} splats in {plural(count, 'cell')}"
        return Plan(None, dataset, summary, background, optimise)

    def _trained(self, tuned: on_splats.Tuned, config: FinetuneConfig) -> Trained:
        mesh, order, sizes = tuned
        count = len(mesh.faces)
        hybrid = config.soft_share and takes(self.output, "alpha") and not (sizes and sizes.loses)
        saving = {"order": order} if order is not None else {"alpha": "hybrid"} if hybrid else {}
        return Trained(mesh, mesh, {"triangles": count}, f"{count:,} triangles", saving, sizes)

    def _conversion(self, cloud: GaussianCloud, dataset: Dataset) -> ConversionOptions:
        """Of the mesh at the start."""
        options = replace(self.begin.conversion, crop=None, look=dataset.look)  # cropped already
        if self.begin.of_start == "paper":
            return options
        return for_photographs(options, cloud, dataset.train, self.threads)

    def _zooms(self, config: FinetuneConfig, scene: Scene) -> Sequence[int]:
        """Zooms of the training views of a ``scene`` of splats."""
        look = self.target.look_for(self.begin.preset)
        if look == "area" and self.begin.cell_splats is not None:
            return (1,)
        options = replace(self.begin.conversion, look=look)
        filtered = isinstance(scene, GaussianCloud) and starts_with_filter(scene, options)
        return worthwhile_zooms(config, look, filtered and self.begin.of_start == "default")


def _summary(mesh: SplatMesh, scene: Scene) -> str:
    text = f"{len(mesh.faces):,} triangles"
    if isinstance(scene, GaussianCloud) and (mesh.splat_count or 0) < len(scene):
        text += f" of {mesh.splat_count:,} splats, {len(scene):,} before"
    return text


def _cell_scene(
    tuning: FileTuning, config: FinetuneConfig, background: tuple[float, float, float] | None
) -> CellScene:
    """The scene of a run in cells, in one of its processes; ``background`` of photographs."""
    scene = tuning.scene()
    assert isinstance(scene, GaussianCloud)
    dataset = tuning.targets(scene, config)
    return CellScene(scene, dataset if background is None else dataset.over(background))


def _warn_of_the_rest(image: ViewImage) -> None:
    if image.alpha is None and image.mask is None:
        warnings.warn(
            "``crop`` with photographs that have neither masks nor alpha: they still show what is cropped,"
            " which will be baked into the rest; to get a part, crop the tuned mesh",
            DataWarning,
            stacklevel=2,
        )
