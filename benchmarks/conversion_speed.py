"""Time and memory of convert on a million random splats.

    python benchmarks/conversion_speed.py [--splats 1000000] [--repeat 3]

Prints a Markdown table: least time of the repeats, by the clock and of the processor, and the peak of the
process's memory beyond what it held before. Each row runs in a process of its own.
"""

from __future__ import annotations

import argparse
import platform
import resource
import subprocess
import sys
import time

import numpy as np

from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion import convert
from meshsplats.gaussians import GaussianCloud

ROWS: dict[str, dict] = {
    "paper": dict(preset="paper"),
    "paper, 3d": dict(preset="paper", mode="3d"),
    "default, no footprint": dict(footprint="none"),
    "default, no cameras": dict(),
    "default, 8 cameras": dict(cameras=8),
    "default, 100 cameras": dict(cameras=100),
    "default, 8 cameras, mean colours of SH degree 3": dict(cameras=8, colors="cameras"),
    "default, 8 cameras, the 100,000 most important": dict(cameras=8, max_splats=100_000, budget="drop"),
}


def random_cloud(n: int, coefficients: int) -> GaussianCloud:
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(n, 4)).astype(np.float32)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return GaussianCloud(
        rng.normal(size=(n, 3)).astype(np.float32),
        quaternions,
        np.exp(rng.normal(size=(n, 3)) - 5).astype(np.float32),
        rng.random(n, np.float32),
        0.3 * rng.standard_normal((n, coefficients, 3), np.float32),
    )


def peak() -> int:
    unit = 1 if platform.system() == "Darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def run(label: str, splats: int, repeat: int) -> None:
    options = dict(ROWS[label])
    cloud = random_cloud(splats, 16 if "colors" in options else 1)
    if "cameras" in options:
        options["cameras"] = orbit(cloud, options["cameras"], width=800, height=800)
    convert(cloud.select(np.arange(10)), **options)
    before, best, busy, mesh = peak(), np.inf, np.inf, None
    for _ in range(repeat):
        mesh = None  # only one at a time
        start, start_busy = time.perf_counter(), time.process_time()
        mesh = convert(cloud, **options)
        best = min(best, time.perf_counter() - start)
        busy = min(busy, time.process_time() - start_busy)
    assert mesh is not None
    size = mesh.vertices.nbytes + mesh.faces.nbytes + mesh.colors.nbytes + 4 * len(mesh.faces)
    count = f"{len(mesh.vertices):,} | {len(mesh.faces):,}"
    print(
        f"| {label} | {best:.2f} | {busy:.2f} | {count} | {size / 1e6:.0f} | {(peak() - before) / 1e6:.0f} |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--row", choices=list(ROWS), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.row:
        run(args.row, args.splats, args.repeat)
        return
    print(
        "| conversion | s | processor s | vertices | triangles | mesh MB | peak MB |\n" + "|---" * 7 + "|",
        flush=True,
    )
    for label in ROWS:
        call = [
            sys.executable,
            __file__,
            "--splats",
            str(args.splats),
            "--repeat",
            str(args.repeat),
            "--row",
            label,
        ]
        subprocess.run(call, check=True)


if __name__ == "__main__":
    main()
