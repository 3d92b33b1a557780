"""Shared by the commands: input by content, output that is not overwritten, cameras and rendering options."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
import tyro

from meshsplats._origin import in_words, lost_detail, sampled
from meshsplats._words import direction_in_words
from meshsplats._words import parse_color as parse_color
from meshsplats._words import parse_up as parse_up
from meshsplats.base_mesh import BaseMesh
from meshsplats.camera import MAX_SIDE, Camera
from meshsplats.cameras.files import cameras_beside, load_cameras
from meshsplats.cameras.framing import guess_up, warn_of_strays_in
from meshsplats.cameras.trajectories import dome, look_around, orbit
from meshsplats.cli.arguments import spelled
from meshsplats.cli.messages import UsageError, flag, one_line, say, shown_path
from meshsplats.cluster import Workers, open_workers
from meshsplats.datasets.views import Dataset
from meshsplats.errors import FileFormatError
from meshsplats.formats.sniff import identify
from meshsplats.formats.splat_formats import listed, written_suffixes, y_up_suffixes
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    from meshsplats.evaluation.viewers import AlphaChoice
    from meshsplats.formats.streaming import SplatStream
    from meshsplats.tiles.tileset import Tileset

T = TypeVar("T")
Scene = TypeVar("Scene", GaussianCloud, SplatMesh, GaussianCloud | SplatMesh)
Placed = TypeVar("Placed", GaussianCloud, SplatMesh, BaseMesh, GaussianCloud | SplatMesh)
# Optional options. Their help describes the default, in place of "(default: None)".
Count = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")]
Number = Annotated[float | None, tyro.conf.arg(metavar="X", help_behavior_hint="")]
Text = Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")]
File = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
Folder = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")]
Point = Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z", help_behavior_hint="")]
Box = Annotated[
    tuple[float, float, float, float, float, float] | None,
    tyro.conf.arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint=""),
]
Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
Origin = Annotated[
    Literal["keep", "local"] | tuple[float, float, float],
    tyro.conf.arg(
        metavar="{keep,local,X Y Z}",
        help="Georeferenced scenes. keep: the result stands where the input does; local: without its origin;"
        " X Y Z: coordinates are relative to this point of the world, which several scenes can share.",
    ),
]

Missing = Annotated[
    Literal["error", "skip"],
    tyro.conf.arg(help="With --data: images that are missing are an error, or their views are left out."),
]

_AXES = (
    "Direction of the y axis in the file; auto: as its format prescribes, up in"
    f" {listed(y_up_suffixes(), 'and')}, else down. After reading, y points down. Some programs write SPZ"
    " with y down: if the image is upside down, give y-down."
)


@dataclass(frozen=True)
class SplatOptions:
    """How splat files are read."""

    axes: Annotated[Literal["auto", "y-down", "y-up"], tyro.conf.arg(help=_AXES)] = "auto"
    kernel: Literal["auto", "3dgs", "antialiased", "2dgs"] = "auto"
    """Kernel that the splats were trained with; auto: as the file says."""
    time: Number = None
    """Splats that move in time: the instant to show, in the file's unit. Default: one in the middle."""
    activated: tyro.conf.Fixed[tuple[Literal["scales", "opacities", "colors"], ...]] = ()
    """Values that a .ply stores as they are, where logarithms, logits and harmonics belong."""
    strict: tyro.conf.Fixed[bool] = False
    """Refuse files with splats that are not finite; by default these are left out with a warning."""

    def load(self, path: Path, origin: np.ndarray | None = None, *, up: str | None = None) -> GaussianCloud:
        """The splats of a file, relative to ``origin``. Says what its header names; ``up``: the option that
        counts in its place."""
        from meshsplats.formats.gaussians import load_gaussians

        try:
            cloud = load_gaussians(path, origin=origin, **self.arguments)
        except FileFormatError:
            if identify(path) == "mesh":
                raise FileFormatError(f"{path}: a mesh, not splats") from None
            raise
        warn_of_strays_in(cloud)
        if up is None and cloud.up is not None:
            say(f"up: {direction_in_words(cloud.up)}, from the file's header")
        if self.kernel == "auto" and cloud.kernel != "3dgs":
            say(f"kernel: {cloud.kernel}, from the file")
        return cloud

    def stream(
        self, path: Path | Sequence[Path], origin: Sequence[float] | None = None, *, up: str | None = None
    ) -> SplatStream:
        """The splats of a file, or of several, in blocks, relative to ``origin``; ``up`` as for ``load``."""
        from meshsplats.formats.streaming import stream_gaussians

        stream = stream_gaussians(path, origin=origin, **self.arguments)
        if up is None and (told := stream.up) is not None:
            say(f"up: {direction_in_words(told)}, from the files' headers")
        return stream

    def refuse_for(self, path: Path) -> None:
        """UsageError for options that have no effect on ``path``, which is not a file of splats."""
        given = [name for name in ("kernel", "time", "activated") if name in self._changed]
        if given:
            flags = ", ".join(spelled(type(self), name) for name in given)
            raise UsageError(f"{shown_path(path)} holds no splats: {flags} would have no effect")

    @property
    def _changed(self) -> set[str]:
        return {f.name for f in fields(self) if getattr(self, f.name) != f.default}

    @property
    def arguments(self) -> dict[str, Any]:
        """Those of ``load_gaussians``."""
        return {
            "strict": self.strict,
            "axes": self.axes,
            "kernel": None if self.kernel == "auto" else self.kernel,
            "time": self.time,
            "activated": self.activated,
        }

    def again(self) -> list[str]:
        """The words with which another command reads the file in the same way."""
        words = ["--axes", self.axes] if self.axes != "auto" else []
        words += ["--kernel", self.kernel] if self.kernel != "auto" else []
        words += ["--time", f"{self.time:g}"] if self.time is not None else []
        return words + (["--set", f"activated={','.join(self.activated)}"] if self.activated else [])


