"""Popping: what changes from frame to frame of a slow orbit beyond what changes in the sorted images.

    python benchmarks/viewers/popping.py SPLATS [SPLATS ...] [--frames 60] [--step 2] [--nodes 1 8]

Images of 400 pixels with MSAA as three.js draws files without an order (blend) and with one: `ordered_image`.
Of their errors against the sorted images at 2 x 2 samples, the change from each frame to the next: root mean
square, and the largest mean of a block of 8 x 8 pixels, both of 255. A sudden change of order shows as a
large block.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # _common.py
from _common import Report, arguments, images

import meshsplats as ms
from meshsplats.rendering.viewers import ordered_image, viewer_images

SIDE, BLOCK = 400, 8


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--step", type=float, default=2, help="degrees from frame to frame")
    parser.add_argument("--nodes", type=int, nargs="+", default=[1, 8])
    args = parser.parse_args()
    with Report(args) as report:
        report.table("scene", "file", "mean change", "largest block")
        for path in args.splats:
            mesh = ms.convert(ms.load_gaussians(path))
            turn = ms.orbit(mesh, round(360 / args.step), elevation=15, width=SIDE, height=SIDE)
            views = turn[: args.frames]
            exact = np.array(images(mesh, views, samples=2))
            ways = {"blend": [viewer_images(mesh, view)[0] for view in views]}
            for nodes in args.nodes:
                order = ms.drawing_order(mesh, nodes=nodes)
                ways[f"solved, {nodes}"] = [ordered_image(mesh, order, view) for view in views]
            for name, shown in (("exact: the images themselves", exact), *ways.items()):
                error = np.array(shown) - (0 if shown is exact else exact)
                change = np.diff(error, axis=0)
                blocks = change.reshape(-1, SIDE // BLOCK, BLOCK, SIDE // BLOCK, BLOCK, 3).mean(axis=(2, 4))
                worst = 255 * float(np.abs(blocks).max())
                report.row(path.stem, name, f"{255 * np.sqrt((change**2).mean()):.1f}", f"{worst:.0f}")


if __name__ == "__main__":
    main()
