"""A mesh drawn with a filter, at five sizes: dB against the splats' own pictures, and what the filter costs.

    python benchmarks/fan_filter.py FILE.ply ...

Truth: `render_splats`, degree 0, over white, one sample a pixel, at 200, 400, 800 and 1600 pixels from four
sides (elevation 20 degrees), and at 800 pixels from half as far (twice the focal length). Meshes are drawn
with one sample a pixel, too: converted by default, without a footprint, with `footprint="filter"` in the
modes crossed (the default) and flat, and the crossed one baked for the views of 800 pixels.

Costs are processor milliseconds of one thread, medians, of a picture and of one with its way back, without a
filter and with one of 1e-9 px^2: it does all its work, but triangles cover what they covered before.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from meshsplats import (
    Camera,
    GaussianCloud,
    SplatMesh,
    bake_filter,
    convert,
    load_gaussians,
    orbit,
    psnr,
    render,
    render_splats,
)
from meshsplats.rendering.backward import TapedRendering

SIZES = (200, 400, 800, 1600)
TINY = 1e-9
"""A filter, px^2, that moves no triangle by as much as a pixel shows."""


def views(cloud: GaussianCloud) -> dict[str, list[Camera]]:
    cameras = orbit(cloud, 4, elevation=20, width=800, height=800)
    found = {str(side): [camera.scaled(side / 800) for camera in cameras] for side in SIZES}
    return found | {"near": [replace(camera, fx=2 * camera.fx, fy=2 * camera.fy) for camera in cameras]}


def score(mesh: SplatMesh, cameras: list[Camera], truth: list[np.ndarray]) -> float:
    drawn = [np.clip(render(mesh, camera).color, 0, 1) for camera in cameras]
    return float(np.mean([psnr(a, b) for a, b in zip(drawn, truth, strict=True)]))


def cost(work: Callable[[], object], repeat: int) -> float:
    """Median processor milliseconds, after a first time."""
    work()
    seconds = []
    for _ in range(repeat):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return 1000 * statistics.median(seconds)


def back_and_forth(mesh: SplatMesh, camera: Camera, filter_px2: float) -> None:
    picture = TapedRendering(
        mesh.vertices,
        mesh.faces,
        mesh.colors,
        None,
        camera,
        face_splat=mesh.face_splat,
        filter_px2=filter_px2,
        threads=1,
    )
    points, colors = np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)
    picture.backward(np.ones_like(picture.color), None, None, vertices=points, colors=colors)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--repeat", type=int, default=9)
    asked = parser.parse_args()
    clouds = {path.stem: load_gaussians(path) for path in asked.files}
    print("| | triangles | pixels | picture | with a filter | and back | with a filter |")
    print("|---|---|---|---|---|---|---|")
    for name, cloud in clouds.items():
        mesh = convert(cloud, footprint="none")
        for side in (400, 800):
            camera = views(cloud)[str(side)][0]
            numbers = [
                cost(partial(way, mesh, camera, filter_px2=px2), asked.repeat)
                for way in (partial(render, threads=1), back_and_forth)
                for px2 in (0, TINY)
            ]
            cells = " | ".join(f"{number:.0f}" for number in numbers)
            print(f"| {name} | {len(mesh.faces):,} | {side} | {cells} |", flush=True)
    print(f"\n| | | {' | '.join(map(str, SIZES))} | near |\n|---|---|---|---|---|---|---|")
    for name, cloud in clouds.items():
        places = views(cloud)
        truth = {
            size: [np.clip(render_splats(cloud, camera, sh_degree=0).color, 0, 1) for camera in cameras]
            for size, cameras in places.items()
        }
        filtered = convert(cloud, footprint="filter")
        for kind, mesh in {
            "default": convert(cloud),
            "footprint none": convert(cloud, footprint="none"),
            "filter": filtered,
            "filter, flat": convert(cloud, footprint="filter", mode="flat"),
            "filter, baked for 800": bake_filter(filtered, places["800"]),
        }.items():
            scores = [score(mesh, cameras, truth[size]) for size, cameras in places.items()]
            print(f"| {name} | {kind} | {' | '.join(f'{s:.1f}' for s in scores)} |", flush=True)


if __name__ == "__main__":
    main()
