"""A mesh drawn with a filter, at five sizes: dB against the splats' own images, and the cost of the filter.

    python benchmarks/fan_filter.py FILE.ply ...

Target: `render_splats`, degree 0, over white, one sample per pixel, at 200, 400, 800 and 1600 pixels from
four sides (elevation 20 degrees), and at 800 pixels from half as far (twice the focal length). Meshes are
drawn with one sample per pixel, too: converted by default, without a footprint, with `footprint="filter"` in
the modes crossed (the default) and flat, and the crossed one baked for the views of 800 pixels.

Costs are processor milliseconds of one thread, of an image and of one with its backward pass, without a
filter and with one of 1e-9 px^2, which does all its work and leaves the triangles as they are: the least of
several runs, in turns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from _common import Report, areas, arguments, images, in_turns, mean_psnr

from meshsplats import (
    Camera,
    GaussianCloud,
    SplatMesh,
    bake_filter,
    convert,
    load_gaussians,
    orbit,
    render,
)
from meshsplats.rendering.backward import TapedRendering

SIZES = (200, 400, 800, 1600)
TINY = 1e-9
"""A filter, px^2, that moves no triangle by as much as a pixel shows."""


def views(cloud: GaussianCloud) -> dict[str, list[Camera]]:
    cameras = orbit(cloud, 4, elevation=20, width=800, height=800)
    found = {str(side): [camera.scaled(side / 800) for camera in cameras] for side in SIZES}
    return found | {"near": [replace(camera, fx=2 * camera.fx, fy=2 * camera.fy) for camera in cameras]}


def costs(works: Sequence[Callable[[], object]], repeat: int) -> list[float]:
    """Least processor milliseconds of each, in turns."""
    return [1e3 * min(times.processor) for times in in_turns(works, repeat)]


def forward_and_backward(mesh: SplatMesh, camera: Camera, filter_px2: float) -> None:
    taped = TapedRendering(mesh.triangles._replace(filter_px2=filter_px2), camera, threads=1)
    points, colors = np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)
    taped.backward(np.ones_like(taped.color), None, None, vertices=points, colors=colors)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--repeat", type=int, default=25)
    asked = parser.parse_args()
    clouds = {path.stem: load_gaussians(path) for path in asked.files}
    with Report(asked) as report:
        time_filter(report, clouds, asked.repeat)
        score_filter(report, clouds)


def time_filter(report: Report, clouds: dict[str, GaussianCloud], repeat: int) -> None:
    report.table("", "triangles", "pixels", "image", "with a filter", "and backward", "with a filter")
    for name, cloud in clouds.items():
        mesh = convert(cloud, footprint="none")
        for side in (400, 800):
            camera = views(cloud)[str(side)][0]
            works = [
                partial(function, mesh, camera, filter_px2=px2)
                for function in (partial(render, threads=1), forward_and_backward)
                for px2 in (0, TINY)
            ]
            cells = (f"{milliseconds:.1f}" for milliseconds in costs(works, repeat))
            report.row(name, f"{len(mesh.faces):,}", side, *cells)


def score_filter(report: Report, clouds: dict[str, GaussianCloud]) -> None:
    report.table("", "", *SIZES, "near")
    for name, cloud in clouds.items():
        views_of = views(cloud)
        targets = {
            size: areas(cloud, cameras, look="splats", sh_degree=0) for size, cameras in views_of.items()
        }
        filtered = convert(cloud, footprint="filter")
        for kind, mesh in {
            "default": convert(cloud),
            "footprint none": convert(cloud, footprint="none"),
            "filter": filtered,
            "filter, flat": convert(cloud, footprint="filter", mode="flat"),
            "filter, baked for 800": bake_filter(filtered, views_of["800"]),
        }.items():
            scores = (mean_psnr(images(mesh, cameras), targets[size]) for size, cameras in views_of.items())
            report.row(name, kind, *(f"{score:.1f}" for score in scores))


if __name__ == "__main__":
    main()
