"""``meshsplats clean``: splats or a mesh without floaters."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import tyro

from meshsplats._common.words import plural
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, as_cli_options
from meshsplats.cli.common import SplatOptions, named, written
from meshsplats.cli.messages import shown_path
from meshsplats.conversion.cleaning_rules import FLOATERS, CleaningRules


@as_cli_options(
    "Rules: splats with any of these properties are removed."
    f" Default: --max-size {FLOATERS.max_size:g} --sparse {FLOATERS.sparse} --min-part {FLOATERS.min_part}.",
)
class RuleOptions(CleaningRules):
    pass


@dataclass(frozen=True)
class Clean(Command):
    """Removes floaters: splats that are faint, far away, alone, or in small separate parts.

    By default, the walls and sky of a place stay, which the rules alone would take for floaters: panoramas
    from inside tell them apart. Prints what each rule removes. NAME.preview.png beside the result NAME shows
    before | removed, in red | after.
    """

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, or a mesh."""
    output: option.Output
    """The remaining splats: .ply, .spz, .sog or others; a mesh: .glb, .npz, .ply, .usdc, .obj."""
    rules: RuleOptions = field(default_factory=RuleOptions)
    preview_only: bool = False
    """Print and draw what would be removed, but write no result."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    threads: option.Threads = None
    origin: option.Origin = "keep"
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.operations.edits import clean_file

        start = time.perf_counter()
        made = clean_file(
            self.input,
            self.output,
            self.rules,
            reading=self.reading,
            preview_only=self.preview_only,
            place=partial(written, origin=self.origin),
            threads=self.threads,
            force=self.force,
        )
        counts, kept, (lower, upper) = made.found.counts(), int(made.found.kept.sum()), made.extent
        around = counts.pop("surroundings", None)
        result = {
            "input": shown_path(self.input),
            "output": None if self.preview_only else str(self.output),
            "preview": str(made.preview),
            "splats": len(made.found.opacities),
            "kept": kept,
            "removed": counts,
            "surroundings": around,
            "lower": lower,
            "upper": upper,
            "seconds": round(time.perf_counter() - start, 3),
        }
        lines = [*made.found.in_words(made.rules), f"kept: {plural(kept, 'splat')}, from {lower} to {upper}"]
        lines += [] if self.preview_only else [named(self.output)]
        self.finish(result, *lines, f"preview, before | removed, in red | after: {made.preview}", indent=None)
