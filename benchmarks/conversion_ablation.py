"""Ablation of the conversion's choices: PSNR of the mesh's image against that of the splats.

    python benchmarks/conversion_ablation.py                              on a scene of our own
    python benchmarks/conversion_ablation.py --data FOLDER                on guitar, truck and playbot
    python benchmarks/conversion_ablation.py --scene SPLATS CAMERAS...    on other splats, with camera files

Every mesh is converted once, for the first set of cameras (close),
and drawn from all of them with 2 x 2 samples per pixel on white; the splats are drawn the 3DGS way. Both have
the splats' display colour of degree 0, in [0, 1].
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from _common import DISTANCES, SCENES, Report, Stopwatch, arguments, images, mean_psnr

from meshsplats.cameras.files import load_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion import convert
from meshsplats.demo_scene import make_scene
from meshsplats.formats.gaussians import load_gaussians
from meshsplats.rendering import render_splats
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import SH_C0, GaussianCloud

_WITHOUT_CAMERAS = ("none", "framing")

PRESETS: list[tuple[str, dict]] = [
    ("paper", dict(preset="paper")),
    ("paper, 3d", dict(preset="paper", mode="3d")),
    ("**default**", dict()),
    ("**default**, no cameras known", dict(footprint="framing")),
]
MODES: list[tuple[str, dict]] = [
    ("default, flat, 8 triangles", dict(mode="flat")),
    ("default, flat, 4 triangles", dict(mode="flat", sides=4)),
    ("default, flat, 24 triangles in 2 rings", dict(mode="flat", rings=2)),
    ("default, crossed, 2 x 6 triangles", dict(sides=6)),
    ("default, crossed, 2 x 18 triangles in 2 rings", dict(sides=6, rings=2)),
    ("default, 3d, 3 x 4 triangles", dict(mode="3d")),
    ("default, 3d, 3 x 8 triangles", dict(mode="3d", sides=8)),
]
VARIATIONS: list[tuple[str, dict]] = [
    ("no footprint", dict(footprint="none")),
    ("footprint_px2 0.3", dict(footprint_px2=0.3)),
    ("footprint_px2 0.4", dict(footprint_px2=0.4)),
    ("footprint_px2 0.6", dict(footprint_px2=0.6)),
    ("footprint_px2 0.8", dict(footprint_px2=0.8)),
    ("no compensation", dict(compensation=0.0)),
    ("compensation 0.5", dict(compensation=0.5)),
    ("always two ellipses (flat_below 0)", dict(flat_below=0.0)),
    ("flat_below 0.3", dict(flat_below=0.3)),
    ("faint splats as large as others", dict(shrink_faint=False)),
    ("centre not above the splat's opacity (center_opacity 1)", dict(center_opacity=1.0)),
    ("rim_radius 2.8", dict(rim_radius=2.8)),
    ("rim_radius 3.2", dict(rim_radius=3.2)),
    ("rim_opacity 0.05", dict(rim_opacity=0.05)),
    ("half the triangles, by importance", dict(max_triangles="half", budget="drop")),
]
GRID = dict(rim_radius=(2.0, 2.7, 3.3), sides=(4, 8), rim_opacity=(0.0, 0.2), footprint=("none", "cameras"))


@dataclass
class Scene:
    name: str
    cloud: GaussianCloud
    cameras: dict[str, list[Camera]]
    """By distance; the first is the one that meshes are converted for."""
    images: dict[str, list[np.ndarray]]


def make(name: str, cloud: GaussianCloud, cameras: dict[str, list[Camera]], views: int) -> Scene:
    # What a mesh can hold: one colour a splat, in [0, 1].
    cloud = replace(cloud, sh=((cloud.colors - 0.5) / np.float32(SH_C0))[:, None])
    shown = {where: some[:: max(1, len(some) // views)][:views] for where, some in cameras.items()}
    truths = {where: [render_splats(cloud, c).color for c in some] for where, some in shown.items()}
    return Scene(name, cloud, cameras, truths)


def load_scenes(args: argparse.Namespace) -> list[Scene]:
    if args.scene:
        path, *sets = args.scene
        cameras = {Path(file).stem: load_cameras(file) for file in sets}
        return [make(Path(path).stem, load_gaussians(path), cameras, args.views)]
    if args.data:
        return [
            make(
                scene.name,
                scene.cloud(args.data),
                {distance: scene.cameras(args.data, distance) for distance in DISTANCES},
                args.views,
            )
            for scene in SCENES.values()
        ]
    cloud = make_scene()
    cameras = {
        where: orbit(cloud, 8, width=400, height=400, distance=distance)
        for where, distance in zip(DISTANCES, (0.6, 1.2, 4.8), strict=True)
    }
    return [make("demo", cloud, cameras, args.views)]


class Measured(NamedTuple):
    quality: list[float]
    """PSNR by distance."""
    triangles: int
    vertices: int
    size: int
    """Bytes of the mesh's arrays."""
    seconds: float


