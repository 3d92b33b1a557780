"""``meshsplats finetune``: optimises a mesh on photographs or on images of the splats."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from meshsplats._arrays import subsample
from meshsplats.cameras.files import save_cameras
from meshsplats.cli.arguments import as_cli_options
from meshsplats.cli.common import (
    ClusterOptions,
    Count,
    Output,
    SplatOptions,
    check_mesh_suffix,
    load_scene,
    plural,
)
from meshsplats.cli.messages import UsageError, command_line
from meshsplats.cli.training import (
    Display,
    Plan,
    RunFiles,
    Setup,
    ShowProgress,
    Trained,
    TrainingCommand,
    as_begun,
    default_background,
    over_background,
)
from meshsplats.cluster import Shared
from meshsplats.conversion import ConversionOptions
from meshsplats.conversion.budget import usual_triangles_each
from meshsplats.conversion.merging import simplify_in_blocks
from meshsplats.conversion.selection import choose_splats
from meshsplats.datasets.views import Dataset, ViewImage
from meshsplats.errors import DataWarning
from meshsplats.evaluation.backgrounds import Background
from meshsplats.finetuning import (
    FinetuneConfig,
    RunOptions,
    finetune,
    make_config,
    starting_mesh,
    worthwhile_views,
)
from meshsplats.finetuning.baseline import SHARES, SizeScores, converted, measure_baseline, partly
from meshsplats.finetuning.checkpoint import Checkpoint
from meshsplats.finetuning.config import worthwhile_zooms
from meshsplats.finetuning.initial import starts_with_filter
from meshsplats.finetuning.memory import available_memory
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
from meshsplats.finetuning.reports import SCORED_VIEWS, held_out_scores, scored_count
from meshsplats.finetuning.step import samples_of
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    from meshsplats.finetuning.cells import CellScene

    StartOptions = ConversionOptions
else:
    StartOptions = as_cli_options(
        ConversionOptions,
        "The mesh at the start.",
        without=("look",),  # that of the targets
        metavars={"crop": "X0 Y0 Z0 X1 Y1 Z1"},
    )


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
    output: Output
    """The tuned mesh: .npz or .ply, which keep everything; .glb, .usdc, .obj."""
    preset: Annotated[Literal["default", "paper"], tyro.conf.arg(metavar="NAME")] = "default"
    """default: best quality at equal time. paper: the text of the MeshSplats paper."""
    start: tyro.conf.Fixed[Literal["same", "default", "paper"]] = "same"
    """Conversion of splats; same: that of --preset. default: an ellipse of 5 to 32 triangles a splat. paper:
    the paper's conversion."""
    conversion: StartOptions = field(default_factory=StartOptions)
    cell_splats: Count = None
    """Tune splats in cells of at most N, in the memory of a cell, one after the other or by --cluster."""
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    reading: SplatOptions = field(default_factory=SplatOptions)

    def files(self) -> RunFiles:
        return RunFiles(self.output, self.cell_splats is not None)

    def configured(self) -> FinetuneConfig:
        return make_config(self.preset, **self.explicit_settings())

    def check(self) -> None:
        check_mesh_suffix(self.output)
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

        def optimise(run: RunOptions, show: ShowProgress) -> Trained:
            return self._trained(finetune(start, dataset, config, run=run, on_progress=show), config)

        reserve = SAVE_SECONDS * len(mesh.faces)
        return Plan(mesh, dataset, _summary(mesh, scene), background, optimise, reserve)

    def _plan_on_splats(
        self,
        config: FinetuneConfig,
        cloud: GaussianCloud,
        dataset: Dataset,
        earlier: Checkpoint | None,
        setup: Setup,
    ) -> Plan:
        """On images of the splats: as much as there is time for, and never below the conversion."""
        if earlier is None:
            record = self._timed(cloud, dataset, config, setup)
        else:
            record = StartRecord.load(self.files().folder)
        if record.brief_steps is not None:
            given = {name for name, value in asdict(self.tuning).items() if value is not None}
            config = of_brief_run(config, record.brief_steps, given)
            dataset = self._targets(cloud, config, earlier, BRIEF_ZOOMS)
        used = cloud
        if record.max_splats is not None:
            setup.phase(f"merging {len(cloud):,} splats to {record.max_splats:,}")
            used = simplify_in_blocks(cloud, record.max_splats, threads=self.threads)
        setup.phase(f"converting {len(used):,} splats")
        conversion = self._conversion(used, dataset, config)
        setup.phase("scoring the conversion")
        seconds = None if setup.seconds is None else BASELINE_SHARE * setup.seconds
        baseline = measure_baseline(conversion, cloud, dataset, config, threads=self.threads, seconds=seconds)
        if record.brief_steps is not None:
            mesh = conversion
        else:
            begun, resumed = as_begun(config, earlier), earlier is not None
            mesh = self._start(used, dataset, begun, record, setup, resumed=resumed)
        scorings = 1 if record.brief_steps is None else 2
        saving = SAVE_SECONDS * len(mesh.faces)
        reserve = scorings * baseline.seconds + saving

        def optimise(run: RunOptions, show: Display) -> Trained:
            if not self._has_time(record, setup, reserve) and earlier is None:
                return self._trained(mesh, config, baseline.compared_with_itself())
            if earlier is None:
                record.save(self.files().folder)
            tuned = finetune(mesh, dataset, config, run=run, on_progress=show)
            show.phase("scoring the result")
            sizes = baseline.compare(tuned, config, self.threads)
            if not sizes.loses:
                return self._trained(tuned, config, sizes)
            for share in SHARES if record.brief_steps is not None else ():
                late = setup.spent + baseline.seconds + saving - (setup.seconds or np.inf)
                if late > OVERTIME:
                    break
                less = partly(mesh, tuned, share)
                if less is not None and not (found := baseline.compare(less, config, self.threads)).loses:
                    self._log_scores(less, dataset, config)
                    return self._trained(less, config, found)
            best = mesh
            if record.brief_steps is None:
                best = self._conversion(used, dataset, config)
            self._log_scores(best, dataset, config)
            return self._trained(best, config, sizes)

        rates = {name: getattr(config, name) for name in BRIEF_RATES} if record.brief_steps else {}
        return Plan(mesh, dataset, _summary(mesh, cloud), None, optimise, reserve, rates=rates)

    def _has_time(self, record: StartRecord, setup: Setup, reserve: float) -> bool:
        """Whether what is left of the time is worth beginning a brief run."""
        if setup.seconds is None or record.brief_steps is None:
            return True
        step = (1 - SETUP_SHARE) * setup.seconds / record.brief_steps
        return setup.seconds - setup.spent - reserve >= FEWEST_BRIEF_STEPS * step

    def _trained(self, mesh: SplatMesh, config: FinetuneConfig, sizes: SizeScores | None = None) -> Trained:
        count = len(mesh.faces)
        hybrid = config.soft_share and self.output.suffix.lower() == ".glb" and not (sizes and sizes.loses)
        alpha: Literal["hybrid"] | None = "hybrid" if hybrid else None
        return Trained(mesh, mesh, {"triangles": count}, f"{count:,} triangles", alpha, sizes)

    def _timed(
        self, cloud: GaussianCloud, dataset: Dataset, config: FinetuneConfig, setup: Setup
    ) -> StartRecord:
        """What the time leaves of the start, by the speed of this machine."""
        chosen, pixels = self.conversion, dataset.train[0].camera.width * dataset.train[0].camera.height
        limited = chosen.max_splats is not None or chosen.max_triangles is not None
        own = any(value is not None for value in (chosen.mode, chosen.detail, chosen.sides, chosen.rings))
        may_be_brief = config.opacity == "blended" and dataset.look == "area" and not own
        steps: float | None = config.total_steps(len(dataset.train))
        count, timed = len(cloud), setup.seconds is not None and len(cloud) >= TIMED_SPLATS
        if not limited:
            count = min(count, most_splats(available_memory()) or count)
        if timed:
            setup.phase("timing steps")
            options = self._start_options(dataset)
            pace = measure_pace(cloud, dataset, config, options, self.threads, self.device)
            left = (1 - SETUP_SHARE) * (setup.seconds or 0)
            if config.opacity == "cutoff" and not limited:
                count = pace.splats(count, worthwhile_steps(config), left)
            steps = pace.steps(self._limited(count), left)
        brief = may_be_brief and steps is not None and is_brief(self._limited(count), pixels, steps, timed)
        return StartRecord(
            max_splats=count if count < len(cloud) else None,
            brief_steps=max(1, round(steps)) if brief and steps is not None else None,
        )

    def _limited(self, splats: int) -> int:
        """How many of them the options leave."""
        chosen = self.conversion
        if chosen.max_triangles is not None:
            splats = min(splats, max(chosen.max_triangles // usual_triangles_each(), 1))
        return min(splats, chosen.max_splats or splats)

    def _start(
        self,
        cloud: GaussianCloud,
        dataset: Dataset,
        config: FinetuneConfig | None,
        record: StartRecord | None = None,
        setup: Setup | None = None,
        *,
        resumed: bool = False,
    ) -> SplatMesh:
        """The starting mesh. ``record`` notes the images that there was time for, or says it, if the run is
        ``resumed``."""
        options = self._start_options(dataset)
        on_image = None
        if record is not None and setup is not None:
            goes_on = setup.observer("choosing numbers of triangles", SETUP_SHARE)
            recorded = record.images

            def on_image(done: int, total: int) -> bool:
                in_time = goes_on(done, total)
                if resumed:
                    return recorded is None or done < recorded
                record.images = done
                return in_time

        return starting_mesh(
            cloud,
            [view.camera for view in dataset.train],
            options,
            preset=self._start_preset,
            config=config,
            threads=self.threads,
            on_image=on_image,
        )

    def _start_options(self, dataset: Dataset) -> ConversionOptions:
        return replace(self.conversion, crop=None, look=dataset.look)  # cropped already

    def _conversion(self, cloud: GaussianCloud, dataset: Dataset, config: FinetuneConfig) -> SplatMesh:
        cameras = [view.camera for view in dataset.train]
        return converted(cloud, config, self._start_options(dataset), cameras)

    def _scene(self) -> GaussianCloud | SplatMesh:
        scene = load_scene(self.input, self.reading)
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
        return self.target.make(
            scene,
            self.input,
            default_background(config),
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
        options = CellOptions(self.cell_splats or 0, self.conversion, self._start_preset)
        check_for_cells(config)
        count = -(-len(scene) // options.splats)
        color = None if background is None else background.color

        def optimise(run: RunOptions, show: ShowProgress) -> Trained:
            with self.cluster.workers(self.threads) as workers:
                command = replace(self, threads=workers.threads)
                shared = Shared(partial(_cell_scene, command, color))
                shared.hold(CellScene(scene, dataset))
                mesh = finetune_cells(shared, config, options, run, workers=workers, on_progress=show).mesh()
            self._log_scores(mesh, dataset, config)
            triangles = len(mesh.faces)
            return Trained(mesh, mesh, {"triangles": triangles, "cells": count}, f"{triangles:,} triangles")

        summary = f"{len(scene):,} splats in {plural(count, 'cell')}"
        return Plan(None, dataset, summary, background, optimise)

    def _log_scores(self, mesh: SplatMesh, dataset: Dataset, config: FinetuneConfig) -> None:
        """Logs the scores of ``mesh``, which is not that of the last step, on the held-out views."""
        from meshsplats.finetuning.journal import Journal

        if not dataset.test:
            return
        journal = Journal(self.files().folder)
        views = subsample(dataset.test, scored_count(journal) or SCORED_VIEWS)
        decibels, similarity = held_out_scores(mesh, views, config, self.threads)
        lines = journal.metrics()
        if lines and lines[-1].get("psnr") == decibels:
            return  # of a run that had ended, resumed again
        last = max((line["step"] for line in lines), default=0)
        count = len(mesh.faces)
        journal.log_metrics(last, psnr=decibels, ssim=similarity, views=len(views), triangles=count)

    def save_more(self, files: RunFiles, plan: Plan, trained: Trained) -> None:
        if self.target.data is None and plan.dataset.test:
            cameras = [view.camera for view in plan.dataset.test]
            save_cameras(cameras, files.held_out, origin=plan.dataset.origin)

    def next_steps(self, files: RunFiles, config: FinetuneConfig, plan: Plan) -> list[str]:
        """The command that scores the result on held-out views, or one that renders it if there are none."""
        target, dataset, folder = self.target, plan.dataset, self.output.with_suffix("")
        if self.conversion.crop is not None or (target.data is None and not dataset.test):
            words: list[str | Path | int] = ["meshsplats", "render", self.output, "-o", f"{folder}-images"]
            return [f"next: {command_line(words)}"]
        words = ["meshsplats", "evaluate", self.output]
        if target.data is not None:
            words += ["--data", target.data]
            words += ["--downscale", target.downscale] if target.downscale != 1 else []
            words += ["--test-every", target.test_every] if target.test_every != 8 else []
            words += ["--missing", target.missing] if target.missing != "error" else []
        else:
            words += ["--splats", self.input, "--cameras", files.held_out, *self.reading.again()]
            words += ["--look", dataset.look] if dataset.look != "area" else []
            words += ["--sh-degree", target.sh_degree] if target.sh_degree is not None else []
        if plan.background is not None:
            words += ["--background", plan.background.name]
        elif config.background == "black":
            words += ["--background", "black"]
        words += ["--samples", samples_of(dataset.train[0], config)]
        words += ["-o", f"{folder}-evaluation"]
        return [f"next: {command_line(words)}"]

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