@dataclass(frozen=True)
class ViewOptions:
    """Cameras and image size. Orbit, dome, look-around, cameras and data exclude each other."""

    orbit: Count = None
    """N views on a circle around the subject."""
    dome: Count = None
    """N views spread evenly over the upper half of a sphere around the subject."""
    look_around: Count = None
    """N views from the middle of the scene, such as a room, in one full turn."""
    cameras: File = None
    """Camera file: a JSON list, a cameras.json of a 3DGS trainer, a camera_path.json of nerfstudio; or the
    model folder that has one."""
    data: Folder = None
    """Data set of photographs (COLMAP, NeRF-synthetic, nerfstudio, LLFF): the cameras of its test views."""
    downscale: int = 1
    """With --data: factor by which images are smaller than the photographs."""
    missing: Missing = "error"
    elevation: Number = None
    """Degrees above the horizon. Default: 15; 0 with --look-around."""
    azimuth: float = 0.0
    """Degrees of the first view: 0 from the front, 90 from the subject's right-hand side in that view."""
    distance: float = 1.0
    """Multiple of the distance from which the subject just fits the image."""
    look_at: Point = None
    """Point to look at and to circle, in the coordinates of the file. Default: the middle of the subject."""
    fov: Number = None
    """Field of view across the shorter side of the image, degrees. Default: 45; 75 with --look-around."""
    focal_length: Number = None
    """Focal length in mm on 35 mm film, whose 36 mm span the image width: 50 is normal, 85 for portraits, 24
    wide. In place of --fov."""
    up: Text = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the cameras in a model
    folder, of the file, else -y, as in COLMAP's scenes."""
    width: Count = None
    """Image width in pixels. With --cameras or --data, images are scaled to this width."""
    height: Count = None
    """Image height in pixels. Default: the width. Not with --cameras or --data."""

    @property
    def moving(self) -> bool:
        """Whether the views make a turntable."""
        return self.cameras is None and self.data is None and self.dome is None

    @property
    def _placed(self) -> bool:
        """Whether an option says where cameras stand or what lens they have."""
        placing = ("orbit", "dome", "elevation", "azimuth", "distance", "look_at", "fov", "focal_length")
        defaults = {f.name: f.default for f in fields(self)}
        return any(getattr(self, name) != defaults[name] for name in placing)

    def photographs(self, origin: np.ndarray) -> Dataset | None:
        """The data set of --data, relative to ``origin``, or None."""
        if self.data is None:
            return None
        from meshsplats.datasets.folder import load_dataset

        return load_dataset(self.data, downscale=self.downscale, missing=self.missing, origin=origin)

    def make(
        self,
        scene: GaussianCloud | SplatMesh,
        source: Path,
        *,
        count: int,
        side: int,
        photographs: Dataset | None = None,
    ) -> list[Camera]:
        """The cameras, relative to the origin of ``scene``; by default ``count`` views of an orbit, ``side``
        pixels wide. ``photographs``: the result of ``photographs()``, if it is at hand."""
        self.check()
        for name in ("width", "height"):
            value = getattr(self, name)
            if value is not None and not 1 <= value <= MAX_SIDE:
                raise ValueError(f"--{name} must be a number of pixels from 1 to {MAX_SIDE}, got {value}")
        if self.cameras is not None or self.data is not None:
            if self.data is not None:
                dataset = photographs or self.photographs(scene.origin)
                assert dataset is not None
                cameras = [view.camera for view in dataset.test or dataset.views]
            else:
                assert self.cameras is not None
                cameras = load_cameras(self.cameras, origin=scene.origin)
            return cameras if self.width is None else [c.scaled(self.width / c.width) for c in cameras]
        width = next(v for v in (self.width, self.height, side) if v is not None)
        lens: dict[str, Any] = {"width": width, "height": width if self.height is None else self.height}
        beside = None if self.up is not None else cameras_beside(source, scene.origin)
        lens["up"] = guess_up(scene, beside) if self.up is None else parse_up(self.up)
        fov = self.fov
        if self.focal_length is not None:
            if not 1 <= self.focal_length <= 2000:
                raise ValueError(f"--focal-length must lie between 1 and 2000 mm, got {self.focal_length}")
            shorter = 36 * min(1.0, lens["height"] / lens["width"])
            fov = float(np.degrees(2 * np.arctan(shorter / (2 * self.focal_length))))
        if self.look_around is not None:
            lens["elevation"] = 0.0 if self.elevation is None else self.elevation
            lens["fov"] = 75.0 if fov is None else fov
            return look_around(scene, self.look_around, azimuth=self.azimuth, **lens)
        if not self._placed and cameras_beside(source, scene.origin) is None:
            told = None if self.up is None else lens["up"]
            if views := views_of_a_place(scene, count, lens | {"up": told}):
                return views
        lens["fov"] = 45.0 if fov is None else fov
        target = None if self.look_at is None else np.subtract(self.look_at, scene.origin)
        lens |= {"distance": self.distance, "target": target}
        if self.dome is not None:
            return dome(scene, self.dome, **lens)
        lens["elevation"] = 15.0 if self.elevation is None else self.elevation
        return orbit(scene, count if self.orbit is None else self.orbit, azimuth=self.azimuth, **lens)

    def check(self) -> None:
        """UsageError for options that exclude each other or have no effect."""
        if self.downscale != 1 and (self.data is None or self.width is not None):
            raise UsageError(
                "--downscale has no effect without --data"
                if self.data is None
                else "give --downscale or --width"
            )
        check_data(self.data, self.missing)
        modes = [
            name
            for name in ("orbit", "dome", "look_around", "cameras", "data")
            if getattr(self, name) is not None
        ]
        if len(modes) > 1:
            raise UsageError(f"give one of {', '.join(map(flag, modes))}, not several")
        if self.fov is not None and self.focal_length is not None:
            raise UsageError("give --fov or --focal-length, not both")
        placing = ("elevation", "azimuth", "distance", "look_at", "fov", "focal_length", "up", "height")
        without_effect = {
            "dome": ("elevation", "azimuth"),
            "look_around": ("distance", "look_at"),
            "cameras": placing,
            "data": placing,
        }
        for mode in modes:
            for name in without_effect.get(mode, ()):
                if getattr(self, name) != next(f.default for f in fields(self) if f.name == name):
                    raise UsageError(f"{flag(name)} has no effect with {flag(mode)}")


