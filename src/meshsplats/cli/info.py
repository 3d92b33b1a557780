"""``meshsplats info``: the content of a splat file, a mesh, a camera file, a model folder or a data set."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from meshsplats.cli.arguments import Command
from meshsplats.cli.common import SplatOptions
from meshsplats.cli.messages import shown_path


@dataclass(frozen=True)
class Info(Command):
    """Describes a splat file, a mesh, a tileset, levels of detail, a camera file, a model folder, or a data
    set of photographs."""

    input: tyro.conf.Positional[Path]
    """The file or folder."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    json: bool = False
    """Print the findings as JSON."""

    def execute(self) -> None:
        from meshsplats.operations.inspection import describe, in_words

        findings = {"path": shown_path(self.input), **describe(self.input, self.reading.arguments)}
        if findings["kind"] not in ("splats", "tileset"):
            self.reading.refuse_for(self.input)
        self.finish(findings, *in_words(findings))
