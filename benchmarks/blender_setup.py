"""Time and memory that Blender needs before the first ray: building the mesh, and Cycles' own set-up.

    blender-env/bin/python benchmarks/blender_setup.py [--millions 0.01 1 4 8]

A cloud of random splats is drawn unlit, 64 x 64 pixels at one sample, so that nearly all of the render's time
is set-up. Each size runs in a Blender process of its own. Prints a Markdown table: time by the clock, and in
brackets processor time of all threads, which hardly depends on other work on the machine; that of the whole
process, with its start and end; and the largest memory ever held.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

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
        "memory": used.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Set-up of Blender for many triangles.")
    parser.add_argument("--millions", type=float, nargs="+", default=[0.01, 1, 4, 8], metavar="M")
    parser.add_argument("--one", type=float, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.one is not None:
        print("\n" + json.dumps(measure(asked.one)))
        return
    print("| triangles | build | set-up and render | whole process | largest memory |")
    print("|---|---|---|---|---|")
    for millions in asked.millions:
        command = [sys.executable, __file__, "--one", str(millions)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        found = json.loads(done.stdout.splitlines()[-1])
        print(
            f"| {found['triangles']:,} | {found['build']:.2f} s ({found['build_processor']:.2f} s) |"
            f" {found['render']:.2f} s ({found['render_processor']:.2f} s) |"
            f" ({found['processor']:.1f} s) | {found['memory']:.0f} MB |",
            flush=True,
        )
    print(f"\nBlender {found['blender']}")


if __name__ == "__main__":
    main()
