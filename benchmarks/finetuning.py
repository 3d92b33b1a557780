"""The gain of fine-tuning: PSNR on held-out views, before and after, preset by preset.

    python benchmarks/finetuning.py --data ../shared/data --minutes 2
    python benchmarks/finetuning.py --data ../shared/data --scenes lego --presets default --minutes 5

Splat files are scored at the cameras `DATA/cameras/*_mid.json` on white at degree 0, in the look that is
learned (`--look area`: means over pixels' areas, against the mesh at as many samples as it needs; `splats`:
the image of a viewer, against one sample); rendering the targets counts towards the time, scoring does not.
Photographs are scored on their held-out views: mean (median), then the same after a gain and an offset per
channel are fitted to each image. `--exposure` fits them to the training images, too.
`--clock processor` counts the processor time of all threads, divided by --processors, instead of the clock on
the wall: for machines that do other work at the same time.
"""

from __future__ import annotations

import argparse

from _common import PHOTOGRAPHED, SCENES, Report, Stopwatch, arguments, take_steps

import meshsplats as ms
from meshsplats.datasets.splat_targets import splat_views
from meshsplats.evaluation.report import evaluate
from meshsplats.finetuning import RunOptions, finetune, make_config, starting_mesh, worthwhile_views
from meshsplats.finetuning.config import worthwhile_zooms
from meshsplats.finetuning.state import State

ALL = SCENES | PHOTOGRAPHED


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("--scenes", nargs="+", default=list(ALL), choices=list(ALL))
    parser.add_argument("--presets", nargs="+", default=["default", "paper"])
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--steps", type=int, help="steps, instead of a time")
    parser.add_argument("--clock", choices=["wall", "processor"], default="wall")
    parser.add_argument("--processors", type=int, default=2, help="that processor time is divided by")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--sh-degree", type=int, default=0, help="of targets drawn from splats")
    parser.add_argument("--look", choices=["area", "splats"], default="area")
    parser.add_argument("--exposure", action="store_true", help="fit gains and offsets of the photographs")
    parser.add_argument("--test-views", type=int, default=40, help="most views to score")
    options = parser.parse_args()
    with Report(options) as report:
        report.table("scene", "preset", "triangles", "steps", "seconds", "splats", "converted", "tuned")
        for name in options.scenes:
            for preset in options.presets:
                report.row(*row(name, preset, options))


def row(name: str, preset: str, options: argparse.Namespace) -> tuple[object, ...]:
    scene = ALL[name]
    length = {"steps": options.steps} if options.steps else {"minutes": options.minutes}
    config = make_config(preset, **length, exposure=bool(scene.photographs and options.exposure))
    watch = Stopwatch()

    def seconds() -> float:
        return watch.wall if options.clock == "wall" else watch.idle(options.processors)

    cloud = scene.cloud(options.data)
    if scene.photographs:
        data = ms.load_dataset(
            options.data / scene.photographs, downscale=scene.downscale, background=scene.background
        )
        judged = ms.Dataset((), data.test[:: -(-len(data.test) // options.test_views)])
    else:
        drawn = {"look": options.look, "sh_degree": options.sh_degree}
        zooms = worthwhile_zooms(config, options.look, preset == "default" and cloud.kernel == "3dgs")
        count = worthwhile_views(config)
        data = ms.splat_dataset(cloud, train=count, test=1, zooms=zooms, threads=options.threads, **drawn)
        judged = ms.Dataset((), splat_views(cloud, scene.cameras(options.data), **drawn), look=options.look)
    cameras = [view.camera for view in data.train]
    of_images = None if scene.photographs else config
    mesh = starting_mesh(cloud, cameras, preset=preset, config=of_images, look=data.look)
    reports = []
    run = RunOptions(threads=options.threads, report_every=0, spent=seconds())
    if options.clock == "wall" or options.steps:
        tuned = finetune(mesh, ms.Dataset(data.train), config, run=run, on_progress=reports.append)
        steps = reports[-1].step
    else:
        state = State.begin(mesh, len(data.train), config, options.threads)
        length = 60 * options.minutes
        tuned, steps = take_steps(state, data.train, config, lambda step: seconds() / length)
    used = seconds()

    def psnr(mesh: ms.SplatMesh | None, splats: ms.GaussianCloud | None = None) -> str:
        scores = evaluate(
            mesh, judged, splats=splats, fit_exposure=bool(scene.photographs), threads=options.threads
        )
        method = scores.methods[-1]  # of splats, with all their spherical harmonics
        if not scene.photographs:
            return f"{method.mean('psnr'):.2f}"
        columns = ("psnr", "psnr_exposure")
        return ", ".join(f"{method.mean(column):.2f} ({method.median(column):.2f})" for column in columns)

    splats = psnr(None, cloud) if scene.photographs else ""
    label = f"{preset}, exposure" if config.exposure else preset
    cells = (name, label, f"{len(tuned.faces):,}", steps, f"{used:.0f}", splats, psnr(mesh), psnr(tuned))
    return cells


if __name__ == "__main__":
    main()
