"""Shared by the commands: groups of options, where outputs stand, tables and previews."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import tyro

from meshsplats._files import atomic
from meshsplats.cli import option
from meshsplats.cli.arguments import as_cli_options
from meshsplats.cli.messages import Terminated, flag, one_line, say, with_flags
from meshsplats.datasets.scene_files import PartOfScene, SceneReading
from meshsplats.errors import ClusterError
from meshsplats.formats.outputs import Scene, placed

if TYPE_CHECKING:
    import numpy as np

    from meshsplats.cluster import Workers
    from meshsplats.scene.camera import Camera
    from meshsplats.scene.gaussians import GaussianCloud
    from meshsplats.scene.mesh import SplatMesh

T = TypeVar("T")


@as_cli_options(presets=False)
class SplatOptions(SceneReading):
    """How splat files are read."""

    def tell(self, text: str) -> None:
        say(with_flags(text))

    def again(self) -> list[str]:
        """The words with which another command reads the file in the same way."""
        words = [str(word) for word in again(self, axes="auto", kernel="auto")]
        words += ["--time", f"{self.time:g}"] if self.time is not None else []
        return words + (["--set", f"activated={','.join(self.activated)}"] if self.activated else [])


@as_cli_options(presets=False)
class PartOptions(PartOfScene):
    """Part of the scene."""


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
        from meshsplats.cluster import open_workers

        with open_workers(self.cluster, threads) as found:
            if self.cluster is not None:
                say(f"cluster: {found}")
            yield found


def written(scene: Scene, origin: option.Origin) -> Scene:
    """``placed``; also says where the file will stand in the world."""
    from meshsplats.scene.gaussians import GaussianCloud

    say_origin(scene.origin, origin, splats=isinstance(scene, GaussianCloud))
    return placed(scene, origin)


def say_origin(found: np.ndarray, origin: option.Origin, *, splats: bool = False) -> None:
    """Says where the output of a scene with the origin ``found`` stands in the world, and what a file of
    ``splats`` does not tell other programs."""
    from meshsplats.scene.origin import in_words

    if origin == "keep" and found.any():
        splats_only = ", in a note of the file: other programs see the splats of .ply and .sog around 0 0 0"
        say(f"origin: {in_words(found)}" + (splats_only if splats else "; --origin local leaves it out"))
    elif origin == "local" and found.any():
        say(f"origin: left out; coordinates are relative to {in_words(found)}")
    elif not isinstance(origin, str):
        say(f"origin: coordinates are relative to {in_words(origin)}")


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


@contextmanager
def resumable(record: Path, *, force: bool) -> Iterator[None]:
    """Says how to go on if the block is ended early and unfinished work with its ``record`` is left."""
    try:
        yield
    except (KeyboardInterrupt, Terminated, OSError, ClusterError) as error:
        if record.is_file() and not isinstance(error, FileExistsError):  # which says what to do itself
            how = "--resume in place of --force" if force else "--resume"
            say(f"finished work is kept: run the same command with {how} to continue")
        raise


def track(items: Iterable[T], total: int, label: str) -> Iterable[T]:
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
        table.add_row(*map(with_flags, row))
    Console(markup=False, emoji=False).print(table)  # names may have brackets and colons


def draw_preview(
    scene: SplatMesh | GaussianCloud, path: Path, camera: Camera | None = None, **how: Any
) -> None:
    """Saves a preview (``save_preview``), or says why there is none."""
    from meshsplats.rendering.layers import layers
    from meshsplats.rendering.previews import save_preview
    from meshsplats.viewpoints.opening import opening_camera

    camera = camera or opening_camera(scene, how.get("threads"))
    if not save_preview(scene, path, camera, **how):
        count = layers(scene, camera)
        say(f"no preview: about {count:,.0f} layers overlap at each pixel, too slow to render")


def named(path: Path) -> str:
    """A file with its size, a folder with a slash."""
    return f"{path} ({size_of(path)})" if path.is_file() else f"{path}/"


def size_of(path: Path) -> str:
    """Size of a file in words: 3.2 MB."""
    return atomic.in_words(path.stat().st_size)
