"""A mesh drawn with a filter, at five sizes: dB against the splats' own pictures, and what the filter costs.

    python benchmarks/fan_filter.py FILE.ply ...

Truth: `render_splats`, degree 0, over white, one sample a pixel, at 200, 400, 800 and 1600 pixels from four sides
(elevation 20 degrees), and at 800 pixels from half as far (twice the focal length). Meshes are drawn with one sample a
pixel, too: converted by default, without a footprint, with `footprint="filter"` in the modes crossed (the default) and
flat, and the crossed one baked for the views of 800 pixels.

Costs are processor milliseconds of one thread, medians: the picture of the triangles as the filter leaves them (drawn
as they are), the same by the filter, and both with the way back. The difference is the filter's own; that wider
triangles cover more samples is not.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshsplats import (
    Camera,
    SplatMesh,
    bake_filter,
    convert,
    load_gaussians,
    orbit,
    psnr,
    render,
    render_splats,
)
from meshsplats.rendering import reference
from meshsplats.rendering.recorded import RecordedPicture

SIZES = (200, 400, 800, 1600)


def views(cloud) -> dict[str, list[Camera]]:
    cameras = orbit(cloud, 4, elevation=20, width=800, height=800)
    found = {str(side): [camera.scaled(side / 800) for camera in cameras] for side in SIZES}
    return found | {"near": [replace(camera, fx=2 * camera.fx, fy=2 * camera.fy) for camera in cameras]}


def moved(mesh: SplatMesh, camera: Camera) -> SplatMesh:
    """The triangles as the filter leaves them for a camera, to be drawn without it."""
    points = reference.filtered(reference._to_camera(mesh.vertices, camera), mesh, camera, mesh.filter_px2)
    rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return replace(mesh, vertices=((points - shift) @ rotation).astype(np.float32), filter_px2=0)


def cost(work: Callable[[], object], repeat: int) -> float:
    """Median processor milliseconds, after a first time."""
    work()
    seconds = []
    for _ in range(repeat):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return 1000 * statistics.median(seconds)


def back_and_forth(mesh: SplatMesh, camera: Camera) -> None:
    picture = RecordedPicture(
        mesh.vertices,
        mesh.faces,
        mesh.colors,
        None,
        camera,
        face_splat=mesh.face_splat,
        filter_px2=mesh.filter_px2,
        threads=1,
    )
    points, colors = np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)
    picture.back(np.ones_like(picture.color), None, None, vertices=points, colors=colors)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--repeat", type=int, default=9)
    asked = parser.parse_args()
    print(f"| | | {' | '.join(map(str, SIZES))} | near |\n|---|---|---|---|---|---|---|")
    clouds = {path.stem: load_gaussians(path) for path in asked.files}
    for name, cloud in clouds.items():
        places = views(cloud)
        truth = {
            size: [np.clip(render_splats(cloud, c, sh_degree=0).color, 0, 1) for c in cameras]
            for size, cameras in places.items()
        }
        filtered = convert(cloud, footprint="filter")
        meshes = {
            "default": convert(cloud),
            "footprint none": convert(cloud, footprint="none"),
            "filter": filtered,
            "filter, flat": convert(cloud, footprint="filter", mode="flat"),
            "filter, baked for 800": bake_filter(filtered, places["800"]),
        }
        for kind, mesh in meshes.items():
            scores = [
                np.mean(
                    [
                        psnr(np.clip(render(mesh, c).color, 0, 1), picture)
                        for c, picture in zip(cameras, truth[size], strict=True)
                    ]
                )
                for size, cameras in places.items()
            ]
            print(f"| {name} | {kind} | {' | '.join(f'{score:.1f}' for score in scores)} |", flush=True)
    print(
        "\n| | triangles | pixels | drawn as they are | by the filter | with the way back | by the filter |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, cloud in clouds.items():
        mesh = convert(cloud, footprint="filter")
        for side in (400, 800):
            camera = views(cloud)[str(side)][0]
            same = moved(mesh, camera)
            numbers = [
                cost(lambda: render(same, camera, threads=1), asked.repeat),
                cost(lambda: render(mesh, camera, threads=1), asked.repeat),
                cost(lambda: back_and_forth(same, camera), asked.repeat),
                cost(lambda: back_and_forth(mesh, camera), asked.repeat),
            ]
            cells = " | ".join(f"{number:.0f}" for number in numbers)
            print(f"| {name} | {len(mesh.faces):,} | {side} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
