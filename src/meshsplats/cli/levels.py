"""``meshsplats levels``: levels of detail, a chain of meshes from the finest to the coarsest."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from meshsplats._common.words import optional_up
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, Flat, as_cli_options
from meshsplats.cli.common import SplatOptions, resumable, say_origin
from meshsplats.cli.messages import UsageError, flag, say
from meshsplats.cli.progress import progress_display
from meshsplats.cli.records import differences, write_configuration
from meshsplats.errors import FileFormatError
from meshsplats.formats.outputs import CONFIGURATION, check_folder_name, placed
from meshsplats.operations.options import ChainOptions, LevelTuning
from meshsplats.scene.order import Order

if TYPE_CHECKING:
    from meshsplats.finetuning import Progress
    from meshsplats.levels import Level

_CHANGEABLE = ("output", "threads")
"""Options that may change when a chain is resumed."""


@as_cli_options(without=("order", "up", "threads"), presets=False)
class ChainArguments(ChainOptions):
    """The meshes and their files."""


@as_cli_options(presets=False)
class TuningArguments(LevelTuning):
    """How long each level is fine-tuned."""


@dataclass(frozen=True)
class Levels(Command):
    """Levels of detail: a chain of meshes, each with a quarter (or half) of the triangles of the one before,
    for images with a quarter (or half) of the pixels.

    Similar splats are merged, never dropped, and each mesh is fine-tuned at the size at which it is seen. The
    folder holds the meshes, level_0 being the finest, and levels.json: triangles, bytes, screen size, PSNR.
    """

    EXCLUSIVE = (("minutes", "steps", "no_tune"),)
    CONFIGURABLE = True

    input: tyro.conf.Positional[Path]
    """Splat file, or the folder of a trained model."""
    output: option.Output
    """Folder for the meshes; it appears when all of them are done."""
    chain: ChainArguments = field(default_factory=ChainArguments)
    tuning: Annotated[TuningArguments, Flat] = field(default_factory=TuningArguments)
    order: Order = "fragment"
    """Order in which triangles are blended, tuned and scored: exact at every sample, or whole splats by their
    centres."""
    up: option.Text = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the
    file, else -y, z of a survey, or as an object stands."""
    origin: option.Origin = "keep"
    resume: bool = False
    """Continue an interrupted run of the same command, from the levels in FOLDER.partial."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    threads: option.Threads = None
    json: bool = False
    """Print the table as JSON."""
    force: bool = False
    """Overwrite an older chain in the folder."""

    def execute(self) -> int:
        from meshsplats.evaluation.level_tables import table_in_words
        from meshsplats.finetuning import Interrupted
        from meshsplats.formats.sniff import identify
        from meshsplats.operations.chains import make_chain, partial_folder, planned

        self._check()
        config = self.tuning.config()
        if identify(self.input) != "splats":
            raise FileFormatError(f"{self.input}: not splats; levels needs a splat file or a model folder")
        cloud = self.reading.load(self.input, up=self.up, threads=self.threads)
        say_origin(cloud.origin, self.origin)

        @contextmanager
        def shown(number: int, level: Level) -> Iterator[Callable[[Progress], None]]:
            say(f"level {number}: {level.splats:,} splats for {level.width} pixels")
            with progress_display() as show:
                yield show

        options = replace(self.chain, order=self.order, up=optional_up(self.up), threads=self.threads)
        planned(options, len(cloud))  # before the folder is made
        self._begin()
        how: dict[str, Any] = {"place": partial(placed, origin=self.origin), "on_level": shown}
        try:
            with resumable(partial_folder(self.output) / CONFIGURATION, force=self.force):
                table = make_chain(cloud, self.output, options, config, source=str(self.input), **how)
        except Interrupted as stop:
            return 128 + (stop.signal or signal.SIGINT)
        lines = [*table_in_words(table), f"{self.output}/: levels.json has this table"]
        self.finish(table | {"folder": str(self.output)}, *lines)
        return 0

    def resolved(self) -> dict[str, Any]:
        config = self.tuning.config()
        return {} if config is None else config.to_dict()

    def _check(self) -> None:
        """UsageError or OptionsError for options that contradict each other; OSError, before the work, if the
        folder cannot appear."""
        from meshsplats.operations.chains import check_folder

        self.chain.check()
        option.check_resumption(self.resume, self.force)
        optional_up(self.up)
        self.tuning.config()
        check_folder_name(self.output)
        check_folder(self.output, resume=self.resume, replace_old=self.force)

    def _begin(self) -> None:
        """Makes the folder of unfinished levels, empty; with --resume it must be that of the same command."""
        from meshsplats.operations.chains import begin_folder, partial_folder

        if not self.resume:
            write_configuration(begin_folder(self.output) / CONFIGURATION, "levels", self)
            return
        unfinished = partial_folder(self.output)
        differ = differences(unfinished / CONFIGURATION, "levels", self, _CHANGEABLE)
        if differ is None:
            raise UsageError(f"{unfinished} is not of this command: --force, not --resume, starts again")
        for name, (old, new) in differ.items():
            raise UsageError(f"{unfinished} was started with {flag(name)} {old}, not {new}")