@dataclass(frozen=True)
class DrawOptions:
    """How images are rendered."""

    background: Text = None
    """Background: white, black, grey, #rrggbb, or r,g,b from 0 to 1. Default: white; with --data that of the
    model folder or of the photographs."""
    samples: Count = None
    """Side of the sample grid in each pixel: 2 means 2 x 2. Default: what the mesh needs at this size, 2 to
    8; 1 for splats, whose filter is as wide as a pixel. compare: of the mesh."""
    sh_degree: Count = None
    """Render splats with spherical harmonics up to this degree, 0 to 3. Default: all that are stored."""
    max_layers: Count = None
    """Blend only the nearest N triangles of a mesh at each sample, like N passes of depth peeling. Default:
    all."""
    order: Annotated[
        Literal["fragment", "splat"] | None,
        tyro.conf.arg(metavar="{fragment,splat}", help_behavior_hint=""),
    ] = None
    """Order in which the triangles of a mesh are blended: exact at every sample, or whole splats by their
    centres. Default: that of the mesh."""
    threads: Count = None
    """Maximum number of threads. Default: all processors."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Where meshes are rendered. gpu: by WebGPU, on any graphics card (extra gpu)."""

    def check_device(self) -> None:
        """Raises MissingDependencyError or DeviceError if there is no such device."""
        from meshsplats.rendering.devices import engine

        engine(self.device).check()


