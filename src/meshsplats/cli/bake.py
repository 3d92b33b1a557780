"""``meshsplats bake``: what other programs do not have, filter and colours of views, as part of a mesh."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import tyro

from meshsplats.cli import option
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import plural, size_of, written
from meshsplats.cli.images import ViewOptions
from meshsplats.cli.messages import say
from meshsplats.formats.outputs import check_mesh_suffix, check_outputs


@dataclass(frozen=True)
class Bake(Command):
    """Applies the low-pass filter of a mesh to its triangles, for viewers, engines and Blender, which have no
    such filter; with --colors, also gives each vertex one colour instead of one for each view.

    'convert --set footprint=filter' makes meshes with a filter. The result is right for these views and this
    image size; nearer it is soft, farther away thin.
    """

    COMMON = (
        *("input", "output", "orbit", "cameras", "data"),
        *("distance", "width", "colors", "filter_px2", "json", "force"),
    )

    input: tyro.conf.Positional[Path]
    """The mesh: .npz, .ply, .glb, .usdc."""
    output: option.Output
    """The mesh to write: .glb, .usdc, .ply, .npz, .obj."""
    views: ViewOptions = field(default_factory=ViewOptions)
    colors: bool = False
    """Replace colours that depend on the view by their mean over these views, for programs that show them the
    same from everywhere."""
    filter_px2: option.Number = None
    """Variance of the filter in square pixels, 0 to 100. Default: the mesh's own."""
    origin: option.Origin = "keep"
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.conversion import bake_filter
        from meshsplats.conversion.footprint import FRAMING_PIXELS, FRAMING_VIEWS
        from meshsplats.evaluation.viewers import alpha_for_viewers
        from meshsplats.formats.meshes import load_mesh, save_mesh
        from meshsplats.rendering.plain_colors import plain_colors_of

        start = time.perf_counter()
        check_mesh_suffix(self.output)
        self.views.check()
        check_outputs([self.output], self.force, inputs=[self.input])
        mesh = load_mesh(self.input)
        px2 = mesh.filter_px2 if self.filter_px2 is None else self.filter_px2
        degree = mesh.sh_degree if self.colors else 0
        if self.colors and not degree:
            raise ValueError(f"{self.input}: its colours are the same from everywhere: leave out --colors")
        if not (px2 or degree):
            more = "; --colors bakes its colours" if mesh.sh_degree else ""
            raise ValueError(
                f"{self.input}: the mesh has no filter, there is nothing to bake; --filter-px2 gives it one"
                + more
            )
        cameras = self.views.make(mesh, self.input, count=FRAMING_VIEWS, side=FRAMING_PIXELS, say=say)
        if degree:  # with the filter, which shows how much of each vertex a view sees
            mesh = replace(mesh, plain_colors=plain_colors_of(mesh, cameras)).plain
        baked = bake_filter(mesh, cameras, filter_px2=px2)
        save_mesh(written(baked, self.origin), self.output, **alpha_for_viewers(baked, self.output))
        seconds = time.perf_counter() - start
        result = {
            "mesh": str(self.output),
            "triangles": len(baked.faces),
            "filter_px2": px2,
            "colors_of_degree": degree,
            "views": len(cameras),
            "seconds": round(seconds, 3),
        }
        views = f"{plural(len(cameras), 'view')} of {cameras[0].width} x {cameras[0].height}"
        what = " and ".join(
            [f"a filter of {px2:g} px^2"] * (px2 > 0) + [f"colours of degree {degree}"] * (degree > 0)
        )
        made = f"{self.output} ({plural(len(baked.faces), 'triangle')}, {size_of(self.output)}):"
        self.finish(result, made, f"{what} for {views}, in {seconds:.1f} s")
