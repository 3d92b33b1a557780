"""Time and memory of convert on a million random splats.

    python benchmarks/conversion_speed.py [--splats 1000000] [--repeat 3]

Least time of the repeats, by the clock and of the processor, and the peak of the process's memory beyond what
it held before. Each row runs in a process of its own.
"""

from __future__ import annotations

import numpy as np
from _common import Report, Stopwatch, alone, arguments, peak_bytes

from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion import convert
from meshsplats.scene.gaussians import GaussianCloud

ROWS: dict[str, dict] = {
    "paper": dict(preset="paper"),
    "paper, 3d": dict(preset="paper", mode="3d"),
    "default, no footprint": dict(footprint="none"),
    "default, no cameras": dict(),
    "default, 8 cameras": dict(cameras=8),
    "default, 100 cameras": dict(cameras=100),
    "default, 8 cameras, mean colours of SH degree 3": dict(cameras=8, colors="mean"),
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


def measure(label: str, splats: int, repeat: int) -> list[str]:
    options = dict(ROWS[label])
    cloud = random_cloud(splats, 16 if "colors" in options else 1)
    if "cameras" in options:
        options["cameras"] = orbit(cloud, options["cameras"], width=800, height=800)
    convert(cloud.take(np.arange(10)), **options)
    before, best, busy, mesh = peak_bytes(), np.inf, np.inf, None
    for _ in range(repeat):
        mesh = None  # only one at a time
        watch = Stopwatch()
        mesh = convert(cloud, **options)
        best, busy = min(best, watch.wall), min(busy, watch.processor)
    assert mesh is not None
    size = mesh.vertices.nbytes + mesh.faces.nbytes + mesh.colors.nbytes + 4 * len(mesh.faces)
    return [
        *(label, f"{best:.2f}", f"{busy:.2f}", f"{len(mesh.vertices):,}", f"{len(mesh.faces):,}"),
        *(f"{size / 1e6:.0f}", f"{(peak_bytes() - before) / 1e6:.0f}"),
    ]


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--repeat", type=int, default=3)
    asked = parser.parse_args()
    with Report(asked) as report:
        report.table("conversion", "s", "processor s", "vertices", "triangles", "mesh MB", "peak MB")
        for label in ROWS:
            report.row(*alone(measure, label, asked.splats, asked.repeat))


if __name__ == "__main__":
    main()
