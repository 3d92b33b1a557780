"""Unlit images by Cycles against ``render``, on real splats.

    blender-env/bin/python benchmarks/blender_exact.py --data ../shared/data [--scale 0.6]

Each scene of the data folder is converted with default settings and drawn by two of its standard cameras and
by a lens with the principal point off the centre and fx different from fy; --mesh draws finished meshes
instead. PSNR of the .exr images, of both rounded to 8 bits, and of the .png images, encoded for display.
--times: the wall time of one more image of a scene, in seconds: by Cycles, from runs with more and with fewer
views, and by ``render`` with 1 sample per pixel and all threads.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from _common import SCENES, Report, Stopwatch, arguments, in_turns

from meshsplats import DataWarning, convert, load_mesh, render
from meshsplats.blender import SceneOptions, draw
from meshsplats.evaluation.metrics import psnr
from meshsplats.images.reading import load_image
from meshsplats.scene.colors import linear_to_srgb


def rounded(image: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.clip(image, 0, 1)) / 255


def times(report: Report, data: Path, scale: float, more: int = 3) -> None:
    report.table("scene", "triangles", "image", "Cycles, s an image", "render, s an image", "ratio")
    for scene in SCENES.values():
        mesh = convert(scene.cloud(data))
        views = [view.scaled(scale) for view in scene.cameras(data)[: 1 + more]]
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            files = [Path(folder) / f"{k}.exr" for k in range(len(views))]
            taken = []
            for count in (1, 1 + more, 1):  # the first also pays for what Blender loads once
                watch = Stopwatch()
                draw(mesh, views[:count], images=files[:count])
                taken.append(watch.wall)
        cycles = (taken[1] - taken[2]) / more
        found = in_turns([partial(render, mesh, view) for view in views[1:]], 5)
        ours = statistics.mean(statistics.median(each.wall) for each in found)
        size = f"{views[0].width} x {views[0].height}"
        report.row(
            *(scene.name, f"{len(mesh.faces):,}", size),
            *(f"{cycles:.2f}", f"{ours:.3f}", f"{cycles / ours:.0f}"),
        )


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("--scale", type=float, default=0.6, help="of the standard cameras' 400 x 400")
    parser.add_argument("--mesh", type=Path, nargs="+", help="meshes to draw instead, fine-tuned ones say")
    parser.add_argument(
        "--cameras", choices=sorted(SCENES), default="playbot", help="of which scene, for --mesh"
    )
    parser.add_argument("--threads", type=int)
    parser.add_argument("--times", action="store_true", help="time both instead")
    asked = parser.parse_args()
    from meshsplats.blender.inside.host import bpy

    with Report(asked) as report:
        report.say(f"Blender {bpy.app.version_string}")
        if asked.times:
            times(report, asked.data, asked.scale)
        else:
            compare(report, asked)


def compare(report: Report, asked: argparse.Namespace) -> None:
    from meshsplats.blender.inside.rendering import read_pixels

    report.table("scene", "triangles", "layers", "view", ".exr, dB", ".exr, rounded", ".png")
    if asked.mesh:
        meshes = [(path.stem, asked.cameras, partial(load_mesh, path)) for path in asked.mesh]
    else:
        meshes = [
            (name, name, lambda s=scene: convert(s.cloud(asked.data))) for name, scene in SCENES.items()
        ]
    for name, cameras, load in meshes:
        mesh = load()
        views = [view.scaled(asked.scale) for view in SCENES[cameras].cameras(asked.data)[:2]]
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
                scores = (
                    psnr(drawn, expected),
                    psnr(rounded(drawn), rounded(expected)),
                    psnr(shown, rounded(encoded(expected))),
                )
                figures = (f"{score:.1f}" for score in scores)
                report.row(name, f"{len(mesh.faces):,}", results[0]["layers"], view.name, *figures)


if __name__ == "__main__":
    main()
