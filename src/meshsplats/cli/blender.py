"""``meshsplats blender``: images and scenes by Blender."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from meshsplats._common.words import plural
from meshsplats.blender.files import PictureOptions, PictureRun, Pictures
from meshsplats.blender.options import LightOptions
from meshsplats.blender.plan import Lines, where
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, Flat, as_cli_options
from meshsplats.cli.common import PartOptions, SplatOptions, named
from meshsplats.cli.images import ViewOptions
from meshsplats.cli.messages import say
from meshsplats.cli.progress import InBar, terminal_bar
from meshsplats.cli.records import write_configuration
from meshsplats.datasets.scene_views import WAYS_OF_VIEWS

if TYPE_CHECKING:
    from meshsplats.blender import Progress


def _listed(value: Any) -> str:
    return " ".join(f"{part:g}" for part in value) if isinstance(value, tuple) else str(value)


def _default_light(name: str) -> str:
    return "" if name == "hdri" else f"(default: {_listed(getattr(LightOptions, name))})"


@as_cli_options(defaults=_default_light, flags=True)
class LightArguments(LightOptions):
    """Light and surroundings of lit images. Lengths are relative to the subject. Defaults: --lights sun."""


@as_cli_options(presets=False)
class BlenderOptions(PictureOptions):
    views: ViewOptions
    light: LightArguments
    reading: SplatOptions
    part: PartOptions


@dataclass(frozen=True)
class Blender(Command):
    """Renders a mesh in Blender: an image (-o image.png or .exr), a folder of images, or the scene (-o
    scene.blend).

    Without --lit, the image is that of `meshsplats render`. With --lit, sun and sky light the splats, which
    cast shadows and are seen in mirrors and through glass. Splats are converted to a mesh first, with
    default settings; with --lit, to one flat ellipse per splat (convert --set mode=flat), which takes light
    best. Needs Blender's module bpy in an environment of its own, or an installed Blender (--executable).
    """

    COMMON = (
        *("input", "output", "lit", "lights", "fast", "hdri", "mirror", "glass"),
        *("engine", "samples", "orbit", "cameras", "azimuth", "elevation", "distance"),
        *("width", "background", "transparent", "executable", "json", "force"),
    )
    EXCLUSIVE = (*WAYS_OF_VIEWS, ("background", "transparent"))
    CONFIGURABLE = True

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, a mesh, the folder of a tileset, or a chain of levels of detail (levels.json,
    for a .blend)."""
    output: option.Output
    """A .png or .exr for one view, a folder for several, or a .blend with a camera for each view."""
    pictures: Annotated[BlenderOptions, Flat] = field(default_factory=BlenderOptions)
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        start = time.perf_counter()
        run = PictureRun(self.input, self.output, self.pictures, say)
        with terminal_bar() as bar:
            lines = Lines(say)
            show = partial(_show, bar) if bar is not None else lambda at, images: lines(at)
            made = run.save(force=self.force, progress=show)
        write_configuration(made.config, "blender", self)
        self._print_result(made, time.perf_counter() - start)

    def resolved(self) -> dict[str, Any]:
        return asdict(self.pictures.named_light()) if self.pictures.is_lit else {}

    def _print_result(self, made: Pictures, seconds: float) -> None:
        images, camera = made.images, made.cameras[0]
        files = {"images": [str(p) for p in images]} if images else {"blend": str(self.output)}
        output = files | made.result | {"triangles": made.triangles, "seconds": round(seconds, 3)}
        summary = f"Blender {made.result['blender']}, {made.triangles:,} triangles,"
        summary += f" up to {made.result['layers']} layers"
        if images:
            size = f"{plural(len(images), 'image')} of {camera.width} x {camera.height}"
            self.finish(output, f"{size} in {seconds:.1f} s: {named(self.output)}", summary)
        else:
            cameras = plural(len(made.cameras), "camera")
            self.finish(output, f"{named(self.output)}, {cameras}, in {seconds:.1f} s: {summary}")


def _show(bar: InBar, at: Progress, images: int) -> None:
    bar.phase("Blender", (at.done + at.share) / max(images, 1), where(at))
