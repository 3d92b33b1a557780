"""Tilesets of cities: processor time for a million splats, and the memory that tiling and drawing take.

    python benchmarks/tiles.py --folder FOLDER [--count 1000000] [--degree 0] [--keep]

Writes a city of splats and its tileset into FOLDER, draws the tileset from afar and from near, and prints a
line for each step: splats, processor seconds, seconds, greatest memory in use (MB). Each step is a process of
its own. FOLDER needs 400 bytes a splat.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

CITY = "from meshsplats.demo_scene.city import main; main({arguments!r})"
TILES = """
import meshsplats
from meshsplats.tiles.building import build_tiles
print(build_tiles(meshsplats.stream_gaussians({splats!r}), {tileset!r}, replace_old=True))
"""
DRAW = """
from meshsplats import orbit, save_image
from meshsplats.tiles.drawing import choose_tiles, render_tiles
from meshsplats.tiles.tileset import Tileset
tileset = Tileset({tileset!r})
camera = orbit(tileset.root.load(), 1, elevation=25, width=800, height=600, distance={distance})[0]
tiles, error = choose_tiles(tileset, [camera])
print(f"{{len(tiles)}} tiles, {{sum(tile.triangles for tile in tiles):,}} triangles, {{error:.2f}} pixels")
save_image({image!r}, render_tiles(tileset, camera, samples=2).color)
"""


def measure(name: str, code: str, count: int) -> None:
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-c", code])
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{name} failed")
    seconds = usage.ru_utime + usage.ru_stime
    print(
        f"{name:<10}{count:>12,}{seconds:>9.1f} s{seconds / count * 1e6:>9.2f} s/M"
        f"{time.perf_counter() - start:>9.1f} s elapsed{usage.ru_maxrss / 1024:>9.0f} MB",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--degree", type=int, default=0, choices=(0, 1, 2, 3))
    parser.add_argument("--keep", action="store_true", help="keep the splats and the tileset")
    args = parser.parse_args()
    name = f"city_{args.count}_{args.degree}"
    splats, tileset = args.folder / f"{name}.ply", args.folder / name
    arguments = [str(splats), str(args.count), str(args.degree)]
    measure("city", CITY.format(arguments=arguments), args.count)
    measure("tiles", TILES.format(splats=str(splats), tileset=str(tileset)), args.count)
    for view, distance in (("far", 1.0), ("near", 0.1)):
        image = args.folder / f"{name}_{view}.png"
        draw = DRAW.format(tileset=str(tileset), distance=distance, image=str(image))
        measure(view, draw, args.count)
    if not args.keep:
        splats.unlink()
        shutil.rmtree(tileset)


if __name__ == "__main__":
    main()
