"""``meshsplats blender``: pictures and scenes by Blender."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_type_hints

import tyro

from meshsplats.blender.levels import Chain, LevelMeshes, is_chain, read_chain
from meshsplats.blender.options import LIGHTS, LightOptions, SceneOptions
from meshsplats.camera import Camera
from meshsplats.cameras.files import save_cameras
from meshsplats.cli import UsageError, say
from meshsplats.cli.common import (
    Count,
    File,
    Output,
    PartOptions,
    SplatOptions,
    ViewOptions,
    check_outputs,
    configuration,
    load_scene,
    parse_color,
    plural,
    record_beside,
    size_of,
    view_names,
    write_json,
)
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    from meshsplats.blender import Progress

LIT_SAMPLES = 16
"""Samples a pixel of lit pictures where nothing is said."""
_EVERY = 10.0
"""Seconds from one line of progress to the next, where standard error is no terminal."""
_FORMATS = (".png", ".exr", ".blend")


def _described(options: type[LightOptions]) -> type[LightOptions]:
    """The options of light as ones that may be left out, so that a named light can say them."""
    metavars = {"sun": "AZIMUTH ELEVATION", "sun_color": "R G B", "sky_color": "R G B", "hdri": "FILE"}
    typed: dict[str, Any] = {}
    for name, hint in get_type_hints(options).items():
        if hint is bool:
            typed[name] = bool
            continue
        choices = "{" + ",".join(map(str, get_args(hint))) + "}"
        metavar = metavars.get(name) or {int: "N", float: "X"}.get(hint, choices)
        told = "" if name == "hdri" else f"(default: {_listed(getattr(options, name))})"
        typed[name] = Annotated[hint | None, tyro.conf.arg(metavar=metavar, help_behavior_hint=told)]
    about = (
        "Light and surroundings of lit pictures. Lengths follow the subject's size. Defaults: --lights sun."
    )
    values = {name: False if kind is bool else None for name, kind in typed.items()}
    made = type("LightOptions", (options,), {"__annotations__": typed, "__doc__": about, **values})
    return dataclass(frozen=True)(made)


def _listed(value: Any) -> str:
    return " ".join(f"{part:g}" for part in value) if isinstance(value, tuple) else str(value)


if TYPE_CHECKING:
    _Light = LightOptions
else:
    _Light = _described(LightOptions)


@dataclass(frozen=True)
class Blender:
    """Draws a mesh in Blender: a picture (-o picture.png or .exr), a folder of them, or the scene (-o
    scene.blend).

    Without --lit, the picture is that of `meshsplats render`. With it, sun and sky light the splats, which
    cast shadows and are seen in mirrors and through glass. Splats are converted to a mesh first, with
    default settings; with --lit, to one flat ellipse a splat (convert --mode flat), which takes light best.
    Needs Blender's module bpy in an environment of its own, or an installed Blender (--executable).
    """

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, a mesh, or a chain of levels of detail (levels.json; for a .blend)."""
    output: Output
    """A .png or .exr for one view, a folder for several, or a .blend with a camera for each view."""
    lit: bool = False
    """Light the splats; the options under "light" say how."""
    engine: Literal["cycles", "eevee"] = "cycles"
    """cycles: exact. eevee: quicker on a graphics card; triangles are sorted for each view, which is nearly
    exact."""
    views: ViewOptions = field(default_factory=ViewOptions)
    lights: Literal["sun", "noon", "overcast", "studio"] = "sun"
    """With --lit: an afternoon's sun, the sun high in a clear sky, clouds, or two large lamps. The options
    under "light" change what they say."""
    light: _Light = field(default_factory=_Light)
    background: str = "white"
    """Colour behind the scene: white, black, grey, #rrggbb, or r,g,b from 0 to 1."""
    transparent: bool = False
    """No background: pictures with an alpha channel."""
    samples: Count = None
    """Unlit: side of the grid of samples in each pixel, as in render. Default: 2 (a .blend: 1). With --lit:
    samples a pixel. Default: 16 and denoised, which a person waits for; 64 or more for a last picture."""
    no_denoise: bool = False
    """With --lit, cycles: leave the noise of few samples in."""
    format: Literal["png", "exr"] = "png"
    """Kind of the pictures in a folder."""
    executable: File = None
    """An installed Blender, 4.2 or newer, to use instead of the module bpy."""
    threads: Count = None
    """At most N threads. Default: all processors."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    part: PartOptions = field(default_factory=PartOptions)
    json: bool = False
    """Print the result as JSON."""
    force: bool = False
    """Overwrite existing outputs."""

    def run(self) -> None:
        from meshsplats.blender import draw
        from meshsplats.blender.launch import command

        suffix = self.output.suffix.lower()
        options = self._options(suffix)
        chain = self._chain(suffix)
        command(self.executable)
        start = time.perf_counter()
        files = [level.path for level in chain.levels] if chain else [self.input]
        scene, *coarser = (self.part.of(load_scene(file, self.reading)) for file in files)
        cameras = self._views().make(scene, self.input, count=1 if suffix else 60, side=800)
        if suffix in (".png", ".exr") and len(cameras) > 1:
            raise UsageError(f"{plural(len(cameras), 'view')} do not fit one {suffix}: give -o a folder")
        pictures = self._pictures(suffix, len(cameras))
        blend = self.output if suffix == ".blend" else None
        records = [
            record_beside(self.output, kind) if suffix else self.output / f"{kind}.json"
            for kind in ("cameras", "config")
        ]
        check_outputs(
            [*pictures, *([blend] if blend else []), *records], self.force, None if suffix else self.output
        )
        mesh = _converted(scene, self.lit)
        subject: SplatMesh | LevelMeshes = mesh
        if chain:
            levels = [mesh, *(_converted(level, self.lit) for level in coarser)]
            subject = LevelMeshes(chain.name, levels, [level.screen_size for level in chain.levels])
        if not suffix:
            self.output.mkdir(exist_ok=True)
        with _shown(len(pictures)) as show:
            result = draw(
                subject,
                cameras,
                images=pictures,
                blend=blend,
                options=options,
                executable=self.executable,
                announce=lambda ahead: say(_announcement(ahead, options, len(pictures))),
                progress=show,
            )
        save_cameras(cameras, records[0])
        write_json(records[1], configuration("blender", self))
        self._report(result, cameras, pictures, len(mesh.faces), time.perf_counter() - start)

    def _chain(self, suffix: str) -> Chain | None:
        """The chain of levels of detail that the input names, or None."""
        if not is_chain(self.input):
            return None
        if suffix != ".blend":
            raise UsageError(
                f"{self.input}: a chain of levels of detail makes a .blend; for images, give one mesh of it"
            )
        return read_chain(self.input)

    def _options(self, suffix: str) -> SceneOptions:
        """What Blender is asked for, or UsageError for options that contradict each other or would do
        nothing."""
        self.views.check()
        if suffix and suffix not in _FORMATS:
            raise UsageError(
                f"-o must end in {', '.join(_FORMATS)}, or name a folder, got {self.output.name!r}"
            )
        if self.transparent and self.background != "white":
            raise UsageError("--transparent and --background exclude each other")
        if not self.lit and (self.light != _Light() or self.lights != "sun"):
            raise UsageError("the options of light need --lit")
        if self.no_denoise and (not self.lit or self.engine != "cycles"):
            raise UsageError("--no-denoise is for --lit with Cycles: other pictures are not denoised")
        if suffix and self.format != "png":
            raise UsageError("--format is for a folder of pictures: the name given with -o decides")
        if self.light.hdri is not None and self.background != "white":
            raise UsageError("--background has no effect with --hdri, which is what is seen behind the scene")
        samples = self.samples
        if samples is None:
            samples = LIT_SAMPLES if self.lit else 1 if suffix == ".blend" else 2
        elif suffix == ".blend" and not self.lit and samples > 1:
            raise UsageError("--samples: an unlit .blend takes one sample a pixel; render it larger instead")
        options = SceneOptions(
            light=self.named_light() if self.lit else None,
            engine=self.engine,
            samples=samples,
            background=None if self.transparent else parse_color(self.background),  # type: ignore[arg-type]
            denoise=self.lit and self.engine == "cycles" and not self.no_denoise,
            threads=self.threads,
        )
        options.check()
        return options

    def named_light(self) -> LightOptions:
        """The named light, with what was given instead."""
        given = {f.name: getattr(self.light, f.name) for f in fields(LightOptions)}
        return replace(
            LIGHTS[self.lights], **{k: v for k, v in given.items() if v is not None and v is not False}
        )

    def _views(self) -> ViewOptions:
        """Mirror and ball need room beside the subject."""
        wide = self.lit and (self.light.mirror or self.light.glass) and self.views.cameras is None
        if wide and self.views.look_around is None and self.views.distance == 1.0:
            return replace(self.views, distance=1.7)
        return self.views

    def _pictures(self, suffix: str, count: int) -> list[Path]:
        if suffix:
            return [] if suffix == ".blend" else [self.output]
        return [self.output / name for name in view_names(count, suffix=f".{self.format}")]

    def _report(
        self,
        result: dict,
        cameras: Sequence[Camera],
        pictures: Sequence[Path],
        triangles: int,
        seconds: float,
    ) -> None:
        if self.json:
            output = (
                {"blend": str(self.output)}
                if not pictures
                else {"pictures": [str(path) for path in pictures]}
            )
            print(
                json.dumps(output | result | {"triangles": triangles, "seconds": round(seconds, 3)}, indent=1)
            )
            return
        told = f"Blender {result['blender']}, {triangles:,} triangles, up to {result['layers']} layers"
        if not pictures:
            named = f"{self.output} ({size_of(self.output)}), {plural(len(cameras), 'camera')}"
            print(f"{named}, in {seconds:.1f} s: {told}")
            return
        where = f"{self.output} ({size_of(self.output)})" if self.output.is_file() else f"{self.output}/"
        size = f"{cameras[0].width} x {cameras[0].height}"
        print(f"{plural(len(pictures), 'picture')} of {size} in {seconds:.1f} s: {where}")
        print(told)


def _converted(scene: GaussianCloud | SplatMesh, lit: bool) -> SplatMesh:
    if isinstance(scene, SplatMesh):
        return scene
    from meshsplats.conversion import convert

    # Crossed ellipses stand upright on the surface, where they catch too little light.
    return convert(scene, mode="flat") if lit else convert(scene)


def _announcement(ahead: dict[str, Any], options: SceneOptions, pictures: int) -> str:
    """What Blender is about to do, and about how long it will take."""
    told = f"{ahead['triangles']:,} triangles, up to {ahead['layers']:,} layers behind each other"
    if not pictures:
        return told
    told += f" ({ahead['mean_layers']:.0f} on average), {plural(ahead['samples'], 'sample')} a pixel"
    told += ", denoised" if options.denoise else ""
    seconds = estimated_seconds(ahead, options)
    return told + ("" if seconds is None else f"; about {_duration(seconds)} on {_processors(options)}")


def estimated_seconds(ahead: dict[str, Any], options: SceneOptions) -> float | None:
    """About how long Cycles takes, from what ``draw`` announces; None for EEVEE. Measured with Blender 4.2 on
    scenes of 4 to 16 layers a pixel (docs/blender.md): a ray that meets m layers costs 2 m + 0.17 m^2
    microseconds lit, as each layer sends rays to the light that meet others, and 1.1 m unlit."""
    if options.engine != "cycles":
        return None
    from meshsplats._core.library import processors

    layers = ahead["mean_layers"]
    ray = 2e-6 * layers + 0.17e-6 * layers**2 if options.light is not None else 1.1e-6 * layers
    pixel = ray * ahead["samples"] + (20e-6 if options.denoise else 0)
    busy = pixel * ahead["pixels"] + 2e-6 * ahead["triangles"]
    return busy / (options.threads or processors())


def _processors(options: SceneOptions) -> str:
    from meshsplats._core.library import processors

    return plural(options.threads or processors(), "thread")


def _duration(seconds: float) -> str:
    """For people, no more exact than an estimate is."""
    if seconds < 90:
        return f"{max(5, 5 * round(seconds / 5))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes / 60:.1f} h"


@contextmanager
def _shown(total: int) -> Iterator[Callable[[Progress], object]]:
    """A function that shows how far Blender is: as a bar where stderr is a terminal, else a line now and
    then."""
    if not sys.stderr.isatty():
        yield _Lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("Blender"), BarColumn(), TextColumn("{task.fields[text]}"))
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=max(total, 1), text="starts")
        yield lambda at: bar.update(task, completed=at.done + at.share, text=_words(at))


class _Lines:
    def __init__(self) -> None:
        self._next = time.monotonic() + _EVERY

    def __call__(self, at: Progress) -> None:
        if at.stage and time.monotonic() >= self._next:
            self._next = time.monotonic() + _EVERY
            say(f"Blender: {_words(at)}")


def _words(at: Progress) -> str:
    which = f"picture {min(at.done + 1, at.images)} of {at.images}" if at.images > 1 else ""
    left = f"{at.left} left" if at.left else ""
    return ", ".join(filter(None, [which, at.stage, left]))
