"""``meshsplats bake``: what other programs do not have, filter and colours of views, as part of a mesh."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from meshsplats._common.words import plural
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, Flat, as_cli_options
from meshsplats.cli.common import size_of, written
from meshsplats.cli.images import ViewOptions
from meshsplats.cli.messages import say
from meshsplats.operations.options import BakingOptions


@as_cli_options(presets=False)
class BakeOptions(BakingOptions):
    views: ViewOptions


@dataclass(frozen=True)
class Bake(Command):
    """Makes the low-pass filter of a mesh part of its triangles, for viewers and engines, which have none;
    with --colors, also gives each vertex one colour for all views.

    Meshes have a filter after 'convert --set footprint=filter'. The result is right for these views and this
    image size: seen from nearer it is too soft, from farther away too thin.
    """

    COMMON = (
        *("input", "output", "orbit", "cameras", "data"),
        *("distance", "width", "colors", "filter_px2", "json", "force"),
    )

    input: tyro.conf.Positional[Path]
    """The mesh: .npz, .ply, .glb, .usdc."""
    output: option.Output
    """The mesh to write: .glb, .usdc, .ply, .npz, .obj."""
    baking: Annotated[BakeOptions, Flat] = field(default_factory=BakeOptions)
    origin: option.Origin = "keep"
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.operations.edits import bake_file

        start, place = time.perf_counter(), partial(written, origin=self.origin)
        made = bake_file(self.input, self.output, self.baking, place=place, force=self.force, say=say)
        seconds, count = time.perf_counter() - start, len(made.mesh.faces)
        result = {
            "mesh": str(self.output),
            "triangles": count,
            "filter_px2": made.filter_px2,
            "colors_of_degree": made.degree,
            "views": len(made.cameras),
            "seconds": round(seconds, 3),
        }
        size = f"{self.output} ({plural(count, 'triangle')}, {size_of(self.output)}):"
        self.finish(result, size, f"{made.in_words()}, in {seconds:.1f} s")
