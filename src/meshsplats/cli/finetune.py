"""``meshsplats finetune``: optimises a mesh on photographs or on images of the splats."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from meshsplats.cameras.files import save_cameras
from meshsplats.cli.arguments import as_cli_options
from meshsplats.cli.common import Output, SplatOptions, check_mesh_suffix, load_scene
from meshsplats.cli.messages import command_line
from meshsplats.cli.training import (
    Plan,
    RunFiles,
    ShowProgress,
    Trained,
    TrainingCommand,
    default_background,
    over_background,
    views_for,
)
from meshsplats.conversion import ConversionOptions
from meshsplats.conversion.selection import choose_splats
from meshsplats.datasets.views import Dataset, ViewImage
from meshsplats.errors import DataWarning
from meshsplats.finetuning import FinetuneConfig, RunOptions, finetune, make_config, starting_mesh
from meshsplats.finetuning.checkpoint import Checkpoint
from meshsplats.finetuning.step import samples_of
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    StartOptions = ConversionOptions
else:
    StartOptions = as_cli_options(
        ConversionOptions,
        "The mesh that the optimisation starts from. Default: the value of the preset.",
        without=("look",),  # that of the targets
        metavars={"crop": "X0 Y0 Z0 X1 Y1 Z1"},
    )


@dataclass(frozen=True)
class Finetune(TrainingCommand):
    """Optimises a mesh until its images match those of the splats, or photographs.

    Splats are converted first. Beside the result NAME: its configuration, a preview, and a folder NAME.run
    with metrics, previews and a checkpoint, from which --resume continues after Ctrl-C.
    """

    COMMON = (
        *("input", "output", "preset", "opacity", "minutes", "steps", "data", "downscale", "cameras"),
        *("width", "max_triangles", "threads", "resume", "force"),
    )

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, or, with --data, a mesh."""
    output: Output
    """The tuned mesh: .npz or .ply, which keep everything; .glb, .usdc, .obj."""
    preset: Literal["default", "paper", "published"] = "default"
    """default: best quality at equal time. paper: the text of the MeshSplats paper. published: its code."""
    start: Literal["same", "default", "paper"] = "same"
    """Conversion of splats; same: that of --preset. default: one ellipse of 8 triangles per splat. paper: the
    paper's conversion, also for published."""
    conversion: StartOptions = field(default_factory=StartOptions)
    reading: SplatOptions = field(default_factory=SplatOptions)

    def configured(self) -> FinetuneConfig:
        return make_config(self.preset, **self.explicit_settings())

    def check(self) -> None:
        check_mesh_suffix(self.output)
        super().check()

    def plan(self, config: FinetuneConfig, earlier: Checkpoint | None) -> Plan:
        scene = load_scene(self.input, self.reading)
        if isinstance(scene, GaussianCloud) and self.conversion.crop is not None:
            # Cropped splats must not be in the targets; other selections leave gaps that the rest fills.
            scene = choose_splats(scene, crop=self.conversion.crop)
        dataset = self.target.make(
            scene,
            self.input,
            default_background(config),
            self.threads,
            views_for(config, earlier),
            self.preset,
        )
        background = None
        if self.target.data is not None:
            whole = self.conversion.crop is None
            if not whole:
                _warn_of_the_rest(dataset.train[0].load())
            dataset, background = over_background(
                dataset, scene, config, self.input, self.threads, whole=whole
            )
        mesh = scene if isinstance(scene, SplatMesh) else self._converted(scene, dataset)
        summary = f"{len(mesh.faces):,} triangles"
        if isinstance(scene, GaussianCloud) and (mesh.splat_count or 0) < len(scene):
            summary += f" of {mesh.splat_count:,} splats, {len(scene):,} before"

        def optimise(run: RunOptions, show: ShowProgress) -> Trained:
            tuned = finetune(mesh, dataset, config, run=run, on_progress=show)
            count = len(tuned.faces)
            glb = self.output.suffix.lower() == ".glb"
            alpha: Literal["hybrid"] | None = "hybrid" if config.soft_share and glb else None
            return Trained(tuned, tuned, {"triangles": count}, f"{count:,} triangles", alpha)

        return Plan(mesh, dataset, summary, background, optimise)

    def save_more(self, files: RunFiles, plan: Plan) -> None:
        if self.target.data is None and plan.dataset.test:
            save_cameras([view.camera for view in plan.dataset.test], files.held_out)

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

    def _converted(self, cloud: GaussianCloud, dataset: Dataset) -> SplatMesh:
        preset = self.preset if self.start == "same" else self.start
        cameras = [view.camera for view in dataset.train]
        options = replace(self.conversion, crop=None)  # cropped already
        return starting_mesh(cloud, cameras, options, preset=preset, look=dataset.look)


def _warn_of_the_rest(image: ViewImage) -> None:
    if image.alpha is None and image.mask is None:
        warnings.warn(
            "--crop with photographs that have neither masks nor alpha: they still show what is cropped,"
            " which will be baked into the rest; to get a part, crop the tuned mesh",
            DataWarning,
            stacklevel=2,
        )
