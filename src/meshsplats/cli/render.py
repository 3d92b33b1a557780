"""``meshsplats render``: images of splats or of a mesh."""

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
from meshsplats.cli.common import ClusterOptions, PartOptions, SplatOptions, named, track
from meshsplats.cli.images import DrawOptions, ViewOptions
from meshsplats.cli.messages import say
from meshsplats.cli.records import write_configuration
from meshsplats.datasets.scene_views import WAYS_OF_VIEWS
from meshsplats.renders.options import ImageOptions


@as_cli_options(presets=False)
class RenderOptions(ImageOptions):
    views: ViewOptions
    draw: DrawOptions
    reading: SplatOptions
    part: PartOptions


@dataclass(frozen=True)
class Render(Command):
    """Renders splats, a mesh or a tileset: one image (-o image.png), or a folder of images with a turntable.

    Splats (.ply, or the folder of a trained model) are converted to a mesh first, with default settings;
    --as-splats renders them as 3D Gaussian Splatting does.
    """

    COMMON = (
        *("input", "output", "as_splats", "orbit", "look_around", "cameras"),
        *("data", "elevation", "azimuth", "distance", "up", "width"),
        *("height", "background", "transparent", "depth", "json", "force"),
    )
    EXCLUSIVE = (*WAYS_OF_VIEWS, ("background", "transparent"))
    CONFIGURABLE = True

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, a mesh, or the folder of a tileset."""
    output: option.Output
    """A .png for one view, by default of the side that shows most; or a folder, of an orbit of 60 views."""
    images: Annotated[RenderOptions, Flat] = field(default_factory=RenderOptions)
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.renders.saving import ImageRun

        start = time.perf_counter()
        run = ImageRun(self.input, self.output, self.images, say, self.cluster.workers)
        made = run.save(force=self.force, progress=partial(track, label="rendering"))
        files, cameras = made.files, made.cameras
        write_configuration(files.config, "render", self, made.record)
        seconds = time.perf_counter() - start
        output = {
            "images": files.images,
            "depth": files.depths,
            "turntable": files.turntable,
            "cameras": files.cameras,
            "seconds": round(seconds, 3),
        }
        lines = [f"{plural(len(cameras), 'image')} of {cameras[0].width} x {cameras[0].height}"]
        lines[0] += f" in {seconds:.1f} s: {named(self.output)}"
        if files.turntable:
            lines.append(f"turntable: {named(files.turntable)}")
        self.finish(output, *lines)
