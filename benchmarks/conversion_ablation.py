"""Ablation of the conversion's choices: PSNR of the mesh's image against that of the splats.

    python benchmarks/conversion_ablation.py                              on a scene of our own
    python benchmarks/conversion_ablation.py --data FOLDER                on guitar, truck and playbot
    python benchmarks/conversion_ablation.py --scene SPLATS CAMERAS...    on other splats, with camera files

FOLDER holds ``splats`` and ``cameras``. Every mesh is converted once, for the first set of cameras (close),
and drawn from all of them with 2 x 2 samples per pixel on white; the splats are drawn the 3DGS way. Both have
the splats' display colour of degree 0, in [0, 1]. Prints Markdown tables.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from meshsplats.camera import Camera
from meshsplats.cameras.files import load_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion import convert
from meshsplats.demo_scene import make_scene
from meshsplats.evaluation.metrics import psnr
from meshsplats.formats.gaussians import load_gaussians
from meshsplats.gaussians import SH_C0, GaussianCloud
from meshsplats.rendering import render, render_splats

STANDARD = {
    "guitar": "guitar_sh0.ply",
    "truck": "tt_truck_sh0.ply",
    "playbot": "playbot_lod3_31k_sh2.ply",
}
DISTANCES = ("close", "mid", "far")
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
    images = {where: [render_splats(cloud, c).color for c in some] for where, some in shown.items()}
    return Scene(name, cloud, cameras, images)


def load_scenes(args: argparse.Namespace) -> list[Scene]:
    if args.scene:
        path, *sets = args.scene
        cameras = {Path(file).stem: load_cameras(file) for file in sets}
        return [make(Path(path).stem, load_gaussians(path), cameras, args.views)]
    if args.data:
        return [
            make(
                name,
                load_gaussians(args.data / "splats" / file),
                {d: load_cameras(args.data / "cameras" / f"{name}_{d}.json") for d in DISTANCES},
                args.views,
            )
            for name, file in STANDARD.items()
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
        start = time.perf_counter()
        mesh = convert(scene.cloud, **options)
        seconds = min(seconds, time.perf_counter() - start)
    quality = []
    for where in distances:
        images = scene.images[where]
        shown = scene.cameras[where][:: max(1, len(scene.cameras[where]) // len(images))]
        pairs = zip(shown, images, strict=False)
        quality.append(float(np.mean([psnr(render(mesh, c, samples=2).color, p) for c, p in pairs])))
    arrays = (mesh.vertices, mesh.faces, mesh.colors, mesh.face_splat)
    size = sum(array.nbytes for array in arrays if array is not None)
    return Measured(quality, len(mesh.faces), len(mesh.vertices), size, float(seconds))


def print_table(title: str, scenes: Sequence[Scene], rows: list[tuple[str, dict]]) -> None:
    distances = " / ".join(scenes[0].cameras)
    names = [scene.name for scene in scenes]
    print(f"\n### {title}\n\nPSNR in dB, {distances}.\n")
    heads = ["conversion", "triangles a splat", "vertices a splat", "MB", "s", *names]
    heads += ["mean"] if len(scenes) > 1 else []
    print("| " + " | ".join(heads) + " |")
    print("|---" * len(heads) + "|")
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
        print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="folder of real data")
    parser.add_argument("--scene", nargs="+", metavar="FILE", help="a splat file and its camera files")
    parser.add_argument("--views", type=int, default=8, help="views a distance, 1 to 8")
    parser.add_argument("--quick", action="store_true", help="the presets alone")
    args = parser.parse_args()
    if args.scene and len(args.scene) < 2:
        parser.error("--scene needs a splat file and at least one camera file")

    scenes = load_scenes(args)
    counts = ", ".join(f"{scene.name} ({len(scene.cloud):,} splats)" for scene in scenes)
    print(f"Scenes: {counts}. {args.views} views a distance.")
    print(f"MB and s: arrays of the meshes, conversion; {os.cpu_count()} cores, {platform.machine()}.")
    print_table("Presets", scenes, PRESETS)
    if args.quick:
        return
    print_table("Flat, crossed, 3d", scenes, MODES)
    print_table("The default with one obj changed", scenes, VARIATIONS)
    grid = []
    for radius, sides, rim, footprint in product(*GRID.values()):
        options = dict(preset="paper", rim_radius=radius, sides=sides, rim_opacity=rim, footprint=footprint)
        grid.append((f"{radius} / {sides} / {rim} / {footprint}", options))
    print_table("Flat fans of the paper: rim_radius / sides / rim_opacity / footprint", scenes, grid)


if __name__ == "__main__":
    main()
