"""Processor time of the core as two compilers make it, interleaved in one process.

    python benchmarks/compilers.py gcc=build/native zig=build/wheels/... [--repeat 6] [--variants v3 v4]

Each argument names a folder with libraries of the core. Prints a Markdown table of milliseconds, minimum and
median, with one thread: an image of a mesh of 160,000 triangles, the same with a tape, its backward pass, and
an image of our own scene of 20,000 splats, all of 400 x 400 pixels. The last column is the second compiler's
minimum by the first's.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rendering import SCENES, random_fans

from meshsplats import demo_scene, orbit, render, render_splats
from meshsplats._core import library
from meshsplats.rendering.backward import TapedRendering

LOAD_CORE = library.load_core.__wrapped__


def load(folder: Path, variant: str):
    """A core from a folder, beside those that are loaded already."""
    library.library_path = lambda name: (
        path if (path := folder / f"meshsplats_{name}{library.SUFFIX}").is_file() else None
    )
    return LOAD_CORE(variant)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs=2, metavar="NAME=FOLDER")
    parser.add_argument("--repeat", type=int, default=6)
    parser.add_argument("--variants", nargs="+", default=["v3", "v4"])
    args = parser.parse_args()
    folders = {name: Path(folder) for name, folder in (text.split("=", 1) for text in args.folders)}

    mesh, camera = random_fans(*SCENES["160k"])
    cloud = demo_scene.make_scene()
    (view,) = orbit(cloud, 1, elevation=20, width=400, height=400)
    gradient = np.random.default_rng(1).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    points, colors = np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)

    def taped() -> TapedRendering:
        return TapedRendering(mesh.triangles, camera, threads=1)

    print("| variant, work | " + " | ".join(folders) + " | ratio |\n|---|---|---|---|", flush=True)
    for variant in args.variants:
        cores = {name: load(folder, variant) for name, folder in folders.items()}
        seconds: dict[str, dict[str, list[float]]] = {}

        def clock(work: str, name: str, action: Callable[[], object], seconds=seconds) -> object:
            start = time.process_time()
            result = action()
            seconds.setdefault(work, {}).setdefault(name, []).append(time.process_time() - start)
            return result

        for _ in range(args.repeat + 1):
            for name, core in cores.items():
                library.load_core = lambda variant=None, core=core: core
                clock("render", name, lambda: render(mesh, camera, threads=1))
                tape = clock("tape", name, taped)
                clock(
                    "backward",
                    name,
                    lambda tape=tape: tape.backward(gradient, None, None, vertices=points, colors=colors),
                )
                del tape
                clock("splats", name, lambda: render_splats(cloud, view, threads=1))
        for work, by_name in seconds.items():
            least = {name: min(values[1:]) for name, values in by_name.items()}
            first, second = least.values()
            cells = [
                f"{1000 * least[name]:.1f} / {1000 * statistics.median(values[1:]):.1f}"
                for name, values in by_name.items()
            ]
            print(f"| {variant} {work} | " + " | ".join(cells) + f" | {second / first:.2f} |", flush=True)


if __name__ == "__main__":
    main()
