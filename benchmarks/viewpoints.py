"""Cameras found from splats alone against the true ones: kind, distance, coverage, up, time and memory.

    python benchmarks/viewpoints.py [SPLATS ...] [--true SPLATS PHOTOGRAPHS] [--count 24] [--splats N]

PHOTOGRAPHS is the folder of the data set that the splats were trained from; of other splats only the kind,
time and memory are told. Lengths are in median distances of the true cameras from their middle. Near: the
median distance of a found camera from the nearest true one. Covered: true cameras that have a found one
within 0.5 of these lengths and 25 degrees. With ``--splats``, every splat is split into as many narrower ones
as make about N in all: the time and memory of larger captures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from _common import Report, Stopwatch, alone, arguments, peak_bytes

import meshsplats as ms
from meshsplats.cameras.framing import guess_up

REACH, TURN = 0.5, 25.0
"""Distance, in the lengths above, and degrees within which a found camera covers a true one."""


def split(cloud: ms.GaussianCloud, count: int) -> ms.GaussianCloud:
    """About ``count`` splats that look alike: each in several narrower ones within it."""
    parts = max(1, round(count / len(cloud)))
    if parts == 1:
        return cloud
    rng, rotations = np.random.default_rng(0), cloud.rotations
    means = np.empty((parts, len(cloud), 3), np.float32)
    for part in means:  # one after the other: the peak of memory is to be that of the search
        jitter = rng.normal(size=part.shape).astype(np.float32)
        part[:] = cloud.means + np.einsum("nij,nj->ni", rotations, jitter * cloud.scales)
    repeated = {
        name: np.tile(values, (parts,) + (1,) * (values.ndim - 1))
        for name, values in (
            ("quaternions", cloud.quaternions),
            ("scales", cloud.scales * np.float32(parts**-0.5)),
            ("opacities", cloud.opacities),
            ("sh", cloud.sh),
        )
    }
    return replace(cloud, means=means.reshape(-1, 3), **repeated)


def against(found: Sequence[ms.Camera], true: Sequence[ms.Camera]) -> tuple[float, float]:
    """How near the found cameras are, and the share of true ones that they cover."""
    at, places = (np.array([camera.center for camera in cameras]) for cameras in (found, true))
    gaze, truth = (
        np.array([camera.world_to_camera[2, :3] for camera in cameras]) for cameras in (found, true)
    )
    length = np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1))
    apart = np.linalg.norm(places[:, None] - at, axis=2) / length
    alike = truth @ gaze.T > np.cos(np.radians(TURN))
    return float(np.median(apart.min(axis=0))), float(((apart < REACH) & alike).any(axis=1).mean())


def measure(splats: Path, photographs: Path | None, count: int, many: int) -> list[str]:
    """A row of the table, made in a process of its own."""
    cloud = split(replace(ms.load_gaussians(splats), up=None), many)
    before, watch = peak_bytes(), Stopwatch()
    found = ms.find_cameras(cloud, count, threads=2)
    seconds = watch.processor
    memory = f"{before / 2**20:.0f} / {peak_bytes() / 2**20:.0f}"
    row = [f"{len(cloud):,}", f"{found.kind} {found.confidence:.2f}"]
    if photographs is None:
        return [*row, "-", "-", "-", f"{seconds:.1f}", memory]
    true = [view.camera for view in ms.load_dataset(photographs, origin=cloud.origin).views]
    near, covered = against(found.cameras, true)
    up = np.degrees(np.arccos(np.clip(found.up @ guess_up(cloud, true), -1, 1)))
    sure = f"{up:.0f} ({found.up_confidence:.2f})"
    return [*row, f"{near:.2f}", f"{covered:.2f}", sure, f"{seconds:.1f}", memory]


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", nargs="*", type=Path)
    parser.add_argument("--true", nargs=2, type=Path, action="append", default=[], help="may be repeated")
    parser.add_argument("--count", type=int, default=24, help="views that are looked for: %(default)s")
    parser.add_argument("--splats", dest="many", type=int, default=0, help="split splats into about so many")
    given = parser.parse_args()
    with Report(given) as report:
        heads = (
            "splats",
            "kind",
            "near",
            "covered",
            "up off, degrees (sure)",
            "processor s",
            "MB before / peak",
        )
        report.table("scene", *heads)
        for splats, photographs in [*given.true, *((path, None) for path in given.splats)]:
            name = splats.parent.name if splats.stem == "meta" else splats.stem
            report.row(name, *alone(measure, splats, photographs, given.count, given.many))


if __name__ == "__main__":
    main()
