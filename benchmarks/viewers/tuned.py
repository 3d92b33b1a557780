"""Whether the gain of fine-tuning arrives in a web viewer: PSNR of three.js, with sorted triangles, against
means over each pixel's area (the look 'area') at degree 0.

    npm install three puppeteer-core    (in some folder; Chromium installed)
    python benchmarks/viewers/tuned.py SPLATS TUNED --node-folder FOLDER [--sizes 400 800] [--views 4]

Images on white from an orbit at 20 degrees: with MSAA, which takes four samples of a pixel's coverage but one
of its colour; at twice the size, as for a screen with a pixel ratio of 2, and averaged; and by our own
renderer with 2 x 2 samples.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from pathlib import Path

import numpy as np
from _node import draw_jobs, drawn_images, job

sys.path.insert(0, str(Path(__file__).parents[1]))  # _common.py
from _common import Report, areas, arguments, images, mean_psnr

import meshsplats as ms


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", type=Path)
    parser.add_argument("tuned", type=Path, help="the fine-tuned mesh")
    parser.add_argument("--node-folder", type=Path, required=True, help="where node_modules lies")
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[400, 800], help="sides of the images, pixels"
    )
    parser.add_argument("--views", type=int, default=4)
    args = parser.parse_args()

    cloud = ms.load_gaussians(args.splats)
    meshes = {"converted": ms.convert(cloud), "tuned": ms.load_mesh(args.tuned)}
    reach = 3 * float(np.abs(meshes["converted"].vertices).max())
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        jobs, cameras = [], {}
        for name, mesh in meshes.items():
            ms.save_mesh(mesh, folder / f"{name}.glb")
        for side, ratio in itertools.product(args.sizes, (1, 2)):
            cameras[side] = ms.orbit(cloud, args.views, elevation=20, width=side, height=side)
            ms.save_cameras([c.scaled(ratio) for c in cameras[side]], folder / f"{side} {ratio}.json")
            for name in meshes:
                places = (
                    folder / f"{name}.glb",
                    folder / f"{side} {ratio}.json",
                    folder / f"{name} {side} {ratio}",
                )
                jobs.append(job("three", *places, reach, sorted=True, antialias=ratio == 1))
        program = draw_jobs(jobs, folder, args.node_folder)[0].partition("=")[2]
        with Report(args) as report:
            report.say(f"{args.splats.name}, dB")
            report.table("mesh", "side", f"{program}, MSAA", f"{program}, pixel ratio 2", "ours, 2 x 2")
            for (name, mesh), side in itertools.product(meshes.items(), args.sizes):
                truths = areas(cloud, cameras[side], sh_degree=0)
                columns = [
                    drawn_images(folder / f"{name} {side} 1", args.views),
                    [_halved(image) for image in drawn_images(folder / f"{name} {side} 2", args.views)],
                    images(mesh, cameras[side], samples=2),
                ]
                report.row(name, side, *(f"{mean_psnr(shown, truths):.1f}" for shown in columns))


def _halved(image: np.ndarray) -> np.ndarray:
    height, width, _ = image.shape
    return image.reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))


if __name__ == "__main__":
    main()
