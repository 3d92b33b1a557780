"""A mesh tuned for one order of blending, shown in each: exact, by the splat, and in the order of a file.

    python benchmarks/orders.py SPLATS [SPLATS ...] [--steps 150] [--threads 2]

PSNR in dB at 400 pixels and 2 x 2 samples against means over pixels of the splats at degree 0, on white, in
eight views at elevations of 5 and 30 degrees. All runs begin as the same conversion and see the same views,
an object's from below, too.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from _common import Report, Stopwatch, areas, arguments

import meshsplats as ms
from meshsplats.rendering.looks import image_of

ELEVATIONS = (5, 30)
TRAINING_VIEWS = 120


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", type=Path, nargs="+")
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--threads", type=int)
    args = parser.parse_args()
    with Report(args) as report:
        report.table("scene", "tuned for", "processor s", "exact", "by the splat", "in the file")
        for path in args.splats:
            measure(path, args.steps, args.threads, report)


def measure(path: Path, steps: int, threads: int | None, report: Report) -> None:
    cloud = ms.load_gaussians(path)
    mesh = ms.convert(cloud, colors="base")
    lens = {"width": 400, "height": 400}
    views = [view for e in ELEVATIONS for view in ms.orbit(mesh, 4, elevation=e, azimuth=10 + e, **lens)]
    truths = areas(cloud, views, sh_degree=0)
    dataset = ms.splat_dataset(
        cloud, train=TRAINING_VIEWS, test=1, sh_degree=0, zooms=(1,) * 5 + (2,), below=True, threads=threads
    )
    for view in dataset.train:
        view.load()
    order = ms.drawing_order(mesh, [view.camera for view in dataset.train], threads=threads)
    run = ms.RunOptions(threads=threads, report_every=0)

    def row(name: str, shown: ms.SplatMesh, watch: Stopwatch | None = None) -> None:
        seconds = "-" if watch is None else f"{watch.processor:.0f}"
        scores = []
        for own, listing in (
            (replace(shown, order="fragment"), None),
            (replace(shown, order="splat"), None),
            (shown, order),
        ):
            images = [image_of(own, v, (1, 1, 1), samples=2, listing=listing)[0].clip(0, 1) for v in views]
            pairs = zip(images, truths, strict=True)
            scores.append(f"{np.mean([ms.psnr(image, truth) for image, truth in pairs]):.1f}")
        report.row(path.stem, name, seconds, *scores)

    row("none (converted)", mesh)
    fixed = {"steps": steps, "prune_epochs": 0, "run": run}  # the order is that of all triangles
    for name in ("fragment", "splat"):
        watch = Stopwatch()
        tuned = ms.finetune(mesh, dataset, order=name, **fixed)
        row(name, tuned, watch)
    watch = Stopwatch()
    row("file", ms.finetune_ordered(mesh, order, dataset, **fixed).mesh, watch)


if __name__ == "__main__":
    main()
