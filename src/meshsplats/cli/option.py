"""Types of options that several commands have: their placeholders and, where it is the same, their help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from meshsplats.cli.messages import UsageError
from meshsplats.formats.mesh_formats import formats_in_words

# Optional options. Their help describes the default, in place of "(default: None)".
Count = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")]
Number = Annotated[float | None, tyro.conf.arg(metavar="X", help_behavior_hint="")]
Text = Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")]
File = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
Inputs = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="INPUT...", help_behavior_hint="")]
Threads = Annotated[
    int | None,
    tyro.conf.arg(
        metavar="N", help="Maximum number of threads. Default: all processors.", help_behavior_hint=""
    ),
]
AsJson = Annotated[bool, tyro.conf.arg(help="Print the result as JSON.")]
Force = Annotated[bool, tyro.conf.arg(help="Overwrite existing outputs.")]
Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
MeshOutput = Annotated[Path, tyro.conf.arg(aliases=["-o"], help=f"The mesh: {formats_in_words()}.")]
Origin = Annotated[
    Literal["keep", "local"] | tuple[float, float, float],
    tyro.conf.arg(
        metavar="{keep,local,X Y Z}",
        help="Georeferenced scenes. keep: the result stands where the input does; local: without its origin;"
        " X Y Z: coordinates are relative to this point of the world, which several scenes can share.",
    ),
]


def check_resumption(resume: bool, force: bool) -> None:
    """UsageError for both of --resume and --force."""
    if resume and force:
        raise UsageError("--resume continues, --force starts again: give one of them")
