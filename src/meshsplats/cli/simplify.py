"""``meshsplats simplify``: fewer splats."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from meshsplats.cli import option
from meshsplats.cli.arguments import Command, Flat, as_cli_options
from meshsplats.cli.common import SplatOptions, draw_preview, named, written
from meshsplats.cli.records import write_configuration
from meshsplats.operations.options import SimplifyOptions


@as_cli_options(presets=False)
class MergeOptions(SimplifyOptions):
    """How many splats are left, and from where they will be seen."""


@dataclass(frozen=True)
class Simplify(Command):
    """Merges the splats that are most alike: fewer splats that look the same, and none are dropped.

    Writes a preview and the configuration beside them.
    """

    EXCLUSIVE = (("count", "share"), ("cameras", "data"))
    CONFIGURABLE = True

    input: tyro.conf.Positional[Path]
    """Splat file, or the folder of a trained model."""
    output: option.Output
    """The splats: .ply, .spz, .sog or another format."""
    merging: Annotated[MergeOptions, Flat] = field(default_factory=MergeOptions)
    origin: option.Origin = "keep"
    reading: SplatOptions = field(default_factory=SplatOptions)
    threads: option.Threads = None
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.operations.edits import EditCallbacks, simplify_file

        made = simplify_file(
            self.input,
            self.output,
            self.merging,
            EditCallbacks(
                place=partial(written, origin=self.origin),
                record=lambda path: write_configuration(path, "simplify", self),
                draw=draw_preview,
            ),
            reading=self.reading,
            threads=self.threads,
            force=self.force,
        )
        read, kept, preview = made.read, len(made.kept), not self.merging.no_preview
        result = {
            "splats": str(self.output),
            "preview": str(made.preview) if preview else None,
            "read": read,
            "written": kept,
            "bytes": self.output.stat().st_size,
            "seconds": round(made.seconds, 4),
        }
        lines = [
            f"{read:,} splats -> {kept:,} ({kept / read:.1%}) in {made.seconds:.2f} s",
            named(self.output),
        ]
        self.finish(result, *lines, *([f"preview: {made.preview}"] if preview else []))
