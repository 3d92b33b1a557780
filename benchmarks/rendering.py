"""Speed and memory of the renderer and of its backward pass, on random fans of 8 triangles.

    python benchmarks/rendering.py [--repeat 5] [--threads 1 2] [--scenes 160k 1M 4M] [--order fragment splat]
    python benchmarks/rendering.py --growth --threads 1

render: an image. tape: the same, recording a tape. backward: gradients of positions and colours from that of
the image. Medians of wall time in milliseconds; fragments blended per pixel, and per second by render;
nanoseconds of tape and backward together per fragment; the peak of the process's memory above its start, of
render, and of tape and backward without the gradients (Linux). Each row runs in a process of its own.
--order fragment is exact at every pixel, splat draws whole splats by their centres. --growth: one scene, then
four times as many triangles of a quarter of the size, four times as many pixels, and four times as many
layers (triangles of a quarter of the opacity).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
from _common import FANS, Report, alone, arguments, median_ms, random_fans

from meshsplats.rendering import render
from meshsplats.rendering.backward import TapedRendering
from meshsplats.scene.order import Order

GROWTH = {
    "one": (31_250, 0.029, 0.05, 400),
    "triangles": (125_000, 0.0145, 0.05, 400),
    "pixels": (31_250, 0.029, 0.05, 800),
    "layers": (125_000, 0.029, 0.0125, 400),
}


def memory(what: str, *, reset: bool = False) -> int:
    """Bytes of this process: VmRSS now or VmHWM, the most since the last reset. Linux only."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(what)).split()[1])


def measure(name: str, order: Order, threads: int, repeat: int) -> list[str]:
    mesh, camera = random_fans(*(FANS | GROWTH)[name])
    mesh = replace(mesh, order=order)
    towards = np.random.default_rng(1).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    points, colors = np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)

    def taped() -> TapedRendering:
        return TapedRendering(mesh.triangles, camera, threads=threads)

    before = memory("VmRSS", reset=True)
    fragments = render(mesh, camera, threads=threads).fragments
    drawing = memory("VmHWM") - before
    before = memory("VmRSS", reset=True)
    rendering = taped()
    rendering.backward(towards, None, None, vertices=points, colors=colors)
    both = memory("VmHWM") - before

    draw = median_ms(lambda: render(mesh, camera, threads=threads), repeat)
    tape = median_ms(taped, repeat)
    backward = median_ms(
        lambda: rendering.backward(towards, None, None, vertices=points, colors=colors), repeat
    )
    pixels = camera.width * camera.height
    return [
        f"{len(mesh.faces):,}",
        f"{camera.width} x {camera.height}",
        order,
        f"{threads}",
        f"{fragments / pixels:.1f}",
        *(f"{ms:.0f}" for ms in (draw, tape, backward, tape + backward)),
        f"{fragments / draw / 1e3:.1f}",
        f"{1e6 * (tape + backward) / fragments:.1f}",
        f"{drawing / 1e6:.0f}",
        f"{both / 1e6:.0f}",
    ]


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--scenes", nargs="+", choices=FANS, default=list(FANS))
    parser.add_argument("--order", nargs="+", choices=get_args(Order), default=["fragment"])
    parser.add_argument("--growth", action="store_true", help="how time grows, in place of --scenes")
    asked = parser.parse_args()
    with Report(asked) as report:
        report.table(
            *("triangles", "image", "order", "threads", "fragments a pixel", "render", "tape", "backward"),
            *("tape + backward", "M fragments a second", "ns a fragment"),
            *("MB, render", "MB, tape + backward"),
        )
        for name in GROWTH if asked.growth else asked.scenes:
            for threads in asked.threads:
                for order in asked.order:
                    report.row(*alone(measure, name, order, threads, asked.repeat))


if __name__ == "__main__":
    main()
