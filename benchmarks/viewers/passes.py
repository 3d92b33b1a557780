"""Babylon.js' order-independent transparency: PSNR against the sorted mesh by the number of its passes.

    npm install three babylonjs babylonjs-loaders puppeteer-core    (in some folder; Chromium installed)
    python benchmarks/viewers/passes.py SPLATS ... --node-folder FOLDER [--count 3000] [--passes 0 5 16 64]

Dual depth peeling: a pass peels the nearest and the farthest layer that are left, so that n passes blend the
2 n outermost layers of a pixel; 0: the triangles as they are listed. Cameras: two of an orbit at 20 degrees.
Layers: of a pixel, those that the mesh has behind it at most and on average, on the pixels that it covers.
"""

from __future__ import annotations

import sys
import tempfile
from argparse import Namespace
from pathlib import Path

import numpy as np
from _node import draw_jobs, drawn_images, job

sys.path.insert(0, str(Path(__file__).parents[1]))  # _common.py
from _common import Report, arguments, images, mean_psnr

import meshsplats as ms

_SIZE = 200


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", type=Path, nargs="+")
    parser.add_argument("--node-folder", type=Path, required=True, help="where node_modules lies")
    parser.add_argument("--count", type=int, help="merge the splats to so many")
    parser.add_argument("--passes", type=int, nargs="+", default=[0, 5, 16, 64])
    args = parser.parse_args()
    with Report(args) as report, tempfile.TemporaryDirectory() as scratch:
        report.table("scene", "triangles", "layers", "passes", "against the sorted mesh, dB")
        for path in args.splats:
            measure(report, path, args, Path(scratch))


def measure(report: Report, path: Path, args: Namespace, folder: Path) -> None:
    """The rows of a scene."""
    cloud = ms.load_gaussians(path).of_degree(0)
    cloud = ms.simplify(cloud, args.count) if args.count and args.count < len(cloud) else cloud
    mesh = ms.convert(cloud)
    glb, listed = folder / "mesh.glb", folder / "cameras.json"
    ms.save_mesh(mesh, glb)
    cameras = ms.orbit(mesh, 2, elevation=20, width=_SIZE, height=_SIZE)
    ms.save_cameras(cameras, listed)
    exact = images(mesh, cameras)
    counts = [layers(mesh, camera) for camera in cameras]
    covered = np.concatenate([count[count > 0] for count in counts])
    reach = float(np.linalg.norm(mesh.vertices, axis=1).max()) + max(
        float(np.linalg.norm(np.linalg.inv(c.world_to_camera)[:3, 3])) for c in cameras
    )
    for passes in args.passes:
        out = folder / f"{passes}"
        draw_jobs(
            [job("babylon", glb, listed, out, reach, hash=False, passes=passes)], folder, args.node_folder
        )
        shown = mean_psnr(drawn_images(out, len(cameras)), exact)
        many = f"{covered.mean():.0f}, {covered.max():.0f}"
        report.row(path.stem, f"{len(mesh.faces):,}", many, str(passes), f"{shown:.1f}")


def layers(mesh: ms.SplatMesh, camera: ms.Camera) -> np.ndarray:
    """(h, w) count of the triangles behind the centre of each pixel: how much light is left where each takes
    the same share of it."""
    share = 1 / 64
    colors = np.tile(np.array([0, 0, 0, share], np.float32), (len(mesh.vertices), 1))
    thin = ms.SplatMesh(mesh.vertices, mesh.faces, colors, up=mesh.up)
    left = ms.render(thin, camera, background=(1, 1, 1), min_transmittance=0).color[..., 0]
    return np.round(np.log(np.maximum(left, 1e-38)) / np.log(1 - share))


if __name__ == "__main__":
    main()
