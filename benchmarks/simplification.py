"""Fewer splats: merged and dropped, drawn as splats and as meshes, before and after fine-tuning.

    python benchmarks/simplification.py splats SPLATS CAMERAS [--shares 0.5 0.25 0.125] [--other FILE ...]
    python benchmarks/simplification.py meshes SPLATS CAMERAS [--shares ...] [--steps 100] [--look splats]
    python benchmarks/simplification.py triangles SPLATS CAMERAS [--budgets 0.5 1 2 4]
    python benchmarks/simplification.py speed COUNT

CAMERAS is a JSON list. splats: dB of the reduced splats against all of them, drawn alike, and seconds of
processor time; --other: files that another program reduced, beside them. meshes: the same number of splats
merged and dropped, then converted for fine-tuning, and fine-tuned. triangles: the same number of triangles
distributed in different ways; budgets are triangles for each splat of the file. speed: merging COUNT splats
of our own scene to a quarter, and the memory that it took.

Images on white, degree 0: (i) one sample per pixel against the splats drawn at that size, (ii) 2 x 2 samples
against the mean of splats drawn four times as large.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path

from _common import Report, Stopwatch, areas, arguments, images, mean_psnr, peak_bytes

from meshsplats import (
    convert,
    finetune,
    load_cameras,
    load_gaussians,
    simplify,
    splat_dataset,
)
from meshsplats.conversion.selection import choose_splats
from meshsplats.demo_scene import make_scene
from meshsplats.finetuning import make_config, starting_mesh


class Truth:
    def __init__(self, cloud, cameras):
        self.cloud, self.cameras = cloud, cameras
        self.same = areas(cloud, cameras, look="splats")

    @cached_property
    def mean(self):
        return areas(self.cloud, self.cameras)

    def of_splats(self, cloud):
        return f"{mean_psnr(areas(cloud, self.cameras, look='splats'), self.same):.2f}"

    def of_mesh(self, mesh):
        """(i) and (ii)."""
        pairs = ((1, self.same), (2, self.mean))
        scores = (mean_psnr(images(mesh, self.cameras, samples=side), truth) for side, truth in pairs)
        return "{:.2f} / {:.2f}".format(*scores)


def flat_colored(path):
    cloud = load_gaussians(path)
    return replace(cloud, sh=cloud.sh[:, :1])


def splats(report, asked):
    cloud, cameras = flat_colored(asked.splats), load_cameras(asked.cameras)
    truth = Truth(cloud, cameras)
    report.table("kept", "way", "dB", "processor s")
    for share in asked.shares:
        count = round(share * len(cloud))
        kept = f"{count:,} of {len(cloud):,}"
        report.row(kept, "dropped", truth.of_splats(choose_splats(cloud, max_splats=count)), "")
        for name, options in (("cameras known", {"cameras": cameras}), ("not known", {})):
            watch = Stopwatch()
            merged = simplify(cloud, count, **options)
            report.row(kept, f"merged, {name}", truth.of_splats(merged), f"{watch.processor:.1f}")
    for path in asked.other:
        other = flat_colored(path)
        report.row(f"{len(other):,} of {len(cloud):,}", Path(path).name, truth.of_splats(other), "")


def meshes(report, asked):
    cloud, cameras = flat_colored(asked.splats), load_cameras(asked.cameras)
    truth, look = Truth(cloud, cameras), asked.look
    data = splat_dataset(cloud, train=200, test=8, look=look)
    seen_from = [view.camera for view in data.train]
    report.table("splats", "way", "triangles", "(i) / (ii), dB", f"after {asked.steps} steps")
    whole = starting_mesh(cloud, seen_from, look=look)
    report.row(f"{len(cloud):,}", "all", f"{len(whole.faces):,}", truth.of_mesh(whole), "")
    for share in asked.shares:
        count = round(share * len(cloud))
        for budget in ("drop", "merge"):
            mesh = starting_mesh(cloud, seen_from, look=look, max_splats=count, budget=budget)
            found, tuned = truth.of_mesh(mesh), ""
            if asked.steps:
                tuned = truth.of_mesh(finetune(mesh, data, make_config("default", steps=asked.steps)))
            report.row(f"{count:,}", budget, f"{len(mesh.faces):,}", found, tuned)


WAYS = {
    "crossed, 8": {"mode": "crossed", "sides": 4},
    "flat, 8": {"mode": "flat", "sides": 8},
    "flat, 6": {"mode": "flat", "sides": 6},
    "flat, 4": {"mode": "flat", "sides": 4},
    "flat, 3": {"mode": "flat", "sides": 3},
    "chosen": {},
}


def triangles(report, asked):
    cloud, cameras = flat_colored(asked.splats), load_cameras(asked.cameras)
    truth = Truth(cloud, cameras)
    report.table("triangles", "way", "splats", "(i) / (ii), dB")
    for budget in asked.budgets:
        most = int(budget * len(cloud))
        for name, options in WAYS.items():
            mesh = convert(cloud, cameras=cameras, max_triangles=most, **options)
            report.row(f"{most:,}", name, f"{mesh.splat_count:,}", truth.of_mesh(mesh))


def speed(report, asked):
    cloud = make_scene(asked.count)
    before, watch = peak_bytes(), Stopwatch()
    merged = simplify(cloud, len(cloud) // 4)
    wall, processor = watch.wall, watch.processor
    memory = (peak_bytes() - before) / len(cloud)
    report.table("splats", "merged to", "s", "processor s", "bytes a splat")
    counts = (f"{len(cloud):,}", f"{len(merged):,}")
    report.row(*counts, f"{wall:.1f}", f"{processor:.1f}", f"{memory:.0f}")


def main():
    parser = arguments(__doc__)
    commands = parser.add_subparsers(required=True)
    for task in (splats, meshes, triangles):
        command = commands.add_parser(task.__name__)
        command.set_defaults(task=task)
        command.add_argument("splats")
        command.add_argument("cameras")
        if task is triangles:
            command.add_argument("--budgets", type=float, nargs="+", default=[0.5, 1, 2, 4])
        else:
            command.add_argument("--shares", type=float, nargs="+", default=[0.5, 0.25, 0.125])
    commands.choices["splats"].add_argument("--other", nargs="+", default=[])
    commands.choices["meshes"].add_argument("--steps", type=int, default=0)
    commands.choices["meshes"].add_argument("--look", choices=["area", "splats"], default="area")
    command = commands.add_parser("speed")
    command.set_defaults(task=speed)
    command.add_argument("count", type=int)
    asked = parser.parse_args()
    with Report(asked) as report:
        asked.task(report, asked)


if __name__ == "__main__":
    main()