def measure(scene: Scene, options: dict) -> Measured:
    """Converts with ``options`` and compares."""
    distances = list(scene.cameras)
    options = dict(options)
    footprint = options.get("footprint", "none" if options.get("preset") == "paper" else "cameras")
    if footprint not in _WITHOUT_CAMERAS:
        options["cameras"] = scene.cameras[distances[0]]
    if options.get("max_triangles") == "half":
        options["max_triangles"] = 4 * len(scene.cloud)
    seconds = np.inf
    for _ in range(2):
        watch = Stopwatch()
        mesh = convert(scene.cloud, **options)
        seconds = min(seconds, watch.wall)
    quality = []
    for where in distances:
        truths = scene.images[where]
        shown = scene.cameras[where][:: max(1, len(scene.cameras[where]) // len(truths))][: len(truths)]
        quality.append(mean_psnr(images(mesh, shown, samples=2), truths))
    arrays = (mesh.vertices, mesh.faces, mesh.colors, mesh.face_splat)
    size = sum(array.nbytes for array in arrays if array is not None)
    return Measured(quality, len(mesh.faces), len(mesh.vertices), size, float(seconds))


def print_table(report: Report, title: str, scenes: Sequence[Scene], rows: list[tuple[str, dict]]) -> None:
    distances = " / ".join(scenes[0].cameras)
    report.say(f"\n{title}. PSNR in dB, {distances}:")
    means = ["mean"] if len(scenes) > 1 else []
    names = [scene.name for scene in scenes]
    report.table("conversion", "triangles a splat", "vertices a splat", "MB", "s", *names, *means)
    splats = sum(len(scene.cloud) for scene in scenes)
    for label, options in rows:
        found = [measure(scene, options) for scene in scenes]
        cells = [label]
        cells.append(f"{sum(f.triangles for f in found) / splats:.1f}")
        cells.append(f"{sum(f.vertices for f in found) / splats:.1f}")
        cells.append(f"{sum(f.size for f in found) / 1e6:.0f}")
        cells.append(f"{sum(f.seconds for f in found):.2f}")
        cells += [" / ".join(f"{q:.2f}" for q in f.quality) for f in found]
        if len(scenes) > 1:
            cells.append(" / ".join(f"{q:.2f}" for q in np.mean([f.quality for f in found], axis=0)))
        report.row(*cells)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--data", type=Path, help="folder of real data, for three scenes of it")
    parser.add_argument("--scene", nargs="+", metavar="FILE", help="a splat file and its camera files")
    parser.add_argument("--views", type=int, default=8, help="views a distance, 1 to 8")
    parser.add_argument("--quick", action="store_true", help="the presets alone")
    args = parser.parse_args()
    if args.scene and len(args.scene) < 2:
        parser.error("--scene needs a splat file and at least one camera file")
    scenes = load_scenes(args)
    with Report(args) as report:
        counts = ", ".join(f"{scene.name} ({len(scene.cloud):,} splats)" for scene in scenes)
        report.say(f"{counts}. {args.views} views a distance. MB: arrays of the meshes; s: conversion.")
        print_table(report, "Presets", scenes, PRESETS)
        if args.quick:
            return
        print_table(report, "Flat, crossed, 3d", scenes, MODES)
        print_table(report, "The default with one option changed", scenes, VARIATIONS)
        grid = []
        for radius, sides, rim, footprint in product(*GRID.values()):
            options = dict(
                preset="paper", rim_radius=radius, sides=sides, rim_opacity=rim, footprint=footprint
            )
            grid.append((f"{radius} / {sides} / {rim} / {footprint}", options))
        title = "Flat fans of the paper: rim_radius / sides / rim_opacity / footprint"
        print_table(report, title, scenes, grid)


if __name__ == "__main__":
    main()
