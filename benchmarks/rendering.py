"""Speed and memory of the renderer and of its backward pass, on random fans of 8 triangles.

    python benchmarks/rendering.py [--repeat 5] [--threads 1 2] [--scenes 160k 1M 4M]
    python benchmarks/rendering.py --growth --threads 1

Prints a Markdown table. render: an image, exact at every pixel. tape: the same, recording a tape. backward:
gradients of positions and colours from that of the image. Medians of wall time in milliseconds; fragments
blended per pixel, and per second by render; nanoseconds of tape and backward together per fragment; the peak
of the process's memory above its start, of render, and of tape and backward without the gradients (Linux).
Each row runs in a process of its own. --growth: one scene, then four times as many triangles of a quarter of
the size, four times as many pixels, and four times as many layers (triangles of a quarter of the opacity).
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from meshsplats._core.library import available_variants
from meshsplats.camera import Camera
from meshsplats.mesh import SplatMesh
from meshsplats.rendering import render
from meshsplats.rendering.backward import TapedRendering

SCENES = {
    "160k": (20_000, 0.03, 0.04, 400),
    "1M": (125_000, 0.0145, 0.05, 800),
    "4M": (500_000, 0.006, 0.06, 800),
}
"""Fans, their radius at depth 1, opacity, side of the image in pixels."""

GROWTH = {
    "one": (31_250, 0.029, 0.05, 400),
    "triangles": (125_000, 0.0145, 0.05, 400),
    "pixels": (31_250, 0.029, 0.05, 800),
    "layers": (125_000, 0.029, 0.0125, 400),
}


def random_fans(fans: int, radius: float, opacity: float, side: int) -> tuple[SplatMesh, Camera]:
    """Fans of random orientation between the depths 2.5 and 5, in front of the whole image."""
    rng = np.random.default_rng(0)
    centers = np.stack([rng.uniform(-1, 1, fans), rng.uniform(-1, 1, fans), rng.uniform(2.5, 5, fans)], 1)
    centers[:, :2] *= centers[:, 2:] / 2
    a = rng.normal(size=(fans, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = rng.normal(size=(fans, 3))
    b -= (a * b).sum(1, keepdims=True) * a
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    size = radius * np.exp(rng.normal(0, 0.4, fans)) * centers[:, 2]
    angle = np.arange(8) * np.pi / 4
    circle = np.cos(angle)[:, None] * a[:, None] + np.sin(angle)[:, None] * b[:, None]
    rim = centers[:, None] + size[:, None, None] * circle
    vertices = np.concatenate([centers[:, None], rim], 1).reshape(-1, 3)
    i = np.arange(8)
    fan = np.stack([0 * i, 1 + i, 1 + (i + 1) % 8], 1)
    faces = (fan[None] + 9 * np.arange(fans)[:, None, None]).reshape(-1, 3)
    rgb = np.repeat(rng.uniform(0, 1, (fans, 1, 3)), 9, 1)
    alpha = np.broadcast_to(np.array([2] + 8 * [0.2])[None, :, None] * opacity, (fans, 9, 1))
    colors = np.concatenate([rgb, alpha], 2).reshape(-1, 4)
    camera = Camera(np.eye(4), side, side, side / 2, side / 2, side, side)
    return SplatMesh(vertices, faces, colors, np.repeat(np.arange(fans), 8)), camera


def memory(what: str, *, reset: bool = False) -> int:
    """Bytes of this process: VmRSS now or VmHWM, the most since the last reset. Linux only."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(what)).split()[1])


def clocked(work: Callable[[], object], repeat: int) -> float:
    """Median of the seconds that ``work`` takes, after a first time."""
    work()
    seconds = []
    for _ in range(repeat):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def run(name: str, threads: int, repeat: int) -> None:
    mesh, camera = random_fans(*(SCENES | GROWTH)[name])
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

    draw = clocked(lambda: render(mesh, camera, threads=threads), repeat)
    tape = clocked(taped, repeat)
    backward = clocked(
        lambda: rendering.backward(towards, None, None, vertices=points, colors=colors), repeat
    )
    pixels = camera.width * camera.height
    cells = (
        f"{len(mesh.faces):,}",
        f"{camera.width} x {camera.height}",
        f"{threads}",
        f"{fragments / pixels:.1f}",
        *(f"{1000 * seconds:.0f}" for seconds in (draw, tape, backward, tape + backward)),
        f"{fragments / draw / 1e6:.1f}",
        f"{1e9 * (tape + backward) / fragments:.1f}",
        f"{drawing / 1e6:.0f}",
        f"{both / 1e6:.0f}",
    )
    print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--growth", action="store_true", help="how time grows, in place of --scenes")
    parser.add_argument("--row", nargs=2, metavar=("SCENE", "THREADS"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.row:
        run(args.row[0], int(args.row[1]), args.repeat)
        return
    print(f"Core: {available_variants()[0]}.\n")
    heads = [
        "triangles",
        "image",
        "threads",
        "fragments per pixel",
        "render",
        "tape",
        "backward",
        "tape + backward",
    ]
    heads += ["M fragments per second", "ns per fragment", "MB, render", "MB, tape + backward"]
    print("| " + " | ".join(heads) + " |\n|" + "---|" * len(heads), flush=True)
    for name in GROWTH if args.growth else args.scenes:
        for threads in args.threads:
            call = [sys.executable, __file__, "--repeat", str(args.repeat), "--row", name, str(threads)]
            subprocess.run(call, check=True)


if __name__ == "__main__":
    main()
