"""``meshsplats info``: the content of a splat file, a mesh, a camera file, a model folder or a data set."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from meshsplats.cli.arguments import Command
from meshsplats.cli.common import SplatOptions
from meshsplats.cli.messages import shown_path
from meshsplats.inspection import Place, describe


@dataclass(frozen=True)
class Info(Command):
    """Describes a splat file, a mesh, a tileset, a camera file, a model folder, or a data set of
    photographs."""

    input: tyro.conf.Positional[Path]
    """The file or folder."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    json: bool = False
    """Print the findings as JSON."""

    def execute(self) -> None:
        findings = {"path": shown_path(self.input), **describe(self.input, self.reading.arguments)}
        if findings["kind"] not in ("splats", "tileset"):
            self.reading.refuse_for(self.input)
        if self.json:
            print(json.dumps(findings, indent=1, allow_nan=False))
            return
        width = max(map(len, findings))
        for key, value in findings.items():
            print(f"{key.replace('_', ' '):<{width}}  {_in_words(value)}")


def _in_words(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, Place):
        return f"{value:.12g}"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        if value and isinstance(value[0], list):
            return ", ".join(" x ".join(map(str, size)) for size in value)
        return "  ".join(_in_words(v) for v in value) or "none"
    return str(value)
