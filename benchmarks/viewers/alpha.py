"""Whether `--alpha auto` takes the better way: blend, mask and the default .glb in three.js with MSAA.

    npm install three puppeteer-core    (in some folder; Chromium installed)
    python benchmarks/viewers/alpha.py SPLATS [SPLATS ...] --node-folder FOLDER [--max-triangles N]

PSNR of the stock loader's images from an orbit, on white, means over views: first against the sorted image of
the same mesh at 2 x 2 samples a pixel, then against the splats at degree 0, look 'area'. Beside them the
figures of `viewer_images`, from which the choice is made, and the choice's share of the processor time of a
conversion with it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

import meshsplats as ms
from meshsplats.evaluation.viewers import choose_alpha
from meshsplats.rendering.viewers import viewer_images


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("splats", type=Path, nargs="+")
    parser.add_argument("--node-folder", type=Path, required=True, help="where node_modules lies")
    parser.add_argument("--max-triangles", type=int, help="merge similar splats to this size")
    parser.add_argument("--side", type=int, default=400)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--elevation", type=float, default=20)
    parser.add_argument("--azimuth", type=float, default=0)
    args = parser.parse_args()
    print("| scene | triangles | three.js: blend | mask 0.2 | default | taken | simulated | share of time |")
    print("|---|---|---|---|---|---|---|---|")
    for path in args.splats:
        with tempfile.TemporaryDirectory() as scratch:
            measure(path, args, Path(scratch))


def measure(path: Path, args: argparse.Namespace, folder: Path) -> None:
    times = [time.process_time()]
    cloud = ms.load_gaussians(path)
    mesh = ms.convert(cloud, max_triangles=args.max_triangles)
    times.append(time.process_time())
    choice = choose_alpha(mesh)
    times.append(time.process_time())
    ms.save_mesh(mesh, folder / "default.glb", **choice.options)
    times.append(time.process_time())
    for alpha in ("blend", "mask"):
        ms.save_mesh(mesh, folder / f"{alpha}.glb", alpha=alpha)
    around = {"elevation": args.elevation, "azimuth": args.azimuth, "width": args.side, "height": args.side}
    cameras = ms.orbit(mesh, args.views, **around)
    ms.save_cameras(cameras, folder / "cameras.json")
    away = max(float(np.linalg.norm(camera.center)) for camera in cameras)
    reach = away + float(np.linalg.norm(mesh.vertices, axis=1).max())
    jobs = [
        {
            "viewer": "three",
            "glb": str(folder / f"{name}.glb"),
            "cameras": str(folder / "cameras.json"),
            "out": str(folder / name),
            "antialias": True,
            "near": max(cameras[0].near, reach / 1e5),
            "far": 2 * reach,
        }
        for name in ("blend", "mask", "default")
    ]
    (folder / "jobs.json").write_text(json.dumps(jobs))
    subprocess.run(
        ["node", Path(__file__).with_name("viewers.mjs").resolve(), folder / "jobs.json"],
        cwd=args.node_folder,
        env=os.environ,
        stdout=subprocess.DEVNULL,
        check=True,
    )
    sorted_, truths = [], []
    simulated: list[np.ndarray] = []
    for camera in cameras:
        sorted_.append(ms.render(mesh, camera, samples=2).color)
        truths.append(ms.draw_splats(cloud, camera, "area", sh_degree=0).color)
        simulated.append(viewer_images(mesh, camera, [None, 0.2]))
    cells = [path.stem if path.is_file() else path.name, f"{len(mesh.faces):,}"]
    for name in ("blend", "mask", "default"):
        images = [load(folder / name / f"{i}.png") for i in range(len(cameras))]
        cells.append(f"{score(images, sorted_):.1f} / {score(images, truths):.1f}")
    cells.append(choice.alpha + (f" {choice.cutoff:g}" if choice.alpha == "mask" else ""))
    ways = zip(*simulated, strict=True)
    cells.append(" / ".join(f"{score(images, sorted_):.1f}" for images in ways))
    cells.append(f"{(times[2] - times[1]) / (times[3] - times[0]):.0%} of {times[3] - times[0]:.1f} s")
    print(f"| {' | '.join(cells)} |", flush=True)


def score(images, truths) -> float:
    return float(np.mean([ms.psnr(a.clip(0, 1), b.clip(0, 1)) for a, b in zip(images, truths, strict=True)]))


def load(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), np.float32) / 255


if __name__ == "__main__":
    main()
