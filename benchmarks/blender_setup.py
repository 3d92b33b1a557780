"""Time and memory that Blender needs before the first ray: building the mesh, and Cycles' own set-up.

    blender-env/bin/python benchmarks/blender_setup.py [--millions 0.01 1 4 8]

A cloud of random splats is drawn unlit, 64 x 64 pixels at one sample, so that nearly all of the render's time
is set-up. Each size runs in a Blender process of its own. Time by the clock, and in brackets processor time
of all threads, which hardly depends on other work on the machine; that of the whole process, with its start
and end; and the largest memory ever held.
"""

from __future__ import annotations

import resource
import tempfile
from pathlib import Path

import numpy as np
from _common import Report, alone, arguments, peak_bytes

from meshsplats import GaussianCloud, convert, orbit
from meshsplats.blender import draw


def measure(millions: float) -> dict:
    """Triangles, seconds and the largest memory of the Blender process, MB."""
    count = int(millions * 1e6 / 8)
    rng = np.random.default_rng(0)
    cloud = GaussianCloud(
        rng.normal(size=(count, 3)),
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.tile([0.003, 0.003, 0.0006], (count, 1)),
        np.full(count, 0.6),
        rng.normal(size=(count, 1, 3)),
    )
    mesh = convert(cloud, preset="paper")
    view = orbit(mesh, 1, width=64, height=64)[0]
    with tempfile.TemporaryDirectory() as folder:
        result = draw(mesh, [view], images=[Path(folder) / "image.png"])
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "blender": result["blender"],
        "triangles": len(mesh.faces),
        "build": result["build_seconds"],
        "build_processor": result["build_processor_seconds"],
        "render": result["image_seconds"][0],
        "render_processor": result["image_processor_seconds"][0],
        "processor": used.ru_utime + used.ru_stime,
        "memory": peak_bytes(resource.RUSAGE_CHILDREN) / 1e6,
    }


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--millions", type=float, nargs="+", default=[0.01, 1, 4, 8], metavar="M")
    asked = parser.parse_args()
    with Report(asked) as report:
        report.table("triangles", "build", "set-up and render", "whole process", "largest memory", "Blender")
        for millions in asked.millions:
            found = alone(measure, millions)
            report.row(
                f"{found['triangles']:,}",
                f"{found['build']:.2f} s ({found['build_processor']:.2f} s)",
                f"{found['render']:.2f} s ({found['render_processor']:.2f} s)",
                f"({found['processor']:.1f} s)",
                f"{found['memory']:.0f} MB",
                found["blender"],
            )


if __name__ == "__main__":
    main()
