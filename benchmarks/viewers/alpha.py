"""Whether `--alpha auto` takes the better way: blend, mask and the default .glb in three.js with MSAA.

    npm install three puppeteer-core    (in some folder; Chromium installed)
    python benchmarks/viewers/alpha.py SPLATS [SPLATS ...] --node-folder FOLDER [--max-triangles N]

PSNR of the stock loader's images from an orbit, on white, means over views: first against the sorted image of
the same mesh at 2 x 2 samples a pixel, then against the splats at degree 0, look 'area', then against the
sorted image, both averaged over areas of 4 x 4 pixels. Beside them the
figures of `viewer_images`, from which the choice is made, and the choice's share of the processor time of a
conversion with it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from _node import draw_jobs, drawn_images, job

sys.path.insert(0, str(Path(__file__).parents[1]))  # _common.py
from _common import Report, Stopwatch, areas, arguments, images, mean_psnr

import meshsplats as ms
from meshsplats.evaluation.viewers import area_means, choose_alpha
from meshsplats.rendering.viewers import viewer_images


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", type=Path, nargs="+")
    parser.add_argument("--node-folder", type=Path, required=True, help="where node_modules lies")
    parser.add_argument("--max-triangles", type=int, help="merge similar splats to this size")
    parser.add_argument("--side", type=int, default=400)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--elevation", type=float, default=20)
    parser.add_argument("--azimuth", type=float, default=0)
    args = parser.parse_args()
    with Report(args) as report:
        report.table(
            *("scene", "triangles", "three.js: blend", "mask 0.2", "default", "taken", "simulated"),
            "share of time",
        )
        for path in args.splats:
            with tempfile.TemporaryDirectory() as scratch:
                report.row(*measure(path, args, Path(scratch)))


def measure(path: Path, args: argparse.Namespace, folder: Path) -> list[str]:
    watch, times = Stopwatch(), [0.0]
    cloud = ms.load_gaussians(path)
    mesh = ms.convert(cloud, max_triangles=args.max_triangles)
    times.append(watch.processor)
    choice = choose_alpha(mesh)
    times.append(watch.processor)
    ms.save_mesh(mesh, folder / "default.glb", **choice.options)
    times.append(watch.processor)
    for alpha in ("blend", "mask"):
        ms.save_mesh(mesh, folder / f"{alpha}.glb", alpha=alpha)
    around = {"elevation": args.elevation, "azimuth": args.azimuth, "width": args.side, "height": args.side}
    cameras = ms.orbit(mesh, args.views, **around)
    ms.save_cameras(cameras, folder / "cameras.json")
    away = max(float(np.linalg.norm(camera.center)) for camera in cameras)
    reach = away + float(np.linalg.norm(mesh.vertices, axis=1).max())
    near = max(cameras[0].near, reach / 1e5)
    jobs = [
        job(
            "three",
            folder / f"{name}.glb",
            folder / "cameras.json",
            folder / name,
            reach,
            antialias=True,
            near=near,
        )
        for name in ("blend", "mask", "default")
    ]
    draw_jobs(jobs, folder, args.node_folder)
    sorted_ = images(mesh, cameras, samples=2)
    truths = areas(cloud, cameras, sh_degree=0)
    simulated = [viewer_images(mesh, camera, [None, 0.2]) for camera in cameras]
    cells = [path.stem if path.is_file() else path.name, f"{len(mesh.faces):,}"]
    for name in ("blend", "mask", "default"):
        shown = drawn_images(folder / name, len(cameras))
        far = mean_psnr([*map(area_means, shown)], [*map(area_means, sorted_)])
        cells.append(f"{mean_psnr(shown, sorted_):.1f} / {mean_psnr(shown, truths):.1f} / {far:.1f}")
    cells.append(choice.alpha + (f" {choice.cutoff:g}" if choice.alpha == "mask" else ""))
    ways = zip(*simulated, strict=True)
    cells.append(" / ".join(f"{mean_psnr(shown, sorted_):.1f}" for shown in ways))
    cells.append(f"{(times[2] - times[1]) / (times[3] - times[0]):.0%} of {times[3] - times[0]:.1f} s")
    return cells


if __name__ == "__main__":
    main()
