"""``meshsplats levels``: levels of detail, a chain of meshes from the finest to the coarsest."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import tyro

from meshsplats._words import optional_up
from meshsplats.chains import TABLE, ChainOptions, begin_folder, check_folder, make_chain, partial_folder
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, as_cli_options
from meshsplats.cli.common import SplatOptions, say_origin, size_of
from meshsplats.cli.messages import UsageError, flag, say
from meshsplats.cli.progress import progress_display
from meshsplats.cli.records import configuration, write_configuration
from meshsplats.errors import FileFormatError
from meshsplats.finetuning import FinetuneConfig, Interrupted, Progress, make_config
from meshsplats.formats.mesh_formats import takes
from meshsplats.formats.outputs import CONFIGURATION, placed, recorded_options
from meshsplats.formats.sniff import identify
from meshsplats.levels import SAMPLES, Level
from meshsplats.rendering.looks import comparison_in_words

MINUTES = 2.0
"""Default length of the fine-tuning of a level."""
_CHANGEABLE = ("output", "threads")
"""Options that may change when a chain is resumed."""


@as_cli_options(without=("order", "up", "threads"), presets=False)
class ChainArguments(ChainOptions):
    """The meshes and their files."""


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
    no_tune: bool = False
    """Convert only: seconds in place of minutes."""
    minutes: option.Number = None
    """Length of the fine-tuning of each level. Default: 2."""
    steps: option.Count = None
    """Length of the fine-tuning of each level, in place of --minutes."""
    order: Literal["fragment", "splat"] = "fragment"
    """Order in which triangles are blended, tuned and scored: exact at every sample, or whole splats by their
    centres."""
    up: option.Text = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the
    file, else -y."""
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
        config = self._configured()
        self._check_output()
        if identify(self.input) != "splats":
            raise FileFormatError(f"{self.input}: not splats; levels needs a splat file or a model folder")
        cloud = self.reading.load(self.input, up=self.up)
        say_origin(cloud.origin, self.origin)
        level_now = 0

        @contextmanager
        def shown(number: int, level: Level) -> Iterator[Callable[[Progress], None]]:
            nonlocal level_now
            level_now = number
            say(f"level {number}: {level.splats:,} splats for {level.width} pixels")
            with progress_display() as show:
                yield show

        options = replace(self.chain, order=self.order, up=optional_up(self.up), threads=self.threads)
        options.plan(len(cloud))  # before the folder is made
        self._begin()
        try:
            table = make_chain(
                cloud,
                self.output,
                options,
                config,
                source=str(self.input),
                place=partial(placed, origin=self.origin),
                on_level=shown,
            )
        except Interrupted as stop:
            say(f"stopped in level {level_now}: the same command with --resume continues with it")
            return 128 + (stop.signal or signal.SIGINT)
        if self.json:
            print(json.dumps(table | {"folder": str(self.output)}, indent=1))
        else:
            self._print_table(table["levels"])
        return 0

    def resolved(self) -> dict[str, Any]:
        config = self._configured()
        return {} if config is None else config.to_dict()

    def _configured(self) -> FinetuneConfig | None:
        """Configuration of the fine-tuning; UsageError for options that contradict each other."""
        if self.chain.levels < 1:
            raise UsageError(f"--levels must be at least 1, got {self.chain.levels}")
        if self.chain.max_splats is not None and self.chain.max_splats < 1:
            raise UsageError(f"--max-splats must be at least 1, got {self.chain.max_splats}")
        if self.no_tune and (self.minutes is not None or self.steps is not None):
            raise UsageError("--minutes and --steps have no effect with --no-tune")
        if self.minutes is not None and self.steps is not None:
            raise UsageError("give --minutes or --steps, not both")
        if self.resume and self.force:
            raise UsageError("--resume continues, --force starts again: give one of them")
        if self.chain.alpha not in ("auto", "opaque") and not takes(f"level.{self.chain.format}", "alpha"):
            raise UsageError(f"--alpha {self.chain.alpha} is for .glb files, not .{self.chain.format}")
        optional_up(self.up)
        if self.no_tune:
            return None
        if self.steps is not None:
            return make_config("default", steps=self.steps)
        return make_config("default", minutes=MINUTES if self.minutes is None else self.minutes)

    def _check_output(self) -> None:
        """OSError, before the work, if the folder cannot appear."""
        if self.output.suffix:
            raise UsageError(f"-o must name a folder, got {self.output.name!r}")
        check_folder(self.output, resume=self.resume, replace_old=self.force)

    def _begin(self) -> None:
        """Makes the folder of unfinished levels, empty; with --resume it must be that of the same command."""
        if self.resume:
            unfinished = partial_folder(self.output)
            before = recorded_options(unfinished / CONFIGURATION, "levels") or {}
            for name, value in configuration("levels", self, unfinished)["options"].items():
                if name not in _CHANGEABLE and before.get(name) != value:
                    raise UsageError(
                        f"{unfinished} was started with {flag(name)} {before.get(name)}, not {value}"
                    )
            return
        write_configuration(begin_folder(self.output) / CONFIGURATION, "levels", self)

    def _print_table(self, rows: list[dict[str, Any]]) -> None:
        heads = (
            f"{'level':<16}{'splats':>12}{'triangles':>12}{'size':>10}{'pixels':>8}{'dB':>8}{'seconds':>9}"
        )
        print(f"{heads}  alpha" if self.chain.format == "glb" else heads)
        for row in rows:
            size = size_of(self.output / row["file"])
            print(
                f"{row['file']:<16}{row['splats']:>12,}{row['triangles']:>12,}{size:>10}"
                f"{row['screen_size']:>8}{row['psnr']:>8.2f}{row['seconds']:>9.1f}"
                + (f"  {row['alpha']['alpha']}" if self.chain.format == "glb" and row["alpha"] else "")
            )
        views = sorted({row["views"] for row in rows})
        count = " to ".join(map(str, (views[0], views[-1])[: len(views)]))
        print(f"{comparison_in_words('area', SAMPLES)}; {count} views")
        print(f"{self.output}/: {TABLE} has this table")
