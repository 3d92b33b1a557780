"""``meshsplats train``: photographs to a mesh, without splats."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from meshsplats.camera import Camera
from meshsplats.cli import option
from meshsplats.cli.common import again, say_origin
from meshsplats.cli.messages import UsageError, say
from meshsplats.cli.progress import progress_display
from meshsplats.cli.training import Plan, Trained, TrainingCommand, tuning_options
from meshsplats.datasets.image_files import Masks, Missing
from meshsplats.datasets.views import Dataset
from meshsplats.evaluation.backgrounds import BLACK, Background
from meshsplats.finetuning import FinetuneConfig, Interrupted, RunOptions
from meshsplats.finetuning.checkpoint import Checkpoint
from meshsplats.finetuning.config import BACKGROUNDS, LENGTHS
from meshsplats.finetuning.run_files import RunFiles
from meshsplats.finetuning.setup import Display, Setup
from meshsplats.formats.outputs import check_mesh_suffix, check_outputs, check_splat_endings, placed
from meshsplats.formats.splat_formats import written_ending
from meshsplats.training.as_splats import FITTED_SHARE
from meshsplats.training.config import TrainConfig, train_config
from meshsplats.training.run import SO_FAR, check_training_memory, train

if TYPE_CHECKING:
    from typing_extensions import Self


@tuning_options(lambda name: f"(default: {getattr(TrainConfig, name)})")
class GrowingOptions(TrainConfig):
    """The optimisation, and the growth of the set of fans."""


@dataclass(frozen=True)
class PhotographOptions:
    """The photographs."""

    downscale: option.Count = None
    """Factor by which images are smaller than the photographs. Default: what the minutes suffice for."""
    test_every: int = 8
    """Every n-th view is held out for scores, if the data set has no split; 0: none."""
    missing: Missing = "few"
    """Missing photographs are left out (skip), if they are fewer than half (few), or an error."""
    masks: Masks = "count"
    """Only pixels inside of masks count, or what is outside is clear, as in photographs that were cut out."""
    estimate_cameras: bool = False
    """Find the cameras of the photographs though the folder holds some of a kind that is not read."""
    frames: option.Count = None
    """Frames to take of a video. Default: two per second, 40 to 120."""
    cache: float = 2.0
    """Gigabytes of images kept in memory; others are read again when they are needed."""

    def check(self) -> None:
        """ValueError for values out of range."""
        if not self.cache >= 0:
            raise ValueError(f"--cache must be a number of gigabytes, >= 0, got {self.cache}")

    @property
    def cache_bytes(self) -> int:
        return int(self.cache * 1e9)


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
    """Also write splats to this file, .ply, .spz or .sog, for their viewers: a fifth of the time."""
    target: PhotographOptions = field(default_factory=PhotographOptions)  # type: ignore[assignment]
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
            if self.as_splats == self.output:
                raise UsageError("--as-splats must not be the mesh itself: give another name")
            check_outputs([self.as_splats], self.force, inputs=self.inputs)
        super().check()

    def prepared(self, config: FinetuneConfig) -> Self:
        from meshsplats.training.reconstruction import ensure_cameras
        from meshsplats.training.video import photographs_of

        folder = photographs_of(self.input, self.target.frames, say)
        there = ensure_cameras(folder, replacing=self.target.estimate_cameras, say=say)
        if there is not None and self.target.estimate_cameras:
            raise UsageError(f"--estimate-cameras has no effect: {there} has cameras")
        return replace(self, input=folder)._sized(folder, config)

    def plan(self, config: FinetuneConfig, earlier: Checkpoint | None, setup: Setup) -> Plan:
        from meshsplats.datasets.points import load_points

        assert isinstance(config, TrainConfig)
        dataset, background = self._dataset(config)
        mask = dataset.train[0].mask
        if mask is not None and mask.mean() < 0.5:
            say("masks leave most pixels out, which may become anything: --masks subject cuts out an object")
        points = load_points(self.input, origin=dataset.origin)
        known = "no known points" if points is None else f"{len(points.positions):,} known points"

        def optimise(run: RunOptions, show: Display) -> Trained:
            mesh = train(dataset, config, points=points, run=run, on_progress=show)
            counts: dict[str, int] = {"fans": mesh.splat_count or 0, "triangles": len(mesh.faces)}
            made = f"{counts['triangles']:,} triangles of {counts['fans']:,} fans"
            return Trained(mesh, mesh, counts, made)

        needed = check_training_memory(dataset, config, cache_bytes=self.target.cache_bytes)
        summary = f"up to {config.max_splats:,} fans of {config.sides} triangles; {known}"
        reserve = 0.0 if self.as_splats is None else 60 * FITTED_SHARE * (config.minutes or 0)
        return Plan(None, dataset, summary, background, optimise, reserve=reserve, needed=needed)

    def save_more(self, files: RunFiles, plan: Plan, trained: Trained) -> None:
        from meshsplats.formats.gaussians import save_gaussians
        from meshsplats.training.as_splats import fit_splats

        if self.as_splats is None:
            return
        run = RunOptions(threads=self.threads, device=self.device, report_every=0, preview_every=0)
        with progress_display() as show:
            show.phase(f"fitting splats, for {self.as_splats}")
            splats = fit_splats(trained.saved, plan.dataset, self.configured(), run=run, on_progress=show)
        splats = placed(splats, self.origin)
        say_origin(splats.origin, "keep", splats=True)
        save_gaussians(splats, self.as_splats)

    def preview_camera(self, plan: Plan) -> Camera:
        # From elsewhere, it would show what no photograph shows.
        return (plan.dataset.test or plan.dataset.train)[0].camera

    def report_interrupt(self, stop: Interrupted, files: RunFiles) -> int:
        code = super().report_interrupt(stop, files)
        say(f"the mesh so far: {files.folder / SO_FAR}")
        return code

    def next_steps(self, files: RunFiles, config: FinetuneConfig, plan: Plan) -> list[str]:
        """The command that scores the result on held-out views, or one that renders it if there are none."""
        if not plan.dataset.test:
            return self.rendering_next()
        how = again(self.target, downscale=1, test_every=8, missing="few", masks="count")
        return self.evaluating_next(["--data", self.input, *how], plan, config)

    def _dataset(self, config: TrainConfig) -> tuple[Dataset, Background]:
        from meshsplats.datasets.folder import load_dataset

        dataset = load_dataset(
            self.input,
            downscale=1 if self.target.downscale is None else self.target.downscale,
            test_every=self.target.test_every,
            cache_bytes=self.target.cache_bytes,
            missing=self.target.missing,
            masks=self.target.masks,
        )
        if len(dataset.train) < 2:
            raise ValueError(
                f"{self.input}: {len(dataset.train)} training views, {len(dataset.test)} held out; at least 2"
                " are needed to train on (--test-every 0 holds none out)"
            )
        if config.background in BACKGROUNDS:
            found = Background(BACKGROUNDS[config.background], "given")
        elif dataset.train[0].load().alpha is None:
            found = Background(BLACK, "given")  # covered by the fans themselves
        else:
            found = Background((1.0, 1.0, 1.0), "usual")
        return dataset.over(found.color), found
