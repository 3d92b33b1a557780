"""``meshsplats finetune``: optimises a mesh on photographs or on images of the splats."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from meshsplats.cameras.files import save_cameras
from meshsplats.cli import option
from meshsplats.cli.arguments import as_cli_options
from meshsplats.cli.common import ClusterOptions, SplatOptions, again, plural
from meshsplats.cli.messages import UsageError
from meshsplats.cli.training import (
    Plan,
    Trained,
    TrainingCommand,
    over_background,
)
from meshsplats.cluster import Shared
from meshsplats.conversion import ConversionOptions
from meshsplats.conversion.selection import choose_splats
from meshsplats.datasets.views import Dataset, ViewImage
from meshsplats.errors import DataWarning
from meshsplats.evaluation.backgrounds import Background
from meshsplats.finetuning import FinetuneConfig, RunOptions, make_config, on_splats, starting_mesh
from meshsplats.finetuning.checkpoint import Checkpoint, as_begun
from meshsplats.finetuning.config import worthwhile_views, worthwhile_zooms
from meshsplats.finetuning.initial import for_photographs, starts_with_filter
from meshsplats.finetuning.run_files import RunFiles
from meshsplats.finetuning.setup import Display, Setup
from meshsplats.formats.mesh_formats import takes
from meshsplats.formats.outputs import check_mesh_suffix
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    from meshsplats.finetuning.cells import CellScene


@as_cli_options(without=("look",), metavars={"crop": "X0 Y0 Z0 X1 Y1 Z1"})
class StartOptions(ConversionOptions):  # with the look of the targets
    """The mesh at the start."""


@dataclass(frozen=True)
class Finetune(TrainingCommand):
    """Optimises a mesh until its images match those of the splats, or photographs.

    Splats are converted first. Beside the result NAME: its configuration, a preview, and a folder NAME.run,
    from which --resume continues after Ctrl-C.
    """

    COMMON = (
        *("input", "output", "preset", "opacity", "minutes", "steps", "data", "cameras"),
        *("look", "max_triangles", "threads", "device", "resume", "force"),
    )

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, or, with --data, a mesh."""
    preset: Annotated[Literal["default", "paper"], tyro.conf.arg(metavar="NAME")] = "default"
    """default: best quality at equal time. paper: the text of the MeshSplats paper."""
    start: tyro.conf.Fixed[Literal["same", "default", "paper"]] = "same"
    """Conversion of splats; same: that of --preset. default: an ellipse of 5 to 32 triangles a splat. paper:
    the paper's conversion."""
    conversion: StartOptions = field(default_factory=StartOptions)
    cell_splats: option.Count = None
    """Tune splats in cells of at most N, in the memory of a cell, one after the other or by --cluster."""
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    reading: SplatOptions = field(default_factory=SplatOptions)

    def files(self) -> RunFiles:
        return RunFiles(self.output, self.cell_splats is not None)

    def configured(self) -> FinetuneConfig:
        return make_config(self.preset, **self.explicit_settings())

    def check(self) -> None:
        check_mesh_suffix(self.output)
        on_splats.check_order_of_file(self.configured(), self.output)
        if self.cluster.cluster is not None and self.cell_splats is None:
            raise UsageError("--cluster is for the cells of --cell-splats")
        super().check()

    def plan(self, config: FinetuneConfig, earlier: Checkpoint | None, setup: Setup) -> Plan:
        scene = self._scene()
        dataset = self._targets(scene, config, earlier)
        background = None
        if self.target.data is not None:
            whole = self.conversion.crop is None
            if not whole:
                _warn_of_the_rest(dataset.train[0].load())
            dataset, background = over_background(
                dataset, scene, config, self.input, self.threads, whole=whole
            )
        if self.cell_splats is not None:
            return self._plan_of_cells(config, scene, dataset, background)
        if isinstance(scene, GaussianCloud) and self.target.data is None and self._start_preset == "default":
            return self._plan_on_splats(config, scene, dataset, earlier, setup)
        mesh = scene
        if isinstance(scene, GaussianCloud):
            # Photographs are few: what more triangles for them are worth was not measured.
            begun = as_begun(config, earlier) if self.target.data is None else None
            setup.phase(f"converting {len(scene):,} splats")
            mesh = self._start(scene, dataset, begun)
        assert isinstance(mesh, SplatMesh)
        start = mesh

        def optimise(run: RunOptions, show: Display) -> Trained:
            return self._trained(on_splats.tuned_as_configured(start, dataset, config, run, show), config)

        reserve = on_splats.SAVE_SECONDS * len(mesh.faces)
        return Plan(mesh, dataset, _summary(mesh, scene), background, optimise, reserve=reserve)

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
            lambda chosen, zooms: dataset if zooms is None else self._targets(cloud, chosen, earlier, zooms),
            config,
            self._start_options(cloud, dataset),
            self.files().folder,
            as_begun(config, earlier),
            resumed=earlier is not None,
            fixed=[name for name, value in asdict(self.tuning).items() if value is not None],
            threads=self.threads,
            device=self.device,
        )
        tuning = on_splats.SplatTuning(run, setup)

        def optimise(options: RunOptions, show: Display) -> Trained:
            return self._trained(tuning.optimise(options, show), tuning.config)

        summary = _summary(tuning.mesh, cloud)
        mesh, dataset, reserve, rates = tuning.mesh, tuning.dataset, tuning.reserve, tuning.rates
        return Plan(mesh, dataset, summary, None, optimise, reserve=reserve, rates=rates)

    def _trained(self, tuned: on_splats.Tuned, config: FinetuneConfig) -> Trained:
        mesh, order, sizes = tuned
        count = len(mesh.faces)
        hybrid = config.soft_share and takes(self.output, "alpha") and not (sizes and sizes.loses)
        saving = {"order": order} if order is not None else {"alpha": "hybrid"} if hybrid else {}
        return Trained(mesh, mesh, {"triangles": count}, f"{count:,} triangles", saving, sizes)

    def _start(self, cloud: GaussianCloud, dataset: Dataset, config: FinetuneConfig | None) -> SplatMesh:
        return starting_mesh(
            cloud,
            [view.camera for view in dataset.train],
            self._start_options(cloud, dataset),
            preset=self._start_preset,
            config=config,
            threads=self.threads,
        )

    def _start_options(self, cloud: GaussianCloud, dataset: Dataset) -> ConversionOptions:
        options = replace(self.conversion, crop=None, look=dataset.look)  # cropped already
        paper = self._start_preset == "paper"
        return options if paper else for_photographs(options, cloud, dataset.train, self.threads)

    def _scene(self) -> GaussianCloud | SplatMesh:
        scene = self.reading.load_scene(self.input)
        if isinstance(scene, GaussianCloud) and self.conversion.crop is not None:
            # Cropped splats must not be in the targets; other selections leave gaps that the rest fills.
            scene = choose_splats(scene, crop=self.conversion.crop)
        return scene

    def _targets(
        self,
        scene: GaussianCloud | SplatMesh,
        config: FinetuneConfig,
        earlier: Checkpoint | None,
        zooms: Sequence[int] | None = None,
    ) -> Dataset:
        below = config.order == "file" if self.target.below is None else self.target.below
        return replace(self.target, below=below).make(
            scene,
            self.input,
            config.behind_splats,
            self.threads,
            worthwhile_views(as_begun(config, earlier)),
            self.preset,
            self._zooms(config, scene) if zooms is None else zooms,
        )

    def _plan_of_cells(
        self,
        config: FinetuneConfig,
        scene: GaussianCloud | SplatMesh,
        dataset: Dataset,
        background: Background | None,
    ) -> Plan:
        from meshsplats.finetuning.cells import CellOptions, CellScene, check_for_cells, finetune_cells

        if isinstance(scene, SplatMesh):
            raise UsageError(f"{self.input} is a mesh: --cell-splats divides splats")
        begin = self._start_options(scene, dataset)
        options = CellOptions(self.cell_splats or 0, begin, self._start_preset)
        check_for_cells(config)
        count = -(-len(scene) // options.splats)
        color = None if background is None else background.color

        def optimise(run: RunOptions, show: Display) -> Trained:
            with self.cluster.workers(self.threads) as workers:
                command = replace(self, threads=workers.threads)
                shared = Shared(partial(_cell_scene, command, color))
                shared.hold(CellScene(scene, dataset))
                mesh = finetune_cells(shared, config, options, run, workers=workers, on_progress=show).mesh()
            on_splats.log_scores(self.files().folder, mesh, dataset, config, self.threads)
            triangles = len(mesh.faces)
            return Trained(mesh, mesh, {"triangles": triangles, "cells": count}, f"{triangles:,} triangles")

        summary = f"{len(scene):,} splats in {plural(count, 'cell')}"
        return Plan(None, dataset, summary, background, optimise)

    def save_more(self, files: RunFiles, plan: Plan, trained: Trained) -> None:
        if self.target.data is None and plan.dataset.test:
            cameras = [view.camera for view in plan.dataset.test]
            save_cameras(cameras, files.held_out, origin=plan.dataset.origin)

    def next_steps(self, files: RunFiles, config: FinetuneConfig, plan: Plan) -> list[str]:
        """The command that scores the result on held-out views, or one that renders it if there are none."""
        if config.order == "file":
            return ["web viewers and engines that cull back sides show this file; our own commands sort it"]
        target, dataset = self.target, plan.dataset
        if self.conversion.crop is not None or (target.data is None and not dataset.test):
            return self.rendering_next()
        words: list[object] = []
        if target.data is not None:
            words += again(target, "data", downscale=1, test_every=8, missing="few", masks="count")
        else:
            words += ["--splats", self.input, "--cameras", files.held_out, *self.reading.again()]
            words += ["--look", dataset.look] if dataset.look != "area" else []
            words += ["--sh-degree", target.sh_degree] if target.sh_degree is not None else []
        return self.evaluating_next(words, plan, config)

    def _zooms(self, config: FinetuneConfig, scene: GaussianCloud | SplatMesh) -> Sequence[int]:
        """Zooms of the training views of a ``scene`` of splats."""
        look = self.target.look_for(self.preset)
        if look == "area" and self.cell_splats is not None:
            return (1,)
        options = replace(self.conversion, look=look)
        filtered = isinstance(scene, GaussianCloud) and starts_with_filter(scene, options)
        return worthwhile_zooms(config, look, filtered and self._start_preset == "default")

    @property
    def _start_preset(self) -> str:
        return self.preset if self.start == "same" else self.start


def _summary(mesh: SplatMesh, scene: GaussianCloud | SplatMesh) -> str:
    text = f"{len(mesh.faces):,} triangles"
    if isinstance(scene, GaussianCloud) and (mesh.splat_count or 0) < len(scene):
        text += f" of {mesh.splat_count:,} splats, {len(scene):,} before"
    return text


def _cell_scene(command: Finetune, background: tuple[float, float, float] | None) -> CellScene:
    """The scene of a run in cells, in one of its processes; ``background`` of photographs."""
    from meshsplats.finetuning.cells import CellScene

    scene = command._scene()
    assert isinstance(scene, GaussianCloud)
    dataset = command._targets(scene, command.configured(), None)
    return CellScene(scene, dataset if background is None else dataset.over(background))


def _warn_of_the_rest(image: ViewImage) -> None:
    if image.alpha is None and image.mask is None:
        warnings.warn(
            "--crop with photographs that have neither masks nor alpha: they still show what is cropped,"
            " which will be baked into the rest; to get a part, crop the tuned mesh",
            DataWarning,
            stacklevel=2,
        )
