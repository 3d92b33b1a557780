"""Shared by the commands: input by content, output that is not overwritten, cameras and rendering options."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
import tyro

from meshsplats._options import changed
from meshsplats._origin import in_words, lost_detail, sampled
from meshsplats._words import direction_in_words
from meshsplats._words import parse_color as parse_color
from meshsplats._words import parse_up as parse_up
from meshsplats.base_mesh import BaseMesh
from meshsplats.camera import Camera
from meshsplats.cameras.framing import warn_of_strays_in
from meshsplats.cli import option
from meshsplats.cli.arguments import spelled
from meshsplats.cli.messages import UsageError, flag, one_line, say, shown_path
from meshsplats.cluster import Workers, open_workers
from meshsplats.errors import FileFormatError
from meshsplats.formats.mesh_formats import mesh_format_to_write, written_mesh_suffixes
from meshsplats.formats.sniff import identify
from meshsplats.formats.splat_formats import listed, written_suffixes, y_up_suffixes
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    from meshsplats.formats.streaming import SplatStream
    from meshsplats.tiles.tileset import Tileset

T = TypeVar("T")
Scene = TypeVar("Scene", GaussianCloud, SplatMesh, GaussianCloud | SplatMesh)
Placed = TypeVar("Placed", GaussianCloud, SplatMesh, BaseMesh, GaussianCloud | SplatMesh)
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
    time: option.Number = None
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
        given = [name for name in ("kernel", "time", "activated") if name in changed(self)]
        if given:
            flags = ", ".join(spelled(type(self), name) for name in given)
            raise UsageError(f"{shown_path(path)} holds no splats: {flags} would have no effect")

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
class PartOptions:
    """Part of the scene."""

    crop: option.Box = None
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


def placed(scene: Placed, origin: option.Origin) -> Placed:
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


def written(scene: Placed, origin: option.Origin) -> Placed:
    """``placed``; also says where the file will stand in the world."""
    say_origin(scene.origin, origin, splats=isinstance(scene, GaussianCloud))
    return placed(scene, origin)


def say_origin(found: np.ndarray, origin: option.Origin, *, splats: bool = False) -> None:
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


def optional_color(text: str | None) -> tuple[float, float, float] | None:
    """``parse_color`` of an option that may not be given."""
    return None if text is None else parse_color(text)


def optional_up(text: str | None) -> np.ndarray | None:
    """``parse_up`` of an option that may not be given."""
    return None if text is None else parse_up(text)


def check_data(
    data: Path | None, missing: option.Missing, cameras: Path | None = None, masks: str = "count"
) -> None:
    """UsageError for --missing and --masks without --data, and for --cameras with it."""
    if cameras is not None and data is not None:
        raise UsageError("give --cameras or --data, not both")
    if missing != "few" and data is None:
        raise UsageError("--missing has no effect without --data")
    if masks != "count" and data is None:
        raise UsageError("--masks has no effect without --data")


def check_mesh_suffix(path: Path) -> None:
    """Raises UsageError if no mesh can be written under this name."""
    if mesh_format_to_write(path) is None:
        raise UsageError(f"-o must end in {', '.join(written_mesh_suffixes())}, got {path.name!r}")


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


def again(options: object, *names: str, **defaults: Any) -> list[Any]:
    """The words with which another command takes the same options: ``names``, where they are given, and those
    with ``defaults`` that have other values."""
    wanted = dict.fromkeys(names) | defaults
    values = {name: getattr(options, name) for name in wanted}
    changed = [name for name, default in wanted.items() if values[name] != default]
    return [word for name in changed for word in (flag(name), values[name])]


def print_table(heads: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> None:
    """A table without lines: ``left`` columns of text, and numbers."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for i, head in enumerate(heads):
        table.add_column(head, justify="left" if i < left else "right")
    for row in rows:
        table.add_row(*row)
    Console().print(table)


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
