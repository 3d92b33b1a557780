"""``meshsplats blender``: images and scenes by Blender."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from meshsplats._words import parse_color
from meshsplats.blender.levels import Chain, LevelMeshes, is_chain, read_chain
from meshsplats.blender.options import FAST_SAMPLES, FAST_SPLATS, LIGHTS, LightOptions, SceneOptions
from meshsplats.blender.plan import Lines, in_words, where
from meshsplats.camera import Camera
from meshsplats.cameras.files import save_cameras
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, as_cli_options
from meshsplats.cli.common import PartOptions, SplatOptions, plural, size_of
from meshsplats.cli.images import ViewOptions
from meshsplats.cli.messages import UsageError, say
from meshsplats.cli.progress import InBar, terminal_bar
from meshsplats.cli.records import write_configuration
from meshsplats.conversion.cleaning import cropped
from meshsplats.datasets.scene_views import WAYS_OF_VIEWS
from meshsplats.formats.outputs import CAMERAS, CONFIGURATION, beside, check_outputs, view_names
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.tiles.source import open_tileset

if TYPE_CHECKING:
    from meshsplats.blender import Progress
    from meshsplats.tiles.tileset import Tileset

LIT_SAMPLES = 16
"""Default number of samples per pixel of lit images."""
_TILE_TRIANGLES = 2_000_000
"""Triangles that Blender gets of a tileset: about 700 MB."""
_FORMATS = (".png", ".exr", ".blend")


def _listed(value: Any) -> str:
    return " ".join(f"{part:g}" for part in value) if isinstance(value, tuple) else str(value)


def _default_light(name: str) -> str:
    return "" if name == "hdri" else f"(default: {_listed(getattr(LightOptions, name))})"


@as_cli_options(metavars={"sun": "AZIMUTH ELEVATION", "hdri": "FILE"}, defaults=_default_light, flags=True)
class LightArguments(LightOptions):
    """Light and surroundings of lit images. Lengths are relative to the subject. Defaults: --lights sun."""


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
    lit: bool = False
    """Light the splats, with the options under "light"."""
    engine: Literal["cycles", "eevee"] = "cycles"
    """cycles: exact. eevee: faster on a graphics card, with triangles sorted per view, which is nearly
    exact."""
    views: ViewOptions = field(default_factory=ViewOptions)
    lights: Annotated[
        Literal["sun", "noon", "overcast", "studio"] | None,
        tyro.conf.arg(metavar="{sun,noon,overcast,studio}", help_behavior_hint=""),
    ] = None
    """Light the splats (--lit) by an afternoon sun, the default, a high sun in a clear sky, clouds, or two
    large lamps. The options under "light" change them."""
    fast: bool = False
    """A lit preview in half the time (--lit): up to 30,000 splats, 4 samples, rough light and colours."""
    light: LightArguments = field(default_factory=LightArguments)
    background: str = "white"
    """Background: white, black, grey, #rrggbb, or r,g,b from 0 to 1."""
    transparent: bool = False
    """No background: images with an alpha channel."""
    samples: option.Count = None
    """Unlit: side of the sample grid in each pixel, as in render. Default: 2 (a .blend: 1). With --lit:
    samples per pixel. Default: 16 and denoised, for previews; 64 or more for final images."""
    no_denoise: bool = False
    """With --lit, cycles: do not denoise."""
    format: Literal["png", "exr"] = "png"
    """Format of the images in a folder."""
    executable: option.File = None
    """An installed Blender, 4.2 or newer, to use instead of the module bpy."""
    threads: option.Threads = None
    reading: SplatOptions = field(default_factory=SplatOptions)
    part: PartOptions = field(default_factory=PartOptions)
    max_splats: option.Count = None
    """Merge splats that are alike until at most this many are left: a preview in less time."""
    max_error: option.Number = None
    """Tileset: take tiles whose geometric error is at most this many pixels in the images. Default: 1."""
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.blender import draw
        from meshsplats.blender.launch import command

        suffix = self.output.suffix.lower()
        options = self._options(suffix)
        chain = self._chain(suffix)
        command(self.executable)
        start = time.perf_counter()
        tileset = open_tileset(self.input, crop=self.part.crop, max_error=self.max_error)
        files = [level.path for level in chain.levels] if chain else [self.input]
        scene: GaussianCloud | SplatMesh
        if tileset:  # the coarsest tile says where it is
            scene, coarser = replace(tileset.root.load(), origin=tileset.origin), []
        else:
            scene, *coarser = (cropped(self.reading.load_scene(file), self.part.crop) for file in files)
            coarser = [level.relative_to(scene.origin) for level in coarser]
        count = 1 if suffix else 60
        cameras = self._views().make(scene, self.input, count=count, side=800, film=not suffix, say=say)
        if suffix in (".png", ".exr") and len(cameras) > 1:
            raise UsageError(f"{plural(len(cameras), 'view')} do not fit one {suffix}: give -o a folder")
        images = self._images(suffix, len(cameras))
        blend = self.output if suffix == ".blend" else None
        records = [
            beside(self.output, record) if suffix else self.output / record
            for record in (CAMERAS, CONFIGURATION)
        ]
        check_outputs(
            [*images, *([blend] if blend else []), *records], self.force, None if suffix else self.output
        )
        mesh = self._tiles(tileset, cameras) if tileset else self._converted(scene)
        subject: SplatMesh | LevelMeshes = mesh
        if chain:
            levels = [mesh, *(self._converted(level) for level in coarser)]
            subject = LevelMeshes(chain.name, levels, [level.screen_size for level in chain.levels])
        if not suffix:
            self.output.mkdir(exist_ok=True)
        with terminal_bar() as bar:
            result = draw(
                subject,
                cameras,
                images=images,
                blend=blend,
                options=options,
                executable=self.executable,
                announce=lambda ahead: say(in_words(ahead, options, len(images))),
                progress=Lines(say) if bar is None else partial(_show, bar, max(len(images), 1)),
            )
        save_cameras(cameras, records[0], origin=scene.origin)
        write_configuration(records[1], "blender", self)
        self._print_result(result, cameras, images, len(mesh.faces), time.perf_counter() - start)

    def _chain(self, suffix: str) -> Chain | None:
        """The chain of levels of detail that the input names, or None."""
        if not is_chain(self.input):
            return None
        if suffix != ".blend":
            raise UsageError(
                f"{self.input}: a chain of levels of detail makes a .blend; for images, give one mesh of it"
            )
        return read_chain(self.input)

    def _tiles(self, tileset: Tileset, cameras: Sequence[Camera]) -> SplatMesh:
        """The tiles that the cameras need."""
        from meshsplats.tiles.drawing import MAX_ERROR, tiles_mesh

        wanted = MAX_ERROR if self.max_error is None else self.max_error
        mesh, error = tiles_mesh(tileset, cameras, max_error=wanted, max_triangles=_TILE_TRIANGLES)
        if error > wanted:
            say(
                f"the views need more than {_TILE_TRIANGLES:,} triangles: errors are up to {error:.1f}, not"
                f" {wanted:g} pixels. Render views of parts, or 'meshsplats render', which draws in parts"
            )
        return mesh

    def _options(self, suffix: str) -> SceneOptions:
        """The scene for Blender; UsageError for options that contradict each other or have no effect."""
        self.views.check()
        if suffix and suffix not in _FORMATS:
            raise UsageError(
                f"-o must end in {', '.join(_FORMATS)}, or name a folder, got {self.output.name!r}"
            )
        if self.transparent and self.background != "white":
            raise UsageError("--transparent and --background exclude each other")
        if not self.is_lit and self.light != LightArguments():
            raise UsageError("the options of light need --lit")
        if self.no_denoise and (not self.is_lit or self.engine != "cycles"):
            raise UsageError("--no-denoise is for --lit with Cycles: other images are not denoised")
        if suffix and self.format != "png":
            raise UsageError("--format is for a folder of images: the name given with -o decides")
        if self.light.hdri is not None and self.background != "white":
            raise UsageError("--background has no effect with --hdri, which is the background")
        samples = self.samples
        if samples is None:
            lit = FAST_SAMPLES if self.fast else LIT_SAMPLES
            samples = lit if self.is_lit else 1 if suffix == ".blend" else 2
        elif suffix == ".blend" and not self.is_lit and samples > 1:
            raise UsageError("--samples: an unlit .blend takes one sample per pixel; render it larger")
        options = SceneOptions(
            light=self.named_light() if self.is_lit else None,
            engine=self.engine,
            samples=samples,
            background=None if self.transparent else parse_color(self.background),
            denoise=self.is_lit and self.engine == "cycles" and not self.no_denoise,
            threads=self.threads,
            fast=self.fast,
        )
        options.check()
        return options

    def resolved(self) -> dict[str, Any]:
        return asdict(self.named_light()) if self.is_lit else {}

    @property
    def is_lit(self) -> bool:
        return self.lit or self.fast or self.lights is not None

    def _converted(self, scene: GaussianCloud | SplatMesh) -> SplatMesh:
        if isinstance(scene, SplatMesh):
            if self.max_splats is not None:
                raise UsageError("--max-splats is for splats: this is a mesh already")
            return scene
        from meshsplats.conversion import convert

        # Crossed ellipses stand upright on the surface, where they catch too little light.
        mode: Literal["flat"] | None = "flat" if self.is_lit else None
        return convert(scene, max_splats=self.max_splats or (FAST_SPLATS if self.fast else None), mode=mode)

    def named_light(self) -> LightOptions:
        """The light of --lights, changed by the options."""
        options = {f.name: getattr(self.light, f.name) for f in fields(LightOptions)}
        explicit = {
            name: value for name, value in options.items() if value is not None and value is not False
        }
        return replace(LIGHTS[self.lights or "sun"], **explicit)

    def _views(self) -> ViewOptions:
        """Mirror and ball need room beside the subject."""
        wide = self.is_lit and (self.light.mirror or self.light.glass) and self.views.cameras is None
        if wide and self.views.look_around is None and self.views.distance == 1.0:
            return replace(self.views, distance=1.7)
        return self.views

    def _images(self, suffix: str, count: int) -> list[Path]:
        if suffix:
            return [] if suffix == ".blend" else [self.output]
        return [self.output / name for name in view_names(count, suffix=f".{self.format}")]

    def _print_result(
        self,
        result: dict[str, Any],
        cameras: Sequence[Camera],
        images: Sequence[Path],
        triangles: int,
        seconds: float,
    ) -> None:
        if self.json:
            output = {"images": [str(p) for p in images]} if images else {"blend": str(self.output)}
            print(
                json.dumps(output | result | {"triangles": triangles, "seconds": round(seconds, 3)}, indent=1)
            )
            return
        summary = f"Blender {result['blender']}, {triangles:,} triangles, up to {result['layers']} layers"
        if not images:
            named = f"{self.output} ({size_of(self.output)}), {plural(len(cameras), 'camera')}"
            print(f"{named}, in {seconds:.1f} s: {summary}")
            return
        where = f"{self.output} ({size_of(self.output)})" if self.output.is_file() else f"{self.output}/"
        size = f"{cameras[0].width} x {cameras[0].height}"
        print(f"{plural(len(images), 'image')} of {size} in {seconds:.1f} s: {where}")
        print(summary)


def _show(bar: InBar, total: int, at: Progress) -> None:
    bar.phase("Blender", (at.done + at.share) / total, where(at))
