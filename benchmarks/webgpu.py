"""Work and time of the GPU on the random fans of rendering.py, beside the core.

    python benchmarks/webgpu.py [--scenes 160k 1M 4M] [--mesh FILE --side 400] [--repeat 3]

Prints a Markdown table: difference from the core (PSNR, pixels off by more than 1e-3), tests of a triangle at
a sample per blended fragment, walks through a tile list per tile, samples whose first queue was too short,
dispatches of a frame, megabytes of buffers, and medians of wall time and processor time in milliseconds.
Times on a software adapter (named in the first line) say nothing about a GPU.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from rendering import SCENES, random_fans

from meshsplats import Camera, SplatMesh, load_mesh, orbit, psnr, render
from meshsplats.webgpu.device import open_device
from meshsplats.webgpu.renderer import DrawSettings, draw


def measure(name: str, mesh: SplatMesh, view: Camera, repeat: int) -> str:
    settings = DrawSettings(filter_px2=mesh.filter_px2)
    drawn = draw(mesh, view, settings)  # compiles
    walls, processors, cores = [], [], []
    for _ in range(repeat):
        start, cpu = time.perf_counter(), time.process_time()
        drawn = draw(mesh, view, settings)
        walls.append(1000 * (time.perf_counter() - start))
        processors.append(1000 * (time.process_time() - cpu))
        start = time.perf_counter()
        expected = render(mesh, view, background=(0, 0, 0))
        cores.append(1000 * (time.perf_counter() - start))
    error = np.abs(drawn.color - expected.color).max(axis=2)
    likeness = psnr(drawn.color, expected.color)
    work = drawn.work
    values = (
        name,
        f"{len(mesh.faces):,}",
        f"{view.width} x {view.height}",
        f"{likeness:.1f}" if np.isfinite(likeness) else "same",
        f"{int((error > 1e-3).sum())}",
        f"{work.tests / max(work.fragments, 1):.2f}",
        f"{work.walks / work.tiles:.3f}",
        f"{work.overflowed:,}",
        f"{work.dispatches}",
        f"{work.bytes / 1e6:.0f}",
        f"{statistics.median(walls):.0f}",
        f"{statistics.median(processors):.0f}",
        f"{statistics.median(cores):.0f}",
    )
    return "| " + " | ".join(values) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="*", default=["160k", "1M"], choices=list(SCENES))
    parser.add_argument("--mesh", type=Path, nargs="*", default=[])
    parser.add_argument("--side", type=int, default=400)
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    print(f"{open_device().name}\n", flush=True)
    columns = (
        *("scene", "triangles", "image", "dB", "> 1e-3", "tests a fragment", "walks a tile", "overflowed"),
        *("dispatches", "MB", "ms", "processor ms", "core ms"),
    )
    print("| " + " | ".join(columns) + " |\n|" + "---|" * len(columns), flush=True)
    for name in options.scenes:
        print(measure(name, *random_fans(*SCENES[name]), options.repeat), flush=True)
    for path in options.mesh:
        mesh = load_mesh(path)
        view = orbit(mesh, 4, width=options.side, height=options.side)[1]
        print(measure(path.stem, mesh, view, options.repeat), flush=True)


if __name__ == "__main__":
    main()
