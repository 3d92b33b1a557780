"""Silhouettes and images of a surface fitted to photographs with masks, on views that are held out.

    python benchmarks/surface_silhouettes.py --data ../shared/data

DTU 65, photographs of half the size, cut out by their masks: a short training, and the surface of its mesh.
The silhouette of an image is its pixels with an alpha of at least a half; IoU is the share of two silhouettes
that is in both. Images are compared on white. Seconds are those of the processor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from _common import DATA, Report, Stopwatch, arguments

import meshsplats as ms
from meshsplats.datasets.views import View
from meshsplats.finetuning import RunOptions

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
Draw = Callable[[ms.Camera, tuple[float, float, float]], np.ndarray]


def scores(views: Sequence[View], draw: Draw) -> tuple[str, str, str]:
    """Mean and least IoU, and mean PSNR in dB."""
    shares, errors = [], []
    for view in views:
        image, drawn = view.load(), draw(view.camera, WHITE)
        assert view.alpha is not None
        own, true = 1 - (drawn - draw(view.camera, BLACK)).mean(axis=2) >= 0.5, view.alpha >= 0.5
        shares.append((own & true).sum() / (own | true).sum())
        errors.append(ms.psnr(drawn, image.over(WHITE)))
    return f"{np.mean(shares):.4f}", f"{np.min(shares):.4f}", f"{np.mean(errors):.2f}"


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--fans", type=int, default=15_000)
    parser.add_argument("--texture", type=int, default=1024)
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    threads = options.threads
    with Report(options) as report:
        data = ms.load_dataset(options.data / "photos/dtu65", masks="subject", downscale=2)
        report.table("dtu65", "triangles", "IoU", "least", "dB", "seconds")
        watch, run = Stopwatch(), RunOptions(threads=threads)
        mesh = ms.train(data, steps=options.steps, max_splats=options.fans, run=run)
        seconds = f"{watch.processor:.0f}"

        def trained(camera: ms.Camera, background: tuple[float, float, float]) -> np.ndarray:
            return ms.render(mesh, camera, background=background, samples=2, threads=threads).color

        report.row("trained", f"{len(mesh.faces):,}", *scores(data.test, trained), seconds)
        watch = Stopwatch()
        surface = ms.make_surface(mesh, data, shape="closed", texture=options.texture, threads=threads)
        seconds = f"{watch.processor:.0f}"

        def drawn(camera: ms.Camera, background: tuple[float, float, float]) -> np.ndarray:
            return ms.draw_surface(surface, camera, background=background, threads=threads)

        report.row("surface", f"{len(surface.faces):,}", *scores(data.test, drawn), seconds)


if __name__ == "__main__":
    main()
