"""What an order in the file is worth in web viewers: three.js and Babylon.js with their stock loaders.

    npm install three babylonjs babylonjs-loaders puppeteer-core    (in some folder; Chromium installed)
    python benchmarks/viewers/ordered.py SPLATS [SPLATS ...] --node-folder FOLDER [--max-triangles N]
        [--nodes 1 8] [--viewers three babylon] [--keep FOLDER] [--tuned TUNED.glb ...]

PSNR in dB at a pixel ratio of 2 with MSAA against means over pixels of the splats at degree 0, on white.
Views: around, at elevations of 5 and 30 degrees; from 40 degrees below; near, from 40 degrees above at half
the distance; each at least 10 degrees from every one that the order is solved for. Rows: the file without an
order (blend), files with one, of so many nodes, and one of `finetune --order file` for each of SPLATS;
'emulated' is our own image of the same file (ordered_image), 'exact' that of the sorted mesh at 2 x 2 samples
a pixel. Tuned files have been trained on views nearer than 10 degrees.
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
from meshsplats.rendering.ordering import default_views
from meshsplats.rendering.viewers import ordered_image, viewer_images

PLACES = {"around": ((5, 1.0), (30, 1.0)), "below": ((-40, 1.0),), "near": ((40, 0.5),)}
"""Elevations in degrees and distances of the views that are scored."""
APART = 10.0
"""Least angle in degrees between a view that is scored and one that was solved for."""
SIDE = 400


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", type=Path, nargs="+")
    parser.add_argument("--node-folder", type=Path, required=True, help="where node_modules lies")
    parser.add_argument("--max-triangles", type=int, help="merge similar splats to this size")
    parser.add_argument("--nodes", type=int, nargs="*", default=[8])
    parser.add_argument("--viewers", nargs="+", default=["three", "babylon"])
    parser.add_argument("--tuned", type=Path, nargs="+", default=[], help="a tuned file for each of SPLATS")
    parser.add_argument("--keep", type=Path, help="keep files and images here")
    args = parser.parse_args()
    if args.tuned and len(args.tuned) != len(args.splats):
        parser.error("--tuned needs a file for each of SPLATS")
    with Report(args) as report:
        report.table("scene", "file", "MB", "processor s", "image of", *PLACES)
        for number, path in enumerate(args.splats):
            with tempfile.TemporaryDirectory() as scratch:
                tuned = args.tuned[number] if args.tuned else None
                measure(path, tuned, args, args.keep or Path(scratch), report)


def unsolved(mesh: ms.SplatMesh, elevation: float, distance: float, count: int = 4) -> list[ms.Camera]:
    """Views around ``mesh`` that are apart from those that orders are solved for."""
    solved = np.array([camera.world_to_camera[2, :3] for camera in default_views(mesh)])
    lens = {"elevation": elevation, "distance": distance, "width": SIDE, "height": SIDE}
    found = []
    for view in ms.orbit(mesh, 180, **lens):
        nearest = float((solved @ view.world_to_camera[2, :3]).max())
        if nearest < np.cos(np.radians(APART)):
            found.append(view)
    if len(found) < count:
        raise ValueError(f"only {len(found)} views at {elevation} degrees are apart from those solved for")
    return [found[k * len(found) // count] for k in range(count)]


def measure(path: Path, tuned: Path | None, args: argparse.Namespace, folder: Path, report: Report) -> None:
    cloud = ms.load_gaussians(path)
    mesh = ms.convert(cloud, max_triangles=args.max_triangles)
    cameras, truths = {}, {}
    for place, rings in PLACES.items():
        cameras[place] = [view for ring in rings for view in unsolved(mesh, *ring)]
        truths[place] = areas(cloud, cameras[place], sh_degree=0)
    every = [view.scaled(2) for views in cameras.values() for view in views]
    folder.mkdir(parents=True, exist_ok=True)
    ms.save_cameras(every, folder / "cameras.json")
    files, orders, seconds = {"blend": folder / "blend.glb"}, {}, {"blend": 0.0}
    ms.save_mesh(mesh, files["blend"], alpha="blend")
    if tuned is not None:
        files["tuned"] = tuned
    for nodes in args.nodes:
        for quick in (True, False):
            name = f"{'quick' if quick else 'solved'}, {nodes}"
            if quick and nodes != args.nodes[-1]:
                continue
            watch = Stopwatch()
            orders[name] = ms.drawing_order(mesh, nodes=nodes, quick=quick)
            seconds[name], files[name] = watch.processor, folder / f"{name}.glb"
            ms.save_mesh(mesh, files[name], order=orders[name])
    reach = max(float(np.linalg.norm(view.center)) for view in every)
    reach += float(np.linalg.norm(mesh.vertices, axis=1).max())
    near = max(min(view.with_near_plane(mesh.vertices).near for view in every), reach / 1e5)
    jobs, shown = [], {}
    for name, glb in files.items():
        for viewer in args.viewers if not name.startswith("quick") else []:
            out = folder / f"{viewer} {name}"
            places = (glb, folder / "cameras.json", out)
            jobs.append(job(viewer, *places, reach, antialias=True, near=near))
            shown[name, viewer] = out
    draw_jobs(jobs, folder, args.node_folder)

    def row(name: str, what: str, drawn: list[np.ndarray]) -> None:
        scores, start = [], 0
        for truth in truths.values():
            scores.append(f"{mean_psnr(drawn[start : start + len(truth)], truth):.1f}")
            start += len(truth)
        size = f"{files[name].stat().st_size / 1e6:.1f}" if name in files else "-"
        took = f"{seconds[name]:.0f}" if name in orders else "-"
        report.row(path.stem if path.is_file() else path.name, name, size, took, what, *scores)

    for (name, viewer), out in shown.items():
        row(name, viewer, [_halved(image) for image in drawn_images(out, len(every))])
    row("blend", "emulated", [_halved(viewer_images(mesh, view)[0]) for view in every])
    for name, order in orders.items():
        row(name, "emulated", [_halved(ordered_image(mesh, order, view)) for view in every])
    row("exact", "-", images(mesh, [view.scaled(0.5) for view in every], samples=2))


def _halved(image: np.ndarray) -> np.ndarray:
    height, width, _ = image.shape
    return image.reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))


if __name__ == "__main__":
    main()
