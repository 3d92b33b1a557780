"""What web viewers make of our .glb files: PSNR against the exact image of the same mesh.

    npm install three babylonjs babylonjs-loaders puppeteer-core    (in some folder; Chromium installed)
    python benchmarks/viewers/viewers.py SPLATS CAMERAS --node-folder FOLDER [--mesh MESH] [--views 4]

The table: each way of writing opacity, in each viewer, against the sorted mesh and against the splats it was
made from. With --mesh, a mesh of `finetune --opacity cutoff`, with and without MSAA, against our image with 2
x 2 samples a pixel, and against the splats' means over pixels. The tables of docs/viewers.md come from here.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from _node import draw_jobs, drawn_images, job

sys.path.insert(0, str(Path(__file__).parents[1]))  # _common.py
from _common import Report, areas, arguments, images, mean_psnr

from meshsplats import convert, load_cameras, load_gaussians, load_mesh, save_mesh

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
    parser = arguments(__doc__)
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
    exact = images(mesh, cameras, samples=2 if args.mesh else 1)
    splats = areas(cloud, cameras, look="area" if args.mesh else "splats", sh_degree=0)
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
                more = {
                    "name": name,
                    "hash": way.get("hash", False),
                    "antialias": way.get("antialias", False),
                }
                places = (glb, folder / "cameras.json", folder / f"{viewer} {name}")
                jobs.append(job(viewer, *places, float(reach), **more))
        lines = draw_jobs(jobs, folder, args.node_folder)
        titles = dict(line.split("=") for line in lines if "=" in line)
        with Report(args) as report:
            report.say(f"{args.splats.name}: {mesh.splat_count or 0:,} splats, {len(mesh.faces):,} triangles")
            report.table("viewer", "alpha", "against the exact mesh, dB", "against the splats, dB")
            for drawn in jobs:
                shown = drawn_images(Path(drawn["out"]), len(cameras))
                figures = (f"{mean_psnr(shown, truth):.1f}" for truth in (exact, splats))
                report.row(titles[drawn["viewer"]], drawn["name"], *figures)
            report.row("exact renderer", "sorted", "-", f"{mean_psnr(exact, splats):.1f}")


if __name__ == "__main__":
    main()
