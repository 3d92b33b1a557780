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

import argparse
import resource
import time
from dataclasses import replace
from functools import cached_property

import numpy as np

from meshsplats import (
    convert,
    finetune,
    load_cameras,
    load_gaussians,
    psnr,
    render,
    render_splats,
    simplify,
    splat_dataset,
)
from meshsplats.conversion.selection import choose_splats
from meshsplats.demo_scene import make_scene
from meshsplats.finetuning import make_config, starting_mesh

LARGER = 4


class Truth:
    def __init__(self, cloud, cameras):
        self.cloud, self.cameras = cloud, cameras
        self.same = [render_splats(cloud, c).color.clip(0, 1) for c in cameras]

    @cached_property
    def mean(self):
        means = []
        for camera in self.cameras:
            large = render_splats(self.cloud, camera.scaled(LARGER)).color.clip(0, 1)
            shape = (camera.height, LARGER, camera.width, LARGER, 3)
            means.append(large.reshape(shape).mean(axis=(1, 3)))
        return means

    def of_splats(self, cloud):
        images = [render_splats(cloud, c).color.clip(0, 1) for c in self.cameras]
        return np.mean([psnr(a, b) for a, b in zip(images, self.same, strict=True)])

    def of_mesh(self, mesh):
        scores = []
        for samples, truth in ((1, self.same), (2, self.mean)):
            images = [render(mesh, c, samples=samples).color.clip(0, 1) for c in self.cameras]
            scores.append(np.mean([psnr(a, b) for a, b in zip(images, truth, strict=True)]))
        return "{:.2f} / {:.2f}".format(*scores)


def flat_colored(path):
    cloud = load_gaussians(path)
    return replace(cloud, sh=cloud.sh[:, :1])


def splats(arguments):
    cloud, cameras = flat_colored(arguments.splats), load_cameras(arguments.cameras)
    truth = Truth(cloud, cameras)
    for share in arguments.shares:
        count = round(share * len(cloud))
        dropped = truth.of_splats(choose_splats(cloud, max_splats=count))
        print(f"{count:,} of {len(cloud):,}: dropped {dropped:.2f} dB", flush=True)
        for name, options in (("cameras known", {"cameras": cameras}), ("not known", {})):
            start = time.process_time()
            merged = simplify(cloud, count, **options)
            seconds = time.process_time() - start
            print(f"  merged, {name}: {truth.of_splats(merged):.2f} dB, {seconds:.1f} s", flush=True)
    for path in arguments.other:
        other = flat_colored(path)
        print(f"{path}: {len(other):,} splats, {truth.of_splats(other):.2f} dB", flush=True)


def meshes(arguments):
    cloud, cameras = flat_colored(arguments.splats), load_cameras(arguments.cameras)
    truth = Truth(cloud, cameras)
    look = arguments.look
    data = splat_dataset(cloud, train=200, test=8, look=look)
    seen_from = [view.camera for view in data.train]
    whole = starting_mesh(cloud, seen_from, look=look)
    print(f"all {len(cloud):,}: {truth.of_mesh(whole)} dB (i) / (ii)", flush=True)
    for share in arguments.shares:
        count = round(share * len(cloud))
        for budget in ("drop", "merge"):
            mesh = starting_mesh(cloud, seen_from, look=look, max_splats=count, budget=budget)
            line = f"{count:,} {budget}: {len(mesh.faces):,} triangles, {truth.of_mesh(mesh)} dB"
            if arguments.steps:
                tuned = finetune(mesh, data, make_config("default", steps=arguments.steps))
                line += f"; after {arguments.steps} steps {truth.of_mesh(tuned)}"
            print(line, flush=True)


WAYS = {
    "crossed, 8": {"mode": "crossed", "sides": 4},
    "flat, 8": {"mode": "flat", "sides": 8},
    "flat, 6": {"mode": "flat", "sides": 6},
    "flat, 4": {"mode": "flat", "sides": 4},
    "flat, 3": {"mode": "flat", "sides": 3},
    "chosen": {},
}


def triangles(arguments):
    cloud, cameras = flat_colored(arguments.splats), load_cameras(arguments.cameras)
    truth = Truth(cloud, cameras)
    for budget in arguments.budgets:
        most = int(budget * len(cloud))
        print(f"{budget:g} triangles a splat, {most:,}", flush=True)
        for name, options in WAYS.items():
            mesh = convert(cloud, cameras=cameras, max_triangles=most, **options)
            print(f"  {name}: {mesh.splat_count:,} splats, {truth.of_mesh(mesh)} dB", flush=True)


def speed(arguments):
    cloud = make_scene(arguments.count)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start, busy = time.perf_counter(), time.process_time()
    merged = simplify(cloud, len(cloud) // 4)
    seconds, busy = time.perf_counter() - start, time.process_time() - busy
    more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    print(f"{len(cloud):,} splats to {len(merged):,}: {seconds:.1f} s, of the processor {busy:.1f} s")
    print(f"{more / len(cloud):.0f} bytes a splat")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
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
    arguments = parser.parse_args()
    arguments.task(arguments)


if __name__ == "__main__":
    main()
