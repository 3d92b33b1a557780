"""What ``clean`` takes from places: rules alone against rules that leave the surroundings.

    python benchmarks/floaters.py [SPLATS ...] [--true SPLATS PHOTOGRAPHS] [--clumps 60]

Clumps of 1 to 60 splats are planted between cameras and what they see, at 0.15 to 0.6 of the usual depth,
with radii of 0.5 to 4 % of their distance. PSNR compares the splats of the file that are left with all of
them, over white: seen by the held-out cameras of the data set PHOTOGRAPHS, else by those found views from
which nothing was looked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from _common import Report, Stopwatch, alone, arguments

import meshsplats as ms
from meshsplats.conversion.cleaning import find
from meshsplats.conversion.surroundings import PLACES, without_surroundings


def planted(cameras: Sequence[ms.Camera], extent: float, count: int, like: ms.GaussianCloud) -> list:
    """``count`` clumps of splats before the cameras."""
    rng = np.random.default_rng(0)
    clumps = []
    for _ in range(count):
        camera = cameras[rng.integers(len(cameras))]
        u, v = rng.uniform(0.15, 0.85, 2) * [camera.width, camera.height]
        away = extent * rng.uniform(0.15, 0.6)
        ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1])
        center = camera.center + away * ray @ camera.world_to_camera[:3, :3]
        n, radius = int(rng.integers(1, 60)), away * rng.uniform(0.005, 0.04)
        sh = np.zeros((n, *like.sh.shape[1:]), np.float32)
        sh[:, 0] = 0.5 * rng.normal(size=(n, 3))
        clumps.append(
            ms.GaussianCloud(
                center + 0.5 * radius * rng.normal(size=(n, 3)),
                np.tile([1.0, 0, 0, 0], (n, 1)),
                0.3 * radius * rng.uniform(0.5, 1.5, (n, 3)),
                rng.uniform(0.2, 0.95, n),
                sh,
                like.kernel,
            )
        )
    return clumps


def measure(splats: Path, photographs: Path | None, clumps: int) -> list[str]:
    """A row of the table, made in a process of its own."""
    file = ms.load_gaussians(splats)
    watch = Stopwatch()
    views = ms.find_cameras(file, 3 * PLACES, threads=2)
    searched = watch.processor
    if photographs is None:
        judges = [camera.within(300) for camera in views.cameras[PLACES : 3 * PLACES : 2]]
    else:
        data = ms.load_dataset(photographs, origin=file.origin)
        judges = [view.camera.within(300) for view in data.test[::3]]
    extra = ms.GaussianCloud.joined(planted(views.cameras, views.extent, clumps, file))
    cloud = ms.GaussianCloud.joined([file.take(np.arange(len(file))), extra])
    own = np.arange(len(cloud)) < len(file)
    rules = find(cloud)
    watch = Stopwatch()
    found = without_surroundings(cloud, rules, views.cameras[:PLACES], threads=2)
    seconds = watch.processor
    truth = [ms.render_splats(file, camera).color.clip(0, 1) for camera in judges]

    def score(kept: np.ndarray) -> str:
        left = cloud.take(np.flatnonzero(kept & own))
        images = [ms.render_splats(left, camera).color.clip(0, 1) for camera in judges]
        return f"{np.mean([ms.psnr(a, b) for a, b in zip(images, truth, strict=True)]):.1f}"

    return [
        f"{len(file):,}",
        f"{(~rules.kept & own).sum():,} / {(~found.kept & own).sum():,}",
        f"{(~rules.kept[~own]).mean():.0%} / {(~found.kept[~own]).mean():.0%}",
        f"{score(rules.kept)} / {score(found.kept)}",
        f"{searched:.1f} + {seconds:.1f}",
    ]


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", nargs="*", type=Path)
    parser.add_argument("--true", nargs=2, type=Path, action="append", default=[], help="may be repeated")
    parser.add_argument("--clumps", type=int, default=60)
    given = parser.parse_args()
    with Report(given) as report:
        heads = ("splats", "removed of them", "of planted", "PSNR of what is left", "processor s")
        report.table("scene: rules / less surroundings", *heads)
        for splats, photographs in [*given.true, *((path, None) for path in given.splats)]:
            name = splats.name if splats.is_dir() else splats.stem
            report.row(name, *alone(measure, splats, photographs, given.clumps))


if __name__ == "__main__":
    main()
