"""Work and time of the GPU on random fans, beside the core.

    python benchmarks/webgpu.py [--scenes 160k 1M 4M] [--mesh FILE --side 400] [--repeat 3]
                                [--gradients] [--steps] [--order fragment splat] [--degree 0 1 2]

Difference from the core (PSNR, pixels off by more than 1e-3), tests of a triangle at a sample per blended
fragment, walks through a tile list per tile, samples whose first queue was too short, dispatches of a frame,
megabytes of buffers, and medians of wall time and processor time in milliseconds. Times on a software adapter
(named in the first line) say nothing about a GPU.

With --degree, each mesh of a file with its spherical harmonics up to these degrees.

With --gradients, the backward pass of a random gradient: ||g - g_core|| / ||g_core|| of positions, RGB and
opacities, windows of the image, fragments on the tape and triangles in tiles, dispatches of a window,
megabytes of buffers, and milliseconds of the image, of its backward pass, and of both on the core: by the
clock, and of the processor.

With --steps, fused steps of fine-tuning on eight views of the mesh itself with other colours: milliseconds by
the clock of a step on the GPU and on the core, medians of the second half, and the losses of both at the end.
"""

from __future__ import annotations

import statistics
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
from _common import FANS, Report, Stopwatch, arguments, random_fans

from meshsplats import (
    Camera,
    Dataset,
    FinetuneConfig,
    RunOptions,
    SplatMesh,
    View,
    finetune,
    load_mesh,
    orbit,
    psnr,
    render,
)
from meshsplats.datasets.views import ViewImage
from meshsplats.finetuning.run import Progress
from meshsplats.rendering.backward import TapeOptions
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.rendering.devices import Device
from meshsplats.rendering.gpu import GpuRendering, gpu_engine
from meshsplats.scene.order import Order
from meshsplats.webgpu import kernels
from meshsplats.webgpu.device import open_device
from meshsplats.webgpu.settings import DrawSettings


def measure(name: str, mesh: SplatMesh, view: Camera, repeat: int) -> tuple[str, ...]:
    settings = DrawSettings(filter_px2=mesh.filter_px2, order=mesh.order)
    drawn = gpu_engine().renderer_of(mesh).draw(view, settings)  # compiles
    walls, processors, cores = [], [], []
    for _ in range(repeat):
        watch = Stopwatch()
        drawn = gpu_engine().renderer_of(mesh).draw(view, settings)
        walls.append(1000 * watch.wall)
        processors.append(1000 * watch.processor)
        watch = Stopwatch()
        expected = render(mesh, view, background=(0, 0, 0))
        cores.append(1000 * watch.wall)
    error = np.abs(drawn.color - expected.color).max(axis=2)
    likeness = psnr(drawn.color, expected.color)
    work = drawn.work
    return (
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


def measure_gradients(name: str, mesh: SplatMesh, view: Camera) -> tuple[str, ...]:
    rng = np.random.default_rng(0)
    gradient = rng.normal(size=(view.height, view.width, 3)).astype(np.float32)
    found, times = [], []
    for engine in (gpu_engine(), gpu_engine(), CpuEngine()):  # the first compiles
        vertices, colors = np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)
        watch = Stopwatch()
        rendering = engine.tape(mesh.triangles, view, TapeOptions(min_transmittance=1e-3))
        middle = np.array((watch.wall, watch.processor))
        rendering.backward(gradient, None, None, vertices=vertices, colors=colors)
        times.append((middle, np.array((watch.wall, watch.processor)) - middle))
        if isinstance(rendering, GpuRendering):
            tape = rendering.tape
        found.append((vertices, colors[:, :3], colors[:, 3]))
    errors = [
        np.linalg.norm(gpu.astype(float) - core) / np.linalg.norm(core.astype(float))
        for gpu, core in zip(found[1], found[2], strict=True)
    ]
    renderer = gpu_engine().gradients_of(mesh.triangles)
    steps = [*kernels.tile_steps(mesh.order), *kernels.mark_steps(), *kernels.place_steps()]
    steps += kernels.gradient_steps(0)
    skipped = ("fans",) * (not mesh.filter_px2) + ("groups",) * (mesh.depth_group is None)
    same = all(np.array_equal(a, b) for a, b in zip(found[0], found[1], strict=True))
    return (
        name,
        f"{len(mesh.faces):,}",
        f"{view.width} x {view.height}",
        *(f"{error:.1e}" for error in errors),
        "yes" if same else "NO",
        f"{len(tape.windows)}",
        f"{sum(window.fragments for window in tape.windows):,}",
        f"{sum(window.sums for window in tape.windows):,}",
        f"{sum('kernel' in step and step.get('if') not in skipped for step in steps)}",
        f"{renderer.frames.bytes / 1e6:.0f}",
        *(f"{wall:.1f}, {busy:.1f}" for wall, busy in (1000 * t for t in (*times[1], sum(times[2])))),
    )


