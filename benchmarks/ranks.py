"""Views per second of fine-tuning on one rank and on several.

    python benchmarks/ranks.py [--splats 100000] [--width 400] [--steps 32] [--threads 1] [--batch 4]
    torchrun --nproc-per-node 2 benchmarks/ranks.py ...

Takes steps on a city whose targets are in memory, and prints views per second, and the processor time of the
first rank for a step.
"""

from __future__ import annotations

import argparse
import time

import meshsplats as ms
from meshsplats.demo_scene.city import city_blocks
from meshsplats.finetuning.ranks import joined_ranks
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import make_step
from meshsplats.gaussians import joined

VIEWS = 8
LENGTH = 10**6
"""Steps of the run of which these are the first."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, value in (("splats", 100_000), ("width", 400), ("steps", 32), ("threads", 1)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--batch", type=int, help="views of a step; default: one a rank")
    given = parser.parse_args()
    with joined_ranks(given.threads) as (ranks, threads):
        batch = given.batch or ranks.count
        cloud = joined(list(city_blocks(given.splats, degree=0)))
        dataset = ms.splat_dataset(cloud, train=VIEWS, test=0, width=given.width, threads=threads)
        mesh = ms.starting_mesh(cloud, [view.camera for view in dataset.train])
        state = State.begin(mesh, VIEWS, ms.make_config(steps=LENGTH, batch=batch), threads)

        def take(first: int, last: int) -> None:
            for step in range(first, last, batch):
                make_step(state, dataset.train, step, step / LENGTH, batch=batch, ranks=ranks)

        take(0, 2 * VIEWS)
        ranks.wait()
        wall, processor = time.perf_counter(), time.process_time()
        take(2 * VIEWS, 2 * VIEWS + given.steps)
        wall, processor = time.perf_counter() - wall, time.process_time() - processor
        if not ranks.index:
            each = 1000 * processor * ranks.count / given.steps
            print(
                f"{ranks.count} ranks, {threads} threads, batch {batch}: {given.steps / wall:.2f} views/s,"
                f" {each:.0f} ms of the processor for a view; {len(mesh.vertices):,} vertices"
            )


if __name__ == "__main__":
    main()
