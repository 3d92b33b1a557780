"""Training from photographs alone: PSNR on held-out views, and what each choice is worth.

    python benchmarks/training.py --data ../shared/data --scenes lego snowmiku --steps 2800
    python benchmarks/training.py --data ../shared/data --scenes lego --steps 600 --downscale 2 --vary

The seconds are processor time of all threads divided by --processors, so that other work on the machine
does not count; reading and matching photographs does. --vary trains with one choice changed at a time: no
growth, all images at full size, other numbers of fans at the start and sides.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import meshsplats as ms

DOWNSCALES = {"lego": 1, "snowmiku": 2}
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "no growth": {"growth_events": 0},
    "start with all fans, no growth": {"growth_events": 0, "start_splats": 100_000},
    "all images at full size": {"quarter_share": 0.0, "half_share": 0.0},
    "20,000 fans at the start": {"start_splats": 20_000},
    "4 sides": {"sides": 4},
    "8 sides": {"sides": 8},
    "position rates of short runs": {"rate_steps": 250},
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder with photos/")
    parser.add_argument("--scenes", nargs="+", choices=DOWNSCALES, default=list(DOWNSCALES))
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--downscale", type=int, default=1, help="further factor of the images' sides")
    parser.add_argument("--max-splats", type=int, default=100_000)
    parser.add_argument("--vary", action="store_true", help="all variants, not the default alone")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--processors", type=int, default=2, help="that processor time is divided by")
    options = parser.parse_args()
    print("| scene | variant | fans | seconds | PSNR (median) | exposure fitted |")
    print("|---|---|---|---|---|---|")
    for name in options.scenes:
        for variant in VARIANTS if options.vary else ("default",):
            print(row(name, variant, options), flush=True)


def row(name: str, variant: str, options: argparse.Namespace) -> str:
    start = time.process_time()
    folder = options.data / "photos" / name
    data = ms.load_dataset(folder, downscale=DOWNSCALES[name] * options.downscale)
    if data.train[0].alpha is None:
        data = data.over((0, 0, 0))
    changes = {"max_splats": options.max_splats, **VARIANTS[variant]}
    config = ms.train_config(steps=options.steps, **changes)
    run = ms.RunOptions(threads=options.threads)
    mesh = ms.train(ms.Dataset(data.train), config, points=ms.load_points(folder), run=run)
    seconds = (time.process_time() - start) / options.processors
    method = ms.evaluate(mesh, data, fit_exposure=True, threads=options.threads).method("mesh")
    fans = len(mesh.vertices) // (1 + config.sides)
    psnr = f"{method.mean('psnr'):.2f} ({method.median('psnr'):.2f})"
    return f"| {name} | {variant} | {fans:,} | {seconds:.0f} | {psnr} | {method.mean('psnr_exposure'):.2f} |"


if __name__ == "__main__":
    main()