def measure_steps(name: str, mesh: SplatMesh, view: Camera, steps: int = 40) -> tuple[str, ...]:
    cameras = orbit(mesh, 8, width=view.width, height=view.height)
    views = [View(camera, ViewImage(render(mesh, camera).color)) for camera in cameras]
    start = replace(mesh, colors=mesh.colors * np.float32((0.8, 0.8, 0.8, 1)))
    times, losses = {}, {}
    for device in get_args(Device):
        stamps: list[tuple[float, Progress]] = []
        watch = Stopwatch()

        def note(progress: Progress, stamps: list[tuple[float, Progress]], watch: Stopwatch) -> None:
            stamps.append((watch.wall, progress))

        config = FinetuneConfig(steps=steps, prune_epochs=0, samples=1)
        run = RunOptions(device=device, report_every=0)
        finetune(
            start, Dataset(views), config, run=run, on_progress=partial(note, stamps=stamps, watch=watch)
        )
        times[device] = 1000 * statistics.median(np.diff([wall for wall, _ in stamps[steps // 2 :]]))
        losses[device] = stamps[-1][1].loss
    return (
        *(name, f"{len(mesh.faces):,}", f"{view.width} x {view.height}"),
        *(f"{times[device]:.1f}" for device in ("gpu", "cpu")),
        *(f"{losses[device]:.6f}" for device in ("gpu", "cpu")),
    )


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--scenes", nargs="*", default=["160k", "1M"], choices=list(FANS))
    parser.add_argument("--mesh", type=Path, nargs="*", default=[])
    parser.add_argument("--side", type=int, default=400)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--gradients", action="store_true")
    parser.add_argument("--steps", action="store_true")
    parser.add_argument("--order", nargs="+", default=["fragment"], choices=get_args(Order))
    parser.add_argument("--degree", type=int, nargs="+", choices=range(4))
    asked = parser.parse_args()
    columns: tuple[str, ...] = (
        *("scene", "triangles", "image", "dB", "> 1e-3", "tests a fragment", "walks a tile", "overflowed"),
        *("dispatches", "MB", "ms", "processor ms", "core ms"),
    )
    if asked.gradients:
        columns = (
            *("scene", "triangles", "image", "positions", "RGB", "opacities", "same bits", "windows"),
            *("fragments", "triangles in tiles", "dispatches", "MB", "image ms", "backward ms", "core ms"),
        )
    if asked.steps:
        columns = ("scene", "triangles", "image", "GPU ms", "core ms", "GPU loss", "core loss")
    with Report(asked) as report:
        report.say(open_device().name)
        report.table(*columns)

        def show(name: str, mesh: SplatMesh, view: Camera) -> None:
            for order in asked.order:
                title = name if asked.order == ["fragment"] else f"{name}, {order}"
                ordered = replace(mesh, order=order)
                if asked.steps:
                    report.row(*measure_steps(title, ordered, view))
                elif asked.gradients:
                    report.row(*measure_gradients(title, ordered, view))
                else:
                    report.row(*measure(title, ordered, view, asked.repeat))

        for name in asked.scenes:
            show(name, *random_fans(*FANS[name]))
        for path in asked.mesh:
            mesh = load_mesh(path)
            view = orbit(mesh, 4, width=asked.side, height=asked.side)[1]
            for degree in asked.degree or [mesh.sh_degree]:
                title = path.stem if asked.degree is None else f"{path.stem}, degree {degree}"
                show(title, mesh.of_degree(degree), view)


if __name__ == "__main__":
    main()