@dataclass(frozen=True)
class PartOptions:
    """Part of the scene."""

    crop: Box = None
    """Only splats with their centre in this box, in the coordinates of the file; 'info' prints its extent."""

    def of(self, scene: Scene) -> Scene:
        """That part of ``scene``."""
        from meshsplats.conversion.cleaning import cropped

        return cropped(scene, self.crop)


def open_tileset(path: Path, part: PartOptions, max_error: float | None) -> Tileset | None:
    """The tileset at ``path``, None if it is something else, for a command with --crop and --max-error.

    Raises UsageError for options without effect.
    """
    from meshsplats.tiles import is_tileset

    if not is_tileset(path):
        if max_error is not None:
            raise UsageError("--max-error is for tilesets")
        return None
    if max_error is not None and not 0 <= max_error < math.inf:
        raise UsageError(f"--max-error must be a number of pixels, at least 0, got {max_error}")
    if part.crop is not None:
        raise UsageError("--crop has no effect on a tileset: give it to 'meshsplats tiles'")
    from meshsplats.tiles.tileset import Tileset

    return Tileset(path)


@dataclass(frozen=True)
class ClusterOptions:
    """Where the tasks of the command run."""

    cluster: Annotated[str | None, tyro.conf.arg(metavar="{local,ADDRESS}", help_behavior_hint="")] = None
    """Run tasks side by side: local, in processes on this machine; or on the Dask cluster at tcp://HOST:PORT,
    whose workers have the same files at the same paths (extra cluster). --threads is then the maximum of a
    task, by default 1."""

    @contextmanager
    def workers(self, threads: int | None) -> Iterator[Workers]:
        """The workers, for the length of the block; ``threads``: maximum number of threads."""
        with open_workers(self.cluster, threads) as found:
            if self.cluster is not None:
                say(f"cluster: {found}")
            yield found


def placed(scene: Placed, origin: Origin) -> Placed:
    """``scene`` as --origin wants it written: with its origin, or without any. UsageError for a point that is
    too far away for float32."""
    if origin == "keep":
        return scene
    if origin != "local":
        scene = scene.relative_to(origin)
        places = scene.means if isinstance(scene, GaussianCloud) else scene.vertices
        if lost := lost_detail(sampled(places)):
            raise UsageError(f"--origin: too far from the scene; relative to that point, {lost}")
    return replace(scene, origin=np.zeros(3))


def written(scene: Placed, origin: Origin) -> Placed:
    """``placed``; also says where the file will stand in the world."""
    say_origin(scene.origin, origin, splats=isinstance(scene, GaussianCloud))
    return placed(scene, origin)


def say_origin(found: np.ndarray, origin: Origin, *, splats: bool = False) -> None:
    """Says where the output of a scene with the origin ``found`` stands in the world, and what a file of
    ``splats`` does not tell other programs."""
    if origin == "keep" and found.any():
        splats_only = ", in a note of the file: other programs see the splats of .ply and .sog around 0 0 0"
        say(f"origin: {in_words(found)}" + (splats_only if splats else "; --origin local leaves it out"))
    elif origin == "local" and found.any():
        say(f"origin: left out; coordinates are relative to {in_words(found)}")
    elif not isinstance(origin, str):
        say(f"origin: coordinates are relative to {in_words(np.array(origin))}")


def load_scene(path: Path, reading: SplatOptions, *, up: str | None = None) -> GaussianCloud | SplatMesh:
    """The splats or the mesh at ``path``; ``up`` as for ``SplatOptions.load``."""
    kind = identify(path)
    if kind == "cameras":
        raise FileFormatError(f"{path}: a JSON file; expected splats or a mesh (--cameras takes cameras)")
    if kind == "splats":
        return reading.load(path, up=up)
    reading.refuse_for(path)
    from meshsplats.formats.meshes import load_mesh

    mesh = load_mesh(path)
    warn_of_strays_in(mesh)
    return mesh


def views_of_a_place(
    scene: GaussianCloud | SplatMesh, count: int, lens: dict[str, Any]
) -> list[Camera] | None:
    """``count`` views of splats that are no object, as ``find_cameras`` finds them; says what was found.
    ``lens``: width, height, and up or None."""
    from meshsplats.rendering.layers import fragments
    from meshsplats.rendering.previews import FRAGMENTS, preview_camera
    from meshsplats.viewpoints.finding import find_cameras

    if not isinstance(scene, GaussianCloud) or not len(scene):
        return None
    if fragments(scene, preview_camera(scene), 1) > FRAGMENTS:
        return None  # splats as large as the scene: there is nothing to find, and it would take long
    found = find_cameras(scene, count, **lens)
    if found.kind == "object":
        return None
    say(f"{found.in_words()}: seen from views that were found")
    return list(found.cameras)


