"""What view-dependent colours are worth and cost, by degree of the harmonics.

    python benchmarks/view_dependence.py --data ../shared/data
    python benchmarks/view_dependence.py --data ../shared/data --splats FILE --steps 150
    python benchmarks/view_dependence.py --data ../shared/data --splats FILE --steps 300 --opacity cutoff

PSNR of conversions against the splats with all their harmonics, look "area", in eight views from around, in
both orders of blending, and of the splats themselves at that degree; processor milliseconds of shading, and
of a picture of 800 pixels with it. With --steps, instead, of a fine-tuning of that many steps, on views that
it was not tuned on, and of what programs without harmonics then show (``plain``). Sizes of files:
view_colors.py.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from _common import PHOTOGRAPHED, SCENES, Report, Stopwatch, areas, arguments, images, mean_psnr

import meshsplats as ms
from meshsplats.finetuning import make_config, starting_mesh
from meshsplats.formats.cutting import cut_mesh
from meshsplats.rendering.shading import Shading

VIEWS, SIDE, LARGE = 8, 400, 800
REPEATS = 5


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("--splats", type=Path, nargs="+", help="these files, in place of playbot and lego")
    parser.add_argument("--steps", type=int, default=0)
    parser.add_argument(
        "--opacity", default="blended", choices=("blended", "cutoff"), help="of the fine-tuning"
    )
    parser.add_argument("--degrees", type=int, nargs="+", help="these, in place of all")
    options = parser.parse_args()
    known = [SCENES["playbot"].splats, PHOTOGRAPHED["lego-sh3"].splats]
    paths = options.splats or [options.data / "splats" / name for name in known]
    with Report(options) as report:
        if options.steps:
            report.table(
                *("scene", "degree", "steps", "triangles", "dB, converted", "dB, tuned", "dB, plain"),
                "processor s",
            )
            for path in paths:
                tunings(report, path, options)
            return
        report.table(
            *("scene", "degree", "dB, splats", "dB, fragment", "dB, splat"),
            *("shading ms a million triangles", "picture ms", "of it shading"),
        )
        for path in paths:
            conversions(report, path, options)


def degrees(cloud: ms.GaussianCloud, options: argparse.Namespace) -> list[int]:
    return options.degrees or list(range(cloud.sh_degree + 1))


def conversions(report: Report, path: Path, options: argparse.Namespace) -> None:
    cloud = ms.load_gaussians(path)
    cameras = ms.orbit(cloud, VIEWS, width=SIDE, height=SIDE)
    truths = areas(cloud, cameras)
    large = cameras[0].scaled(LARGE / SIDE)
    whole = ms.convert(cloud)
    for degree in degrees(cloud, options):
        mesh = whole.of_degree(degree)
        own = mean_psnr(areas(cloud.of_degree(degree), cameras), truths) if degree < cloud.sh_degree else None
        found = [
            f"{mean_psnr(images(mesh, cameras, samples=2, order=order), truths):.2f}"
            for order in ("fragment", "splat")
        ]
        watch = Stopwatch()
        for _ in range(REPEATS):
            ms.render(mesh, large)
        picture = watch.processor / REPEATS
        shading = 0.0
        if degree:
            watch = Stopwatch()
            for _ in range(REPEATS):
                Shading(mesh.triangles, large)
            shading = watch.processor / REPEATS
        report.row(
            *(path.stem, degree, "" if own is None else f"{own:.2f}", *found),
            f"{1e9 * shading / len(mesh.faces):.1f}",
            f"{1e3 * picture:.0f}",
            f"{shading / picture:.1%}",
        )


def tunings(report: Report, path: Path, options: argparse.Namespace) -> None:
    cloud = ms.load_gaussians(path)
    data = ms.splat_dataset(cloud, train=100, test=VIEWS, width=SIDE, height=SIDE)
    config = make_config(steps=options.steps, opacity=options.opacity)
    start = starting_mesh(cloud, [view.camera for view in data.train], config=config)
    cameras = [view.camera for view in data.test]
    truths = [view.image for view in data.test]
    for degree in degrees(cloud, options):
        before = start.of_degree(degree)
        watch = Stopwatch()
        tuned = ms.finetune(before, replace(data), config)
        seconds = watch.processor
        found = [
            f"{mean_psnr(images(mesh, cameras, samples=2), truths):.2f}"
            for mesh in (cut_mesh(before, config.cutoff) if config.cuts else before, tuned, tuned.plain)
        ]
        report.row(path.stem, degree, options.steps, f"{len(tuned.faces):,}", *found, f"{seconds:.0f}")


if __name__ == "__main__":
    main()
