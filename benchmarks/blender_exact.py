"""Unlit pictures by Cycles against ``render``, on real splats.

    blender-env/bin/python benchmarks/blender_exact.py --data ../shared/data [--scale 0.6]

Each scene of the data folder is converted with default settings and drawn by two of its standard cameras and
by a lens with the principal point off the centre and fx different from fy. Prints a Markdown table: PSNR of
the .exr pictures, and of both rounded to 8 bits.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshsplats import DataWarning, convert, load_cameras, load_gaussians, render
from meshsplats.blender import draw
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.inside.pictures import read_pixels
from meshsplats.metrics import psnr

SCENES = {
    "guitar": "guitar_sh0.ply",
    "playbot": "playbot_lod3_31k_sh2.ply",
    "truck": "tt_truck_sh0.ply",
}


def rounded(picture: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.clip(picture, 0, 1)) / 255


def main() -> None:
    parser = argparse.ArgumentParser(description="Unlit pictures by Cycles against render.")
    parser.add_argument("--data", type=Path, required=True, help="folder with splats/ and cameras/")
    parser.add_argument("--scale", type=float, default=0.6, help="of the standard cameras' 400 x 400")
    asked = parser.parse_args()
    print(f"Blender {bpy.app.version_string}\n")
    print("| scene | triangles | layers | view | PSNR, float | PSNR, 8 bits |")
    print("|---|---|---|---|---|---|")
    for name, file in SCENES.items():
        mesh = convert(load_gaussians(asked.data / "splats" / file))
        views = [
            view.scaled(asked.scale) for view in load_cameras(asked.data / "cameras" / f"{name}_mid.json")[:2]
        ]
        first = views[0]
        askew = replace(first, fx=1.3 * first.fx, fy=0.9 * first.fy, cx=first.cx + 21.3, cy=first.cy - 17.7)
        views.append(replace(askew, name="askew"))
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # the guitar has more layers than 1024 in places
            files = [Path(folder) / f"{k}.exr" for k in range(len(views))]
            told = draw(mesh, views, pictures=files)
            for view, path in zip(views, files, strict=True):
                drawn, expected = read_pixels(path)[..., :3], render(mesh, view).color
                print(
                    f"| {name} | {len(mesh.faces):,} | {told['layers']} | {view.name} |"
                    f" {psnr(drawn, expected):.1f} dB | {psnr(rounded(drawn), rounded(expected)):.1f} dB |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
