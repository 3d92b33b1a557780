"""Splat files in blocks, for scenes that are larger than memory."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.arrays import checked_array
from meshsplats._common.kinds import described, need_path, require_path
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats.opened import Splats
from meshsplats.formats.opening import open_splats, to_y_down
from meshsplats.formats.ply.activated import Activated
from meshsplats.formats.reading import Axes, Reading
from meshsplats.formats.sniff import archives_of_splats, content_of, identify, splat_format
from meshsplats.formats.splat_formats import splat_suffixes
from meshsplats.formats.splat_paths import files_named, splat_file
from meshsplats.scene.gaussians import GaussianCloud, Kernel, shared_up
from meshsplats.scene.origin import choose_origin, need_detail


class SplatStream:
    """The splats of files in blocks of about ``block`` splats, in the order of the files.

    Each iteration reads the files anew, and memory does not grow with them. SOG, SPZ in a zip archive, and
    glTF are exceptions: images are unpacked as a whole (24 bytes a splat; one part at a time of a streamed
    scene), and a glTF file is read before it is cut into blocks. Blocks of one file have the same degree and
    kernel.

    Concretely, the blocks of a file together are ``load_gaussians`` of it, to the last bit. Blocks of several
    files have one origin, which suits all of them.
    """

    def __init__(
        self,
        paths: Sequence[str | os.PathLike[str]],
        *,
        block: int = 1 << 16,
        strict: bool = False,
        axes: Axes = "auto",
        kernel: Kernel | None = None,
        time: float | None = None,
        activated: Iterable[Activated] = (),
        origin: Sequence[float] | np.ndarray | None = None,
    ) -> None:
        self._reading = Reading.checked(axes, kernel, time, activated, in_blocks=True)
        if isinstance(paths, (str, os.PathLike)):
            what = described(paths)
            raise TypeError(f"paths must be a list of paths, got {what}: stream_gaussians(path) opens one")
        for i, path in enumerate(paths):
            require_path(f"paths[{i}]", path)
        if isinstance(block, bool) or not isinstance(block, (int, np.integer)) or block < 1:
            raise ValueError(f"block must be a number of splats, at least 1, got {block!r}")
        self.paths = tuple(Path(path) for path in paths)
        """The files, in their order."""
        self.block, self.strict, self.axes = int(block), strict, axes
        self._given_origin = None if origin is None else checked_array("origin", origin, np.float64, (3,))
        self.count = 0
        """Splats that the last iteration has given so far."""
        self._found_up: np.ndarray | None = None
        self._told: set[Path] = set()
        """Files that have been read to their end, and whose warnings have come."""

    @cached_property
    def origin(self) -> np.ndarray:
        """(3,) float64 origin of all blocks. The files are looked at when it is first needed. Raises
        ValueError where one of several would lose its detail relative to it."""
        origin = self._given_origin
        if len(self.paths) == 1:
            return self._looked_at(self.paths[0], alone=True) if origin is None else origin
        samples = self.world_samples
        if origin is None:
            origin = choose_origin(np.concatenate([np.empty((0, 3)), *samples.values()]))
        need_detail(samples, origin)
        return origin

    @cached_property
    def world_samples(self) -> dict[Path, np.ndarray]:
        """A sample (k, 3) float64 of the positions in the world of each file, with y down."""
        return {path: self._looked_at(path, alone=False) for path in self.paths}

    def __iter__(self) -> Iterator[GaussianCloud]:
        self.count = 0
        for path in self.paths:
            blocks = self._of(path)
            for block in _quietly(blocks) if path in self._told else blocks:
                self.count += len(block)
                yield block
            self._told.add(path)

    @contextmanager
    def _opened(self, path: Path) -> Iterator[tuple[Splats, np.ndarray]]:
        """The splats of a file, and (3, 3) from its axes to y down."""
        with content_of(path) as content:
            kind = splat_format(content)
            with content.open() as file, closing(open_splats(content, kind, file, self._reading)) as splats:
                yield splats, to_y_down(kind, self.axes, splats.to_y_down)

    @property
    def from_file_axes(self) -> np.ndarray:
        """(3, 3) float64 from the axes of the (first) file to those of the blocks."""
        with self._opened(self.paths[0]) as (_, turn):
            return turn

    def _looked_at(self, path: Path, *, alone: bool) -> np.ndarray:
        """(3,) the origin of the file ``path`` by itself if it is ``alone``, else a sample (k, 3) of its
        positions in the world; with y down."""
        with ExitStack() as opened:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # those of the file come when it is read
                splats, turn = opened.enter_context(self._opened(path))
            found = splats.chosen_origin() if alone else splats.world_sample()
        return found @ turn.T + 0.0

    def _of(self, path: Path) -> Iterator[GaussianCloud]:
        origin = self.origin
        with self._opened(path) as (splats, turn):
            own = turn.T @ origin
            for block in splats.blocks(self.block, strict=self.strict, origin=own):
                finished = self._reading.finished(block, splats)
                if len(finished):
                    finished = finished.transformed(turn)
                    yield finished if self._found_up is None else replace(finished, up=self._found_up)

    @property
    def reading(self) -> list[Any]:
        """What the splats depend on besides the files, for JSON: ``axes``, ``strict``, and what is given of
        ``kernel``, ``time`` and ``activated``."""
        changed = self._reading.record
        return [self.axes, self.strict, *([changed] if changed else [])]

    @cached_property
    def up(self) -> np.ndarray | None:
        """(3,) unit direction that points up, where all of the files say so, and the same."""
        return shared_up([self._up(path) for path in self.paths])

    def use_found(self, up: np.ndarray) -> None:
        """Gives ``up``, a (3,) unit direction, to all blocks: the files name none, and the splats show it."""
        self.up = self._found_up = up

    def _up(self, path: Path) -> np.ndarray | None:
        with content_of(path) as content:
            kind = splat_format(content)
            up = kind.reader.up(content)
        if up is None:
            return None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # those of the file come when it is read
            with self._opened(path) as (_, turn):
                return np.asarray(turn @ up)


def stream_gaussians(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    block: int = 1 << 16,
    strict: bool = False,
    axes: Axes = "auto",
    kernel: Kernel | None = None,
    time: float | None = None,
    activated: Iterable[Activated] = (),
    origin: Sequence[float] | np.ndarray | None = None,
) -> SplatStream:
    """Splats of files that are larger than memory, in blocks.

    Args:
        path: a file or folder as for ``load_gaussians``; several of them; or a folder of splat files, which
            are read in the order of their names; meshes among them are left out.
        block: about this many splats at a time.
        strict, axes, kernel, time, activated, origin: as for ``load_gaussians``; one origin for all files.

    Returns:
        A stream of clouds, which can be iterated over several times. Errors and warnings of
        ``load_gaussians`` come while it is read, warnings the first time.

    Raises:
        FileNotFoundError: there is no such file.
        FileFormatError: a folder without splats.
        ValueError, when the stream is used: files so far apart that the coordinates of one would lose detail.
    """
    if isinstance(path, (str, os.PathLike)) or not isinstance(path, Sequence):
        need_path(path=path)
        path = [path]
    given = list(path)
    for i, one in enumerate(given):
        require_path(f"path[{i}]", one)
    if not given:
        raise ValueError("name at least one splat file")
    files = [file for one in given for file in _splat_files(Path(one))]
    return SplatStream(
        files,
        block=block,
        strict=strict,
        axes=axes,
        kernel=kernel,
        time=time,
        activated=activated,
        origin=origin,
    )


def _quietly(blocks: Iterator[GaussianCloud]) -> Iterator[GaussianCloud]:
    """``blocks`` without the warnings of reading them."""
    while True:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            block = next(blocks, None)
        if block is None:
            return
        yield block


def _splat_files(path: Path) -> list[Path]:
    """The file of a model or the splat files of a folder, by name."""
    try:
        return [splat_file(path)]
    except FileFormatError:
        if not path.is_dir():
            raise
        found = [part for part in files_named(path, splat_suffixes()) if not _is_mesh(part)]
        found = sorted([*found, *archives_of_splats(path)])
        if not found:
            raise
        return found


def _is_mesh(path: Path) -> bool:
    try:
        return identify(path) == "mesh"
    except FileFormatError:  # broken, or a download that failed: its reader says so
        return False
