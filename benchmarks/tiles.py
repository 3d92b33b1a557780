"""Tilesets of cities: processor time for a million splats, and the memory that tiling and drawing take.

    python benchmarks/tiles.py --folder FOLDER [--count 1000000] [--degree 0] [--keep]

Writes a city of splats and its tileset into FOLDER, draws the tileset from afar and from near, each step in a
process of its own. FOLDER needs 400 bytes a splat.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from _common import Report, arguments, run

CITY = "from meshsplats.demo_scene.city import main; main({arguments!r})"
TILES = """
import meshsplats
from meshsplats.tiles.building import build_tiles
made = build_tiles(meshsplats.stream_gaussians({splats!r}), {tileset!r}, replace_old=True)
print(f"{{made.tiles}} tiles on {{made.levels}} levels, {{made.bytes / 1e6:.0f}} MB")
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


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--degree", type=int, default=0, choices=(0, 1, 2, 3))
    parser.add_argument("--keep", action="store_true", help="keep the splats and the tileset")
    args = parser.parse_args()
    name = f"city_{args.count}_{args.degree}"
    splats, tileset = args.folder / f"{name}.ply", args.folder / name
    steps = {
        "city": CITY.format(arguments=[str(splats), str(args.count), str(args.degree)]),
        "tiles": TILES.format(splats=str(splats), tileset=str(tileset)),
    }
    for view, distance in (("far", 1.0), ("near", 0.1)):
        image = args.folder / f"{name}_{view}.png"
        steps[view] = DRAW.format(tileset=str(tileset), distance=distance, image=str(image))
    with Report(args) as report:
        report.table("step", "splats", "processor s", "s a million", "elapsed s", "MB", "")
        for step, code in steps.items():
            used = run([sys.executable, "-c", code])
            report.row(
                *(step, f"{args.count:,}", f"{used.processor:.1f}"),
                *(f"{used.processor / args.count * 1e6:.2f}", f"{used.wall:.1f}", f"{used.memory / 1e6:.0f}"),
                "" if step == "city" else used.output.strip(),
            )
    if not args.keep:
        splats.unlink()
        shutil.rmtree(tileset)


if __name__ == "__main__":
    main()
