"""Estimated and actual cost of images: fragments by ``rendering.layers``, and processor seconds.

    python benchmarks/image_cost.py SPLATS... [--side 400]

The last line is a scene of 20,000 splats as large as the scene, drawn smaller: files that hold scales where
their logarithms belong are read so.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from _common import Report, Stopwatch, arguments

from meshsplats import GaussianCloud, convert, load_gaussians, orbit, render
from meshsplats.rendering.layers import fragments, layers
from meshsplats.rendering.samples import needed_samples

RUNAWAY_SIDE = 60


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", nargs="+", type=Path)
    parser.add_argument("--side", type=int, default=400, help="side of the images, pixels")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    with Report(asked) as report:
        report.table(
            *("scene", "triangles", "side", "samples", "layers", "fragments"),
            *("processor s", "fragments a second"),
        )
        for path in asked.splats:
            measure(report, path.name, load_gaussians(path), asked.side)
        measure(report, "runaway", runaway(), RUNAWAY_SIDE)


def runaway() -> GaussianCloud:
    """Splats on a sphere of radius 1, of standard deviation 1.018."""
    rng = np.random.default_rng(0)
    count = 20_000
    means = rng.normal(size=(count, 3))
    means /= np.linalg.norm(means, axis=1)[:, None]
    turns = np.tile([1, 0, 0, 0], (count, 1))
    sh = rng.normal(size=(count, 1, 3))
    return GaussianCloud(means, turns, np.full((count, 3), 1.018), np.full(count, 0.953), sh)


def measure(report: Report, name: str, cloud: GaussianCloud, side: int) -> None:
    """Adds a row about ``cloud``."""
    mesh = convert(cloud)
    camera = orbit(mesh, 1, azimuth=30, width=side, height=side)[0]
    samples = needed_samples(mesh, [camera])
    count, cost = layers(mesh, camera), fragments(mesh, camera, samples)
    watch = Stopwatch()
    render(mesh, camera, samples=samples)
    seconds = watch.processor
    report.row(
        *(name, f"{len(mesh.faces):,}", side, samples, f"{count:,.0f}", f"{cost:.1e}"),
        *(f"{seconds:.2f}", f"{cost / seconds:.1e}"),
    )


if __name__ == "__main__":
    main()
