"""Tilesets: a scene of any size as an octree of meshes, each for one distance."""

from __future__ import annotations

from pathlib import Path

NAME = "tileset.json"


def is_tileset(path: Path) -> bool:
    """Whether ``path`` is a folder with a tileset.json, or that file."""
    return path.joinpath(NAME).is_file() if path.is_dir() else path.name == NAME
