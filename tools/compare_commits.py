#!/usr/bin/env python3
"""Compares two commits on ten figures of speed, memory and quality, side by side, and names those that moved.

    python tools/compare_commits.py v0.1.0 HEAD --rounds 7

Each commit is installed into a folder of its own (build/compared), with this Python's libraries. Both then
take the same measurements in turns, A B, B A, ..., in processes of their own, so that a machine whose speed
drifts is as slow for one as for the other. A figure has moved where the median of the paired ratios is
farther from 1 than their noise, and than half a per cent. Exit code 1 if a figure became worse. The scene
is our own, or splats given with --splats.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "build" / "compared"
LEAST = 0.005
"""Changes below this share are never named: images, files and steps are not compared any finer."""
LEAST_DB = 0.02

PROBE = """
import json, resource, sys, tempfile, time
from pathlib import Path
# An editable install of another commit would be found first.
sys.meta_path = [finder for finder in sys.meta_path if "editable" not in type(finder).__module__]
start = time.process_time()
import meshsplats as ms
figures = {"import, s": time.process_time() - start}

def timed(name, work, repeat=3):
    times = []
    for _ in range(repeat):
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    figures[name + ", s"] = min(times)
    return result

with tempfile.TemporaryDirectory() as folder:
    if len(sys.argv) > 2:
        cloud = ms.load_gaussians(sys.argv[2])
    else:
        from meshsplats.demo_scene import make_scene
        cloud = make_scene()
    cameras = ms.orbit(cloud, 4, elevation=20, width=400, height=400)
    mesh = timed("convert", lambda: ms.convert(cloud))
    file = Path(folder) / "mesh.glb"
    timed("save .glb", lambda: ms.save_mesh(mesh, file.with_name(f"{time.time_ns()}.glb")))
    ms.save_mesh(mesh, file)
    figures[".glb, MB"] = file.stat().st_size / 1e6
    timed("load .glb", lambda: ms.load_mesh(file))
    images = timed("render, 4 views", lambda: [ms.render(mesh, c, samples=2).color for c in cameras])
    splats = timed(
        "render splats, 4 views",
        lambda: [ms.draw_splats(cloud, c, look="area", sh_degree=0).color for c in cameras],
    )
    score = lambda made: sum(ms.psnr(a.clip(0, 1), b.clip(0, 1)) for a, b in zip(made, splats)) / 4
    figures["as converted, dB"] = score(images)
    data = ms.splat_dataset(cloud, train=12, test=0, width=200)
    tuned = timed("40 steps", lambda: ms.finetune(mesh, data, steps=40), 1)
    figures["after 40 steps, dB"] = score([ms.render(tuned, c, samples=2).color for c in cameras])
figures["peak memory, MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps(figures))
assert str(ms.__file__).startswith(sys.argv[1])
"""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("commits", nargs=2, metavar="COMMIT", help="the older, and the newer")
    parser.add_argument(
        "--rounds", type=int, default=7, help="pairs of measurements, at least 5 (default: 7)"
    )
    parser.add_argument("--splats", type=Path, help="splat file in place of the demo scene")
    options = parser.parse_args(arguments)
    if options.rounds < 5:
        parser.error(f"fewer than 5 rounds say nothing about noise, got {options.rounds}")
    places = [installed(commit) for commit in options.commits]
    pairs = measured(places, options.rounds, options.splats)
    rows = [(name, *compared(name, values)) for name, values in pairs.items()]
    print(f"{'figure':24}{'before':>10}{'after':>10}{'change':>10}{'noise':>9}")
    for name, before, after, change, noise, moved in rows:
        unit = " dB" if name.endswith("dB") else " %"
        print(f"{name:24}{before:10.4g}{after:10.4g}{change:+8.2f}{unit}{noise:7.2f}{'':3}{moved}")
    return 1 if any(row[-1] == "worse" for row in rows) else 0


def installed(commit: str) -> Path:
    """The folder where ``commit`` is installed; it is compiled once."""
    found = subprocess.run(
        ["git", "rev-parse", "--verify", f"{commit}^{{commit}}"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    name = found.stdout.strip()
    place, source = FOLDER / name / "site", FOLDER / name / "source"
    if (place / "installed").exists():
        return place
    print(f"installing {name[:10]}", file=sys.stderr)
    source.mkdir(parents=True, exist_ok=True)
    archive = subprocess.run(["git", "archive", name], cwd=ROOT, check=True, capture_output=True)
    subprocess.run(["tar", "-x", "-C", source], input=archive.stdout, check=True)
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--upgrade",
        "--target",
        place,
        source,
    ]
    subprocess.run(command, check=True)
    (place / "installed").touch()
    return place


def measured(
    places: Sequence[Path], rounds: int, splats: Path | None
) -> dict[str, list[tuple[float, float]]]:
    """By its name, each figure of both commits in each round."""
    pairs: dict[str, list[tuple[float, float]]] = {}
    for place in places:
        figures_of(place, splats)  # the first run reads files that later ones have in memory
    for i in range(rounds):
        order = (0, 1) if i % 2 == 0 else (1, 0)
        found = {k: figures_of(places[k], splats) for k in order}
        for name in found[0].keys() & found[1].keys():
            pairs.setdefault(name, []).append((found[0][name], found[1][name]))
        print(f"round {i + 1} of {rounds}", file=sys.stderr)
    return {name: pairs[name] for name in found[0] if name in pairs}


def figures_of(place: Path, splats: Path | None) -> dict[str, float]:
    # -P leaves the working folder out of the path: its src/ would not be found, but a build may.
    environment = os.environ | {"PYTHONPATH": str(place), "PYTHONSAFEPATH": "1"}
    command = [sys.executable, "-c", PROBE, str(place), *([str(splats)] if splats else [])]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{place}: the measurement failed\n{done.stderr}")
    figures: dict[str, float] = json.loads(done.stdout)
    return figures


def compared(name: str, pairs: Sequence[tuple[float, float]]) -> tuple[float, float, float, float, str]:
    """Medians before and after; the median change, and its noise, in per cent or dB; 'better', 'worse' or ''.

    The noise is the half width of a 95 % interval of the median (McGill, Tukey, Larsen 1978: 1.58 times the
    interquartile range by the root of the number).
    """
    decibels = name.endswith("dB")
    changes = [after - before if decibels else 100 * math.log(after / before) for before, after in pairs]
    low, _, high = statistics.quantiles(changes, n=4, method="inclusive")
    change, noise = statistics.median(changes), 1.58 * (high - low) / math.sqrt(len(changes))
    moved = abs(change) > max(noise, LEAST_DB if decibels else 100 * LEAST)
    verdict = ("better" if (change > 0) == decibels else "worse") if moved else ""
    before, after = (statistics.median(values) for values in zip(*pairs, strict=True))
    return before, after, change, noise, verdict


if __name__ == "__main__":
    sys.exit(main())
