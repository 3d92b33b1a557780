"""Chains of levels of detail for Blender: the folder that ``meshsplats levels`` writes, and meshes read from
it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from meshsplats._common.json_files import read_json
from meshsplats.errors import FileFormatError
from meshsplats.scene.mesh import SplatMesh

TABLE = "levels.json"


@dataclass(frozen=True)
class LevelFile:
    """One level of a chain."""

    path: Path
    screen_size: int
    """Side in pixels of images that just hold the subject, for which the mesh was made."""


@dataclass(frozen=True)
class Chain:
    """The files of a chain, the finest level first."""

    name: str
    levels: tuple[LevelFile, ...]


@dataclass(frozen=True, eq=False)
class LevelMeshes:
    """The meshes of a chain, the finest first."""

    name: str
    meshes: Sequence[SplatMesh]
    screen_sizes: Sequence[int]
    """Pixels, as in ``LevelFile``; one per mesh."""

    def __post_init__(self) -> None:
        if not self.meshes or len(self.meshes) != len(self.screen_sizes):
            raise ValueError(
                "a chain needs at least one mesh and a screen size for each, got"
                f" {len(self.meshes)} meshes and {len(self.screen_sizes)} screen sizes"
            )


def is_chain(path: Path) -> bool:
    """Whether ``path`` is the levels.json of a chain or its folder."""
    return (path / TABLE).is_file() if path.is_dir() else path.name == TABLE


def read_chain(path: Path) -> Chain:
    """The chain at ``path``, its levels.json or its folder; it is named after the folder.

    Raises:
        FileFormatError: a table without levels, file names or sizes.
        FileNotFoundError: the table or a mesh is missing.
    """
    table = path / TABLE if path.is_dir() else path
    folder = table.parent
    content = read_json(table)
    rows = content.get("levels") if isinstance(content, dict) else None
    if not isinstance(rows, list) or not rows:
        raise FileFormatError(f"{table}: expected a table of levels, as `meshsplats levels` writes it")
    levels = tuple(_level(row, index, table) for index, row in enumerate(rows))
    for level in levels:
        if not level.path.is_file():
            raise FileNotFoundError(f"{level.path}: named in {table.name}, but missing")
    return Chain(folder.absolute().name or "Splats", levels)


def _level(row: Any, index: int, table: Path) -> LevelFile:
    file, size = (row.get("file"), row.get("screen_size")) if isinstance(row, dict) else (None, None)
    if not isinstance(file, str) or Path(file).name != file:
        raise FileFormatError(f"{table}: level {index}: expected the name of a file beside it, got {file!r}")
    if not isinstance(size, int) or isinstance(size, bool) or size < 1:
        raise FileFormatError(f"{table}: level {index}: screen_size must be a number of pixels, got {size!r}")
    return LevelFile(table.parent / file, size)
