"""Tilesets: a scene of any size as an octree of meshes, each for one distance."""

from __future__ import annotations

from pathlib import Path

from meshsplats.errors import FileFormatError

NAME = "tileset.json"


def is_tileset(path: Path) -> bool:
    """Whether ``path`` is a folder with a tileset.json, or that file, and no tileset of splats."""
    from meshsplats.formats.gltf.splat_tilesets import holds_splats

    file = path / NAME if path.is_dir() else path
    if file.name != NAME or (file != path and not file.is_file()):
        return False
    try:
        return not holds_splats(file)
    except (FileFormatError, OSError):
        return True  # opening it says what is wrong
