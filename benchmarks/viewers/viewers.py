"""What web viewers make of our .glb files: PSNR against the exact image of the same mesh.

    npm install three babylonjs babylonjs-loaders puppeteer-core    (in some folder; Chromium installed)
    python benchmarks/viewers/viewers.py SPLATS CAMERAS --node-folder FOLDER [--mesh MESH] [--views 4]

Prints a table: each way of writing opacity, in each viewer, against the sorted mesh and against the splats
it was made from. With --mesh, a mesh of `finetune --opacity cutoff`, with and without MSAA, against our image
with 2 x 2 samples a pixel, and against the splats' means over pixels. The tables of docs/viewers.md come from
here.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from meshsplats import (
    convert,
    draw_splats,
    load_cameras,
    load_gaussians,
    load_mesh,
    psnr,
    render,
    render_splats,
    save_mesh,
)

WAYS = {
    "three": {"blend": {"alpha": "blend"}, "blend, alphaHash on": {"alpha": "blend", "hash": True}},
    "babylon": {"blend": {"alpha": "blend"}},
}
TUNED = {
    viewer: {name: {"alpha": "hybrid", "antialias": name == "MSAA"} for name in ("1 sample", "MSAA")}
    for viewer in WAYS
}
for _ways in WAYS.values():
    _ways["mask"] = {"alpha": "mask"}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("splats", type=Path)
    parser.add_argument("cameras", type=Path)
    parser.add_argument("--node-folder", type=Path, required=True, help="where node_modules lies")
    parser.add_argument("--views", type=int, default=4, help="number of cameras, the first ones of the file")
    parser.add_argument(
        "--mesh", type=Path, help="a mesh for depth buffers, in place of the converted splats"
    )
    parser.add_argument("--keep", type=Path, help="keep files and images here")
    args = parser.parse_args()

    cloud = load_gaussians(args.splats)
    mesh = load_mesh(args.mesh) if args.mesh else convert(cloud)
    cameras = load_cameras(args.cameras)[: args.views]
    exact = [render(mesh, camera, samples=2 if args.mesh else 1).color for camera in cameras]
    if args.mesh:
        splats = [draw_splats(cloud, camera, "area", sh_degree=0).color for camera in cameras]
    else:
        splats = [render_splats(cloud, camera, sh_degree=0).color for camera in cameras]
    reach = np.linalg.norm(mesh.vertices, axis=1).max() + max(
        np.linalg.norm(np.linalg.inv(c.world_to_camera)[:3, 3]) for c in cameras
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        listed = json.loads(args.cameras.read_text())[: args.views]
        (folder / "cameras.json").write_text(json.dumps(listed))
        jobs = []
        for viewer, ways in (TUNED if args.mesh else WAYS).items():
            for name, way in ways.items():
                glb = folder / f"{way['alpha']}.glb"
                if not glb.exists():
                    save_mesh(mesh, glb, alpha=way["alpha"])
                jobs.append(
                    {
                        "viewer": viewer,
                        "name": name,
                        "glb": str(glb.resolve()),
                        "cameras": str((folder / "cameras.json").resolve()),
                        "out": str((folder / f"{viewer} {name}").resolve()),
                        "hash": way.get("hash", False),
                        "antialias": way.get("antialias", False),
                        "near": float(reach) / 1000,
                        "far": float(reach) * 2,
                    }
                )
        (folder / "jobs.json").write_text(json.dumps(jobs))
        done = subprocess.run(
            ["node", Path(__file__).with_name("viewers.mjs").resolve(), (folder / "jobs.json").resolve()],
            cwd=args.node_folder,
            env=os.environ,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        titles = dict(line.split("=") for line in done.stdout.splitlines() if "=" in line)
        print(f"{args.splats.name}: {mesh.splat_count or 0:,} splats, {len(mesh.faces):,} triangles")
        print("| viewer | alpha | against the exact mesh, dB | against the splats, dB |\n|---|---|---|---|")
        for job in jobs:
            images = [
                np.asarray(Image.open(Path(job["out"]) / f"{i}.png").convert("RGB"), np.float32) / 255
                for i in range(len(cameras))
            ]
            figures = [
                np.mean([psnr(a, b) for a, b in zip(images, truth, strict=True)]) for truth in (exact, splats)
            ]
            print(f"| {titles[job['viewer']]} | {job['name']} | {figures[0]:.1f} | {figures[1]:.1f} |")
        best = np.mean([psnr(a, b) for a, b in zip(exact, splats, strict=True)])
        print(f"| exact renderer | sorted | - | {best:.1f} |")


if __name__ == "__main__":
    main()
