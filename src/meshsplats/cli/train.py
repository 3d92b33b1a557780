"""``meshsplats train``: photographs to a mesh, without splats."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import tyro

from meshsplats._common.words import command_line, plural
from meshsplats.cli import option
from meshsplats.cli.arguments import as_cli_options
from meshsplats.cli.common import again, say_origin
from meshsplats.cli.messages import UsageError, say
from meshsplats.cli.progress import progress_display
from meshsplats.cli.training import TrainingCommand, tuning_options
from meshsplats.finetuning.config import LENGTHS, FinetuneConfig
from meshsplats.formats.outputs import check_mesh_suffix, check_outputs, check_splat_endings, placed
from meshsplats.formats.splat_formats import written_ending
from meshsplats.training.config import TrainConfig, train_config
from meshsplats.training.photographs import PhotographOptions
from meshsplats.training.result_cameras import FEW, camera_files, files_after_mesh

if TYPE_CHECKING:
    from typing_extensions import Self

    from meshsplats.finetuning.checkpoint import Checkpoint
    from meshsplats.finetuning.interruption import Interrupted
    from meshsplats.finetuning.plans import Plan, Trained
    from meshsplats.finetuning.run_files import RunFiles
    from meshsplats.finetuning.setup import Setup


@tuning_options({"default": TrainConfig()})
class GrowingOptions(TrainConfig):
    """The optimisation, and the growth of the set of fans."""


@as_cli_options(presets=False)
class PhotoOptions(PhotographOptions):
    """The photographs."""


@dataclass(frozen=True)
class Train(TrainingCommand):
    """Makes a mesh from photographs with cameras: COLMAP, NeRF-synthetic, nerfstudio or LLFF folders.

    Without cameras, they are found first (extra photos) and saved beside the photographs. Of a video (extra
    video), frames are taken, to a folder beside it. Beside the result NAME: its configuration, a preview, the
    cameras from which it is shown, and a folder NAME.run, from which --resume continues after Ctrl-C.
    """

    COMMON = (
        *("input", "output", "minutes", "steps", "max_splats", "downscale", "test_every", "masks"),
        *("exposure", "as_splats", "threads", "resume", "force"),
    )
    EXCLUSIVE = (LENGTHS,)

    input: tyro.conf.Positional[Path]
    """The folder of the photographs, its transforms.json, or a video."""
    as_splats: option.File = None
    """Also write splats for viewers (.ply, .spz, .sog): a fifth of the time, of 100,000 fans by default."""
    target: PhotoOptions = field(default_factory=PhotoOptions)  # type: ignore[assignment]
    tuning: GrowingOptions = field(default_factory=GrowingOptions)  # type: ignore[assignment]

    @property
    def has_photographs(self) -> bool:
        return True

    def configured(self) -> TrainConfig:
        return train_config(**self.explicit_settings())

    def check(self) -> None:
        check_mesh_suffix(self.output)
        if self.as_splats is not None:
            check_splat_endings(written_ending(self.as_splats.name))
            if self.as_splats.resolve() == self.output.resolve():
                raise UsageError("--as-splats must not be the mesh itself: give another name")
        check_outputs(files_after_mesh(self.output, self.as_splats), self.force, inputs=self.inputs)
        super().check()

    def prepared(self, config: FinetuneConfig) -> Self:
        start = perf_counter()
        folder = self.target.with_cameras(self.input, say, self.threads, resumed=self.resume)
        left = config.minutes and max(config.minutes - (perf_counter() - start) / 60, config.minutes / 10)
        return replace(self, input=folder)._sized(folder, left)

    def plan(self, config: FinetuneConfig, earlier: Checkpoint | None, setup: Setup) -> Plan:
        assert isinstance(config, TrainConfig)
        plan = self.target.plan(self.input, config, as_splats=self.as_splats is not None, say=say)
        if (count := len(plan.dataset.train)) < FEW:
            say(f"warning: {plural(count, 'photograph')} to train on: views between them need ten or more")
        return plan

    def save_more(self, files: RunFiles, plan: Plan, trained: Trained) -> None:
        from meshsplats.finetuning.run_options import RunOptions
        from meshsplats.training.as_splats import fit_splats
        from meshsplats.training.result_cameras import save_result_cameras, save_splats

        save_result_cameras(plan.dataset, self.output, self.origin)
        if self.as_splats is None:
            return
        run = RunOptions(files.folder, threads=self.threads, device=self.device, report_every=0)
        with progress_display() as show:
            show.phase(f"fitting splats, for {self.as_splats}")
            splats = fit_splats(trained.saved, plan.dataset, self.configured(), run=run, on_progress=show)
        splats = placed(splats, self.origin)
        say_origin(splats.origin, "keep", splats=True)
        save_splats(splats, self.as_splats, plan.dataset, self.origin)

    def finish(self, result: dict[str, Any], *lines: str, indent: int | None = 1) -> None:
        result["cameras"] = camera_files(self.output, self.as_splats)
        super().finish(result, *lines, indent=indent)

    def report_interrupt(self, stop: Interrupted, files: RunFiles) -> int:
        from meshsplats.training.run import SO_FAR

        code = super().report_interrupt(stop, files)
        say(f"the mesh so far: {files.folder / SO_FAR}")
        return code

    def next_steps(self, files: RunFiles, config: FinetuneConfig, plan: Plan) -> list[str]:
        """The commands that show the result, and score it on held-out views, if there are any."""
        lines = [f"next: {command_line(['meshsplats', 'view', self.output])}"]
        how = again(self.target, downscale=1, test_every=8, missing="few", masks="count")
        scored = plan.dataset.test and self.evaluating_next(["--data", self.input, *how], plan, config)
        return [*lines, *(scored or ())]
