"""``meshsplats finetune``: optimises a mesh on photographs or on images of the splats."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from meshsplats.cli.arguments import Flat, as_cli_options
from meshsplats.cli.common import ClusterOptions, SplatOptions, again
from meshsplats.cli.messages import UsageError, say
from meshsplats.cli.training import TrainingCommand
from meshsplats.conversion.options import ConversionOptions, Preset
from meshsplats.finetuning.config import FinetuneConfig, make_config
from meshsplats.finetuning.run_files import RunFiles
from meshsplats.finetuning.start_options import StartOptions
from meshsplats.formats.outputs import check_mesh_suffix

if TYPE_CHECKING:
    from meshsplats.finetuning.checkpoint import Checkpoint
    from meshsplats.finetuning.plans import Plan, Trained
    from meshsplats.finetuning.setup import Setup


@as_cli_options(without=("look",))
class StartConversion(ConversionOptions):  # with the look of the targets
    """The mesh at the start."""


@as_cli_options(presets=False)
class BeginOptions(StartOptions):
    preset: Annotated[Preset, tyro.conf.arg(metavar="NAME")] = "default"
    conversion: StartConversion


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
    begin: Annotated[BeginOptions, Flat] = field(default_factory=BeginOptions)
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    reading: SplatOptions = field(default_factory=SplatOptions)

    def files(self) -> RunFiles:
        return RunFiles(self.output, self.begin.cell_splats is not None)

    def configured(self) -> FinetuneConfig:
        return make_config(self.begin.preset, **self.explicit_settings())

    def check(self) -> None:
        from meshsplats.finetuning.on_splats import check_order_of_file

        check_mesh_suffix(self.output)
        check_order_of_file(self.configured(), self.output)
        if self.cluster.cluster is not None and self.begin.cell_splats is None:
            raise UsageError("--cluster is for the cells of --cell-splats")
        super().check()

    def plan(self, config: FinetuneConfig, earlier: Checkpoint | None, setup: Setup) -> Plan:
        from meshsplats.finetuning.file_tuning import FileTuning

        tuning = FileTuning(
            self.input,
            self.output,
            self.target,
            self.begin,
            self.reading,
            [name for name, value in asdict(self.tuning).items() if value is not None],
            self.cluster.workers,
            say,
            self.threads,
            self.device,
        )
        return tuning.plan(config, earlier, setup)

    def save_more(self, files: RunFiles, plan: Plan, trained: Trained) -> None:
        from meshsplats.cameras.files import save_cameras

        if self.target.data is None and plan.dataset.test:
            cameras = [view.camera for view in plan.dataset.test]
            save_cameras(cameras, files.held_out, origin=plan.dataset.origin)

    def next_steps(self, files: RunFiles, config: FinetuneConfig, plan: Plan) -> list[str]:
        """The command that scores the result on held-out views, or one that renders it if there are none."""
        if config.order == "file":
            return ["for web viewers and engines with back-face culling; our own commands sort it"]
        target, dataset = self.target, plan.dataset
        if self.begin.conversion.crop is not None or (target.data is None and not dataset.test):
            return self.rendering_next()
        words: list[object] = []
        if target.data is not None:
            words += again(target, "data", downscale=1, test_every=8, missing="few", masks="count")
        else:
            words += ["--splats", self.input, "--cameras", files.held_out, *self.reading.again()]
            words += ["--look", dataset.look] if dataset.look != "area" else []
            words += ["--sh-degree", target.sh_degree] if target.sh_degree is not None else []
        return self.evaluating_next(words, plan, config)
