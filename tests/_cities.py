"""A small city as a splat file, its tiles, and the contents of a folder."""

from __future__ import annotations

import hashlib
from pathlib import Path

from meshsplats import save_gaussian_blocks
from meshsplats.demo_scene.city import city_blocks
from meshsplats.tiles.options import TileOptions

COUNT = 12_000
SMALL = TileOptions(max_triangles=4096)


def write_city(folder: Path) -> Path:
    """The splat file, in ``folder``."""
    path = folder / "city.ply"
    save_gaussian_blocks(city_blocks(COUNT, degree=0), path, COUNT)
    return path


def digest(folder: Path) -> dict[str, str]:
    """Hashes of all files by their path in ``folder``."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
