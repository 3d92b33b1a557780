"""Photographs to train on, from a folder or a video, and what is planned for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from meshsplats._common.choices import Masks, Missing
from meshsplats.errors import FileFormatError, OptionsError, OptionValueError
from meshsplats.finetuning.config import BACKGROUNDS
from meshsplats.finetuning.targets import check_cache
from meshsplats.training.config import TrainConfig

if TYPE_CHECKING:
    from meshsplats.datasets.views import Dataset
    from meshsplats.evaluation.backgrounds import Background
    from meshsplats.finetuning.plans import Plan, Trained
    from meshsplats.finetuning.run_options import RunOptions
    from meshsplats.finetuning.setup import Display

Say = Callable[[str], None]
BRIGHT = 0.5
"""Brightness of a masked subject along its outline above which it is trained over black, not white: dtu65 at
half size, 300 steps, scores 29.5 dB over black so, and 28.4 otherwise."""


@dataclass(frozen=True)
class PhotographOptions:
    """The photographs."""

    downscale: int | None = None
    """Factor by which images are smaller than the photographs. Default: what the minutes suffice for."""
    test_every: int = 8
    """Every n-th view is held out for scores, if the data set has no split; 0: none."""
    missing: Missing = "few"
    """Missing photographs: skip: left out; few: left out if fewer than half are missing; error: refused."""
    masks: Masks = "count"
    """count: pixels outside the masks are ignored; subject: they are transparent, as in cut-outs."""
    estimate_cameras: bool = False
    """Run structure from motion although the folder has cameras: in a format that is not read, or found
    earlier, for fewer photographs."""
    frames: int | None = None
    """Frames to take of a video. Default: two per second, 40 to 120."""
    cache: float = 2.0
    """Gigabytes of images kept in memory; others are read again when they are needed."""

    def check(self) -> None:
        """ValueError for values out of range."""
        from meshsplats.datasets.folder import check_reading

        check_cache(self.cache)
        check_reading(1 if self.downscale is None else self.downscale, self.test_every)
        if self.frames is not None and self.frames < 2:
            raise OptionValueError(f"``frames`` must be at least 2, got {self.frames}")

    @property
    def cache_bytes(self) -> int:
        return int(self.cache * 1e9)

    def with_cameras(
        self, source: Path, say: Say, threads: int | None = None, *, resumed: bool = False
    ) -> Path:
        """The folder of the photographs at ``source``, a folder or a video, with cameras, which are found
        where there are none, by as many ``threads``, or by all processors. ``say`` gets lines about it.
        ``resumed``: for a run that goes on with those that it began with. OptionsError if they are not to be
        found."""
        from meshsplats._common.foreign import frames_of
        from meshsplats.training.reconstruction import check_library, ensure_cameras
        from meshsplats.training.video import is_video, photographs_of

        if is_video(source) and not frames_of(source).is_dir():
            check_library()  # before the frames are chosen, which takes long
        folder = photographs_of(source, self.frames, say)
        replacing = self.estimate_cameras and not resumed
        there = ensure_cameras(folder, replacing=replacing, say=say, threads=threads)
        if there is not None and self.estimate_cameras:
            raise OptionsError(
                f"``estimate_cameras`` has no effect: {there} has cameras that were not found here; move it"
                " away to have others found"
            )
        return folder

    def load(self, folder: Path, config: TrainConfig) -> tuple[Dataset, Background]:
        """The photographs in ``folder``, over the background of the training, and that background.
        FileFormatError if there are fewer than two to train on."""
        from meshsplats.datasets.folder import load_dataset
        from meshsplats.datasets.silhouettes import (
            has_silhouettes,
            outline_brightness,
            with_clear_pixels_masked,
        )
        from meshsplats.datasets.views import check_counting
        from meshsplats.evaluation.backgrounds import BLACK, Background

        dataset = load_dataset(
            folder,
            downscale=1 if self.downscale is None else self.downscale,
            test_every=self.test_every,
            cache_bytes=self.cache_bytes,
            missing=self.missing,
            masks=self.masks,
        )
        if len(dataset.train) < 2:
            raise FileFormatError(
                f"{folder}: {len(dataset.train)} training views, {len(dataset.test)} held out; at least 2"
                " are needed to train on (``test_every`` 0 holds none out)"
            )
        check_counting(dataset.train)
        dataset = with_clear_pixels_masked(dataset).scorable()
        if config.background in BACKGROUNDS:
            found = Background(BACKGROUNDS[config.background], "given")
        elif has_silhouettes(dataset.train):
            # A bright subject over white has no outline that the loss can see.
            bright = self.masks == "subject" and outline_brightness(dataset.train) > BRIGHT
            found = Background(BLACK, "contrast") if bright else Background((1.0, 1.0, 1.0), "usual")
        else:
            found = Background(BLACK, "covered")
        return dataset.over(found.color), found

    def plan(self, folder: Path, config: TrainConfig, *, as_splats: bool = False, say: Say) -> Plan:
        """A training on the photographs in ``folder``, of which splats are made afterwards, too, if
        ``as_splats``. ``say`` gets lines about it. Raises what ``load`` and ``check_training_memory`` do."""
        from meshsplats.datasets.points import load_points
        from meshsplats.finetuning.plans import Plan, Trained
        from meshsplats.training.as_splats import FITTED_SHARE
        from meshsplats.training.run import check_training_memory, train, with_number_of_fans

        dataset, background = self.load(folder, config)
        # Splats of more fans were not measured.
        config = config.for_pixels(0) if as_splats else with_number_of_fans(config, dataset.train)
        mask = dataset.train[0].mask
        if mask is not None and mask.mean() < 0.5:
            say(
                "masks leave most pixels out, which may become anything: ``masks`` subject cuts out an object"
            )
        if any(view.turn for view in dataset.train):
            say("up: as the photographs were held, by their EXIF data")
        points = load_points(folder, origin=dataset.origin)
        known = "no known points" if points is None else f"{len(points.positions):,} known points"

        def optimise(run: RunOptions, show: Display) -> Trained:
            mesh = train(dataset, config, points=points, run=run, on_progress=show, on_phase=show.phase)
            counts: dict[str, int] = {"fans": mesh.splat_count or 0, "triangles": len(mesh.faces)}
            made = f"{counts['triangles']:,} triangles of {counts['fans']:,} fans"
            return Trained(mesh, mesh, counts, made)

        needed = check_training_memory(dataset, config, cache_bytes=self.cache_bytes)
        summary = f"up to {config.most_splats:,} fans of {config.sides} triangles; {known}"
        reserve = 60 * FITTED_SHARE * (config.minutes or 0) if as_splats else 0.0
        return Plan(None, dataset, summary, background, optimise, reserve=reserve, needed=needed)
