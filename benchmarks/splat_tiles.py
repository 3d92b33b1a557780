"""Tilesets of splats: sizes, times, what a round trip loses, and whether CesiumJS shows the same image.

    python benchmarks/splat_tiles.py --data DATA --node NODE_FOLDER
    python benchmarks/splat_tiles.py SPLATS ... --max-triangles 20000

NODE_FOLDER: where 'npm install cesium puppeteer-core' was run; CHROMIUM names the browser. Loss: PSNR of the
finest tiles, read back, against the float splats in images of 400 pixels, three from around the scene, on
white. CesiumJS: PSNR of its image at a screen-space error of half a pixel against 'render_splats' of the
float splats by the same camera and with its low-pass filter, 480 x 360 pixels without the rows of its logo.
Times are processor seconds.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _common import SCENES, Report, arguments, run

import meshsplats as ms
from meshsplats.formats._orientation import tile_frame
from meshsplats.images.reading import load_image

SCRIPT = Path(__file__).with_name("viewers") / "cesium.mjs"
WIDTH, HEIGHT, LOGO = 480, 360, 40
"""Of the script's images; the logo covers rows at the bottom."""
DILATION = 0.019
"""Square pixels by which CesiumJS 1.145 widens splats: 0.3, in a unit of a quarter of a pixel."""


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("splats", nargs="*", type=Path, help="files; by default the scenes of DATA")
    parser.add_argument("--node", type=Path, help="folder with CesiumJS")
    parser.add_argument("--max-triangles", type=int, default=20_000)
    options = parser.parse_args()
    scenes = {path.stem: path for path in options.splats}
    scenes = scenes or {name: options.data / "splats" / scene.splats for name, scene in SCENES.items()}
    with Report(options) as report, tempfile.TemporaryDirectory() as folder:
        report.table(
            "scene", "splats", "tiles", "bytes a splat", "s", "dB", "CesiumJS: splats", "failed", "dB"
        )
        for name, path in scenes.items():
            report.row(name, *row(path, Path(folder) / name, options.max_triangles, options.node))


def row(path: Path, tileset: Path, most: int, node: Path | None) -> list[str]:
    cloud = ms.load_gaussians(path)
    words = ["tiles", path, "-o", tileset, "--as-splats", "--max-triangles", most, "--json"]
    used = run([sys.executable, "-W", "ignore", "-m", "meshsplats", *map(str, words)])
    size = sum(file.stat().st_size for file in tileset.rglob("*") if file.is_file())
    count = sum(1 for _ in tileset.rglob("*.glb"))
    back = ms.load_gaussians(tileset)
    views = ms.orbit(cloud, 3, elevation=20, width=400, height=400)
    errors = [
        np.mean((ms.render_splats(cloud, view).color - ms.render_splats(back, view).color) ** 2)
        for view in views
    ]
    cells = [
        f"{len(back):,}",
        f"{count}",
        f"{size / len(back):.1f}",
        f"{used.processor:.1f}",
        decibels(errors),
    ]
    if node is None:
        return [*cells, "", "", ""]
    image = tileset.with_suffix(".png")
    words = ["node", str(SCRIPT), str(tileset), str(image), "0.5"]
    done = subprocess.run(words, cwd=node, capture_output=True, text=True, check=True, env=os.environ)
    shown = json.loads(done.stdout)
    error = difference(cloud, shown, image)
    return [*cells, f"{shown['splats']:,}", f"{len(shown['failures'])}", decibels([error])]


def difference(cloud: ms.GaussianCloud, shown: dict[str, Any], image: Path) -> float:
    """Mean squared difference of the ``image`` of CesiumJS and ours."""
    view = np.array(shown["view"]).reshape(4, 4).T
    up = np.array([0.0, -1, 0]) if cloud.up is None else cloud.up
    to_tileset = np.eye(4)
    to_tileset[:3, :3] = tile_frame(up)
    matrix = np.diag([1.0, -1, -1, 1]) @ view @ to_tileset
    focal = HEIGHT / 2 / np.tan(shown["fovy"] / 2)
    camera = ms.Camera(matrix, focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    ours = ms.render_splats(cloud, camera, dilation=DILATION).color[:-LOGO]
    theirs = load_image(image)[:-LOGO, :, :3] / 255.0
    return float(np.mean((ours - theirs) ** 2))


def decibels(errors: list[float]) -> str:
    return f"{-10 * np.log10(float(np.mean(errors))):.1f}"


if __name__ == "__main__":
    main()
