"""Unlit images by Cycles against ``render``, on real splats.

    blender-env/bin/python benchmarks/blender_exact.py --data ../shared/data [--scale 0.6]

Each scene of the data folder is converted with default settings and drawn by two of its standard cameras and
by a lens with the principal point off the centre and fx different from fy; --mesh draws finished meshes
instead. Prints a Markdown table: PSNR of the .exr images, of both rounded to 8 bits, and of the .png images,
encoded for display. --times prints the wall time of one more image of a scene, in seconds: by Cycles, from
runs with more and with fewer views, and by ``render`` with 1 sample per pixel and all threads.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from meshsplats import DataWarning, convert, load_cameras, load_gaussians, load_mesh, render
from meshsplats.blender import SceneOptions, draw
from meshsplats.blender.inside.host import bpy
from meshsplats.blender.inside.rendering import read_pixels
from meshsplats.colors import linear_to_srgb
from meshsplats.evaluation.metrics import psnr
from meshsplats.images.reading import load_image

SCENES = {
    "guitar": "guitar_sh0.ply",
    "playbot": "playbot_lod3_31k_sh2.ply",
    "truck": "tt_truck_sh0.ply",
}


def rounded(image: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.clip(image, 0, 1)) / 255


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def times(data: Path, scale: float, more: int = 3) -> None:
    print("| scene | triangles | image | Cycles, s an image | render, s an image | ratio |")
    print("|---|---|---|---|---|---|")
    for name, file in SCENES.items():
        mesh = convert(load_gaussians(data / "splats" / file))
        views = [
            view.scaled(scale) for view in load_cameras(data / "cameras" / f"{name}_mid.json")[: 1 + more]
        ]
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            files = [Path(folder) / f"{k}.exr" for k in range(len(views))]
            for count in (1, 1 + more):  # the first also pays for what Blender loads once
                taken = seconds(partial(draw, mesh, views[:count], images=files[:count]))
                if count == 1:
                    one = seconds(partial(draw, mesh, views[:1], images=files[:1]))
        cycles = (taken - one) / more
        ours = statistics.mean(
            statistics.median(seconds(partial(render, mesh, view)) for _ in range(5)) for view in views[1:]
        )
        size = f"{views[0].width} x {views[0].height}"
        print(
            f"| {name} | {len(mesh.faces):,} | {size} | {cycles:.2f} | {ours:.3f} | {cycles / ours:.0f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="Unlit images by Cycles against render.")
    parser.add_argument("--data", type=Path, required=True, help="folder with splats/ and cameras/")
    parser.add_argument("--scale", type=float, default=0.6, help="of the standard cameras' 400 x 400")
    parser.add_argument("--mesh", type=Path, nargs="+", help="meshes to draw instead, fine-tuned ones say")
    parser.add_argument(
        "--cameras", choices=sorted(SCENES), default="playbot", help="of which scene, for --mesh"
    )
    parser.add_argument("--threads", type=int)
    parser.add_argument("--times", action="store_true", help="time both instead")
    asked = parser.parse_args()
    print(f"Blender {bpy.app.version_string}\n")
    if asked.times:
        return times(asked.data, asked.scale)
    print("| scene | triangles | layers | view | .exr | .exr, rounded | .png |")
    print("|---|---|---|---|---|---|---|")
    if asked.mesh:
        meshes = [(path.stem, asked.cameras, lambda path=path: load_mesh(path)) for path in asked.mesh]
    else:
        meshes = [
            (name, name, lambda file=file: convert(load_gaussians(asked.data / "splats" / file)))
            for name, file in SCENES.items()
        ]
    for name, cameras, load in meshes:
        mesh = load()
        places = asked.data / "cameras" / f"{cameras}_mid.json"
        views = [view.scaled(asked.scale) for view in load_cameras(places)[:2]]
        first = views[0]
        askew = replace(first, fx=1.3 * first.fx, fy=0.9 * first.fy, cx=first.cx + 21.3, cy=first.cy - 17.7)
        views.append(replace(askew, width=first.width - 20, height=first.height + 20, name="askew"))
        encoded = linear_to_srgb if mesh.blending == "linear" else np.asarray
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # the guitar has more layers than 1024 in places
            files = [[Path(folder) / f"{k}.{kind}" for k in range(len(views))] for kind in ("exr", "png")]
            results = [
                draw(mesh, views, images=some, options=SceneOptions(threads=asked.threads)) for some in files
            ]
            white = np.ones(3)
            for view, exr, png in zip(views, *files, strict=True):
                expected = render(mesh, view, background=white, threads=asked.threads).color
                drawn, shown = read_pixels(exr)[..., :3], load_image(png) / 255
                print(
                    f"| {name} | {len(mesh.faces):,} | {results[0]['layers']} | {view.name} |"
                    f" {psnr(drawn, expected):.1f} dB | {psnr(rounded(drawn), rounded(expected)):.1f} dB |"
                    f" {psnr(shown, rounded(encoded(expected))):.1f} dB |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
