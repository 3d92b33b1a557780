"""Processor time of the core as two compilers make it, interleaved in one process.

    python benchmarks/compilers.py gcc=build/native zig=build/wheels/... [--repeat 6] [--variants v3 v4]

Each argument names a folder with libraries of the core. Milliseconds, minimum and median, with one thread: an
image of a mesh of 160,000 triangles, the same with a tape, its backward pass, and an image of our own scene
of 20,000 splats, all of 400 x 400 pixels. The last column is the second compiler's minimum by the first's.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from pathlib import Path

import numpy as np
from _common import FANS, Report, Stopwatch, arguments, random_fans

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
    parser = arguments(__doc__)
    parser.add_argument("folders", nargs=2, metavar="NAME=FOLDER")
    parser.add_argument("--repeat", type=int, default=6)
    parser.add_argument("--variants", nargs="+", default=["v3", "v4"])
    asked = parser.parse_args()
    folders = {name: Path(folder) for name, folder in (text.split("=", 1) for text in asked.folders)}
    with Report(asked) as report:
        compare(report, folders, asked.variants, asked.repeat)


def compare(report: Report, folders: dict[str, Path], variants: list[str], repeat: int) -> None:
    mesh, camera = random_fans(*FANS["160k"])
    cloud = demo_scene.make_scene()
    (view,) = orbit(cloud, 1, elevation=20, width=400, height=400)
    gradient = np.random.default_rng(1).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    points, colors = np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)

    def taped() -> TapedRendering:
        return TapedRendering(mesh.triangles, camera, threads=1)

    report.table("variant, work", *folders, "ratio")
    for variant in variants:
        cores = {name: load(folder, variant) for name, folder in folders.items()}
        found: dict[str, dict[str, list[float]]] = {}

        def clock(work: str, name: str, action: Callable[[], object], found=found) -> object:
            watch = Stopwatch()
            result = action()
            found.setdefault(work, {}).setdefault(name, []).append(1e3 * watch.processor)
            return result

        for _ in range(repeat + 1):
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
        for work, by_name in found.items():
            times = [values[1:] for values in by_name.values()]
            first, second = map(min, times)
            cells = (f"{min(values):.1f} / {statistics.median(values):.1f}" for values in times)
            report.row(f"{variant} {work}", *cells, f"{second / first:.2f}")


if __name__ == "__main__":
    main()