def optional_color(text: str | None) -> tuple[float, float, float] | None:
    """``parse_color`` of an option that may not be given."""
    return None if text is None else parse_color(text)


def check_data(data: Path | None, missing: Missing, cameras: Path | None = None) -> None:
    """UsageError for --missing without --data, and for --cameras with it."""
    if cameras is not None and data is not None:
        raise UsageError("give --cameras or --data, not both")
    if missing != "error" and data is None:
        raise UsageError("--missing has no effect without --data")


def check_mesh_suffix(path: Path) -> None:
    """Raises UsageError if no mesh can be written under this name."""
    from meshsplats.formats.meshes import MESH_SUFFIXES

    if path.suffix.lower() not in MESH_SUFFIXES:
        raise UsageError(f"-o must end in {', '.join(MESH_SUFFIXES)}, got {path.name!r}")


def check_splat_endings(*kinds: str) -> None:
    """Raises UsageError if no splats can be written to files that end in ``kinds``, without a dot."""
    for kind in kinds:
        if f".{kind}" not in written_suffixes():
            raise UsageError(f"splats are written as {listed(written_suffixes())}, not as .{kind}")


@contextmanager
def warnings_kept() -> Iterator[list[str]]:
    """The warnings of the block, for JSON; they are printed as well."""
    kept: list[str] = []
    show = warnings.showwarning

    def keep(message: Warning | str, *rest: Any, **more: Any) -> None:
        kept.append(one_line(message))
        show(message, *rest, **more)

    warnings.showwarning = keep
    try:
        yield kept
    finally:
        warnings.showwarning = show


def track(items: Iterable[T], label: str, total: int) -> Iterable[T]:
    """``items`` with a progress bar on stderr, where that is a terminal."""
    if not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import track as progress

    yield from progress(items, label, total, console=Console(stderr=True), transient=True)


def plural(count: int, noun: str) -> str:
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def draw_preview(
    scene: SplatMesh | GaussianCloud, path: Path, camera: Camera | None = None, **how: Any
) -> None:
    """Saves a preview (``save_preview``), or says why there is none."""
    from meshsplats.rendering.layers import layers
    from meshsplats.rendering.previews import preview_camera, save_preview

    if not save_preview(scene, path, camera, **how):
        count = layers(scene, camera or preview_camera(scene))
        say(f"no preview: about {count:,.0f} layers would lie over each other at each of its pixels")


LONG_SECONDS = 10
"""Images that take longer than this, as far as can be estimated, are announced."""


def announce_cost(
    scene: SplatMesh | GaussianCloud, cameras: Sequence[Camera], samples: int, threads: int | None
) -> None:
    """Says before the work how long images may take, where layers upon layers make it long."""
    from meshsplats.rendering.layers import MANY_LAYERS, estimated_seconds, layers

    count = layers(scene, cameras[0])
    if (
        count > MANY_LAYERS
        and (seconds := estimated_seconds(scene, cameras, samples, threads)) > LONG_SECONDS
    ):
        long = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
        say(f"about {count:,.0f} layers lie over each other at each pixel: this may take about {long}")


def alpha_record(choice: AlphaChoice | None) -> dict[str, Any] | None:
    """A choice of the alpha mode for JSON; None where there was none."""
    return None if choice is None else asdict(choice)


def alpha_in_words(record: Mapping[str, Any] | None) -> str | None:
    """The line about a choice of the alpha mode, from its record; None where nothing was measured."""
    if record is None or record["blend"] is None:
        return None
    modes = {"blend": "blend", "mask": f"mask with cutoff {record['cutoff']:g}"}
    taken = record["alpha"]
    other = "mask" if taken == "blend" else "blend"
    sorting = "" if taken == "blend" else " (--alpha blend for ray tracers and Blender's own importer)"
    return (
        f"alpha: {modes[taken]}, {record[taken]:.1f} dB from the sorted image in viewers that do not sort;"
        f" {modes[other]}: {record[other]:.1f} dB{sorting}"
    )


def size_of(path: Path) -> str:
    """Size of a file in words: 3.2 MB."""
    from meshsplats._files.atomic import in_words

    return in_words(path.stat().st_size)


def view_names(count: int, prefix: str = "view", suffix: str = ".png") -> Sequence[str]:
    """File names of ``count`` views, numbered for video tools; names from camera files never become paths."""
    return [f"{prefix}_{i:04d}{suffix}" for i in range(count)]
