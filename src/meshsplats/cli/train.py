"""``meshsplats train``: photographs to a mesh, without splats."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import tyro

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
    video), frames are taken, to a folder beside it. Beside the result NAME: its configuration, a preview, and
    a folder NAME.run with metrics, previews and a checkpoint, from which --resume continues after Ctrl-C.
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
            check_outputs([self.as_splats], self.force, inputs=self.inputs)
        super().check()

    def prepared(self, config: FinetuneConfig) -> Self:
        start = perf_counter()
        folder = self.target.with_cameras(self.input, say, self.threads, resumed=self.resume)
        left = config.minutes and max(config.minutes - (perf_counter() - start) / 60, config.minutes / 10)
        return replace(self, input=folder)._sized(folder, left)

    def plan(self, config: FinetuneConfig, earlier: Checkpoint | None, setup: Setup) -> Plan:
        assert isinstance(config, TrainConfig)
        return self.target.plan(self.input, config, as_splats=self.as_splats is not None, say=say)

    def save_more(self, files: RunFiles, plan: Plan, trained: Trained) -> None:
        from meshsplats.finetuning.run_options import RunOptions
        from meshsplats.formats.gaussians import save_gaussians
        from meshsplats.training.as_splats import fit_splats

        if self.as_splats is None:
            return
        run = RunOptions(files.folder, threads=self.threads, device=self.device, report_every=0)
        with progress_display() as show:
            show.phase(f"fitting splats, for {self.as_splats}")
            splats = fit_splats(trained.saved, plan.dataset, self.configured(), run=run, on_progress=show)
        splats = placed(splats, self.origin)
        say_origin(splats.origin, "keep", splats=True)
        save_gaussians(splats, self.as_splats)

    def report_interrupt(self, stop: Interrupted, files: RunFiles) -> int:
        from meshsplats.training.run import SO_FAR

        code = super().report_interrupt(stop, files)
        say(f"the mesh so far: {files.folder / SO_FAR}")
        return code

    def next_steps(self, files: RunFiles, config: FinetuneConfig, plan: Plan) -> list[str]:
        """The command that scores the result on held-out views, or one that renders it if there are none."""
        if not plan.dataset.test:
            return self.rendering_next()
        how = again(self.target, downscale=1, test_every=8, missing="few", masks="count")
        return self.evaluating_next(["--data", self.input, *how], plan, config)
