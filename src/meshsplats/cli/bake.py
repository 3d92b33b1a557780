"""``meshsplats bake``: the low-pass filter of a mesh, for programs that have none."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from meshsplats.cli.arguments import Command
from meshsplats.cli.common import (
    Number,
    Origin,
    Output,
    ViewOptions,
    check_mesh_suffix,
    plural,
    size_of,
    written,
)
from meshsplats.formats.outputs import check_outputs


@dataclass(frozen=True)
class Bake(Command):
    """Applies the low-pass filter of a mesh to its triangles, for viewers, engines and Blender, which have no
    such filter.

    'convert --set footprint=filter' makes such meshes. The result is right for these views and this image
    size; nearer it is soft, farther away thin.
    """

    COMMON = (
        *("input", "output", "orbit", "cameras", "data"),
        *("distance", "width", "filter_px2", "json", "force"),
    )

    input: tyro.conf.Positional[Path]
    """The mesh: .npz, .ply, .glb, .usdc."""
    output: Output
    """The mesh to write: .glb, .usdc, .ply, .npz, .obj."""
    views: ViewOptions = field(default_factory=ViewOptions)
    filter_px2: Number = None
    """Variance of the filter in square pixels, 0 to 100. Default: the mesh's own."""
    origin: Origin = "keep"
    json: bool = False
    """Print the result as JSON."""
    force: bool = False
    """Overwrite existing outputs."""

    def execute(self) -> None:
        from meshsplats.conversion import bake_filter
        from meshsplats.conversion.footprint import FRAMING_PIXELS, FRAMING_VIEWS
        from meshsplats.evaluation.viewers import alpha_for_viewers
        from meshsplats.formats.meshes import load_mesh, save_mesh

        start = time.perf_counter()
        check_mesh_suffix(self.output)
        self.views.check()
        check_outputs([self.output], self.force, inputs=[self.input])
        mesh = load_mesh(self.input)
        px2 = mesh.filter_px2 if self.filter_px2 is None else self.filter_px2
        if px2 == 0:
            raise ValueError(
                f"{self.input}: the mesh has no filter, there is nothing to bake; --filter-px2 gives it one"
            )
        cameras = self.views.make(mesh, self.input, count=FRAMING_VIEWS, side=FRAMING_PIXELS)
        baked = bake_filter(mesh, cameras, filter_px2=px2)
        save_mesh(written(baked, self.origin), self.output, **alpha_for_viewers(baked, self.output))
        seconds = time.perf_counter() - start
        if self.json:
            result = {
                "mesh": str(self.output),
                "triangles": len(baked.faces),
                "filter_px2": px2,
                "views": len(cameras),
                "seconds": round(seconds, 3),
            }
            print(json.dumps(result, indent=1))
            return
        views = f"{plural(len(cameras), 'view')} of {cameras[0].width} x {cameras[0].height}"
        print(f"{self.output} ({plural(len(baked.faces), 'triangle')}, {size_of(self.output)}): a filter of")
        print(f"{px2:g} px^2 for {views}, in {seconds:.1f} s")
