"""Training on a processor beside OpenSplat: the same photographs, at the same time, one core each.

    python benchmarks/trainers.py --data ../shared/data --opensplat build/opensplat --minutes 10

OpenSplat is not a part of this project: --opensplat is its program, built with -DGPU_RUNTIME=CPU, from
github.com/pierotofy/OpenSplat. It has no limit of time, so its number of steps is estimated from short runs
at each size of its images; adding splats makes it take longer than that. Both get the training photographs
and the known points, where there are none (lego) random ones for OpenSplat, as 3DGS has them. PSNR on
held-out photographs of the whole size over black; of OpenSplat's splats also over the colour that it trains
on, the better one counts. Splats are drawn as splat viewers draw them.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from _common import Report, Used, arguments, run

import meshsplats as ms

SCENES = ("bonsai", "lego", "saharov")
BACKGROUNDS = ((0.0, 0.0, 0.0), (0.6130, 0.0101, 0.3984))
"""Black, and what OpenSplat draws behind its splats."""
ON_CORE = ("taskset", "--cpu-list")
PILOT_STEPS = 12
RANDOM_POINTS, RANDOM_SIDE = 50_000, 2.6
"""Points, and the side of the cube about zero that they fill."""


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("--opensplat", type=Path, required=True, help="its program")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    options = parser.parse_args()
    with Report(options) as report, tempfile.TemporaryDirectory() as folder:
        report.table("scene", "trainer", "steps", "seconds", "splats", "PSNR (median)", "SSIM")
        for name in options.scenes:
            for row in rows(name, Path(folder) / name, options):
                report.row(name, *row)


def rows(name: str, folder: Path, options: argparse.Namespace) -> list[tuple[str, ...]]:
    photographs = options.data / "photos" / name
    data = ms.load_dataset(photographs)
    data = data.over(BACKGROUNDS[0])
    project = as_nerfstudio(data, photographs, folder / "project")
    steps = affordable_steps(options.opensplat, project, 60 * options.minutes)
    mesh, ours, theirs = folder / "ours.npz", folder / "ours.ply", folder / "theirs.ply"
    words = ["train", photographs, "-o", mesh, "--as-splats", ours, "--threads", "1"]
    command = [sys.executable, "-m", "meshsplats", *words, "--minutes", str(options.minutes)]
    with ThreadPoolExecutor() as both:
        other = both.submit(run_opensplat, options.opensplat, project, theirs, steps)
        seconds = run([*ON_CORE, "1", *command]).wall
        spent = other.result().wall
    record = (folder / "ours.npz.run" / "metrics.jsonl").read_text()
    taken = max(json.loads(line)["step"] for line in record.splitlines())
    made = ms.load_mesh(mesh)

    def drawn(cloud: ms.GaussianCloud, background: tuple[float, ...]) -> Drawn:
        return lambda camera: ms.render_splats(cloud, camera, background=background).color

    own, foreign = ms.load_gaussians(ours), ms.load_gaussians(theirs)
    return [
        (
            *("OpenSplat", f"{steps:,}", f"{spent:.0f}", f"{len(foreign):,}"),
            *max((scores(drawn(foreign, color), data) for color in BACKGROUNDS), key=psnr_of),
        ),
        (
            "`train`, its mesh",
            f"{taken:,}",
            f"{seconds:.0f}",
            f"{made.splat_count:,}",
            *scores(lambda camera: ms.render(made, camera, background=BACKGROUNDS[0], samples=2).color, data),
        ),
        (
            "`train --as-splats`",
            f"{taken:,}",
            f"{seconds:.0f}",
            f"{len(own):,}",
            *scores(drawn(own, BACKGROUNDS[0]), data),
        ),
    ]


Drawn = Callable[[ms.Camera], np.ndarray]


def scores(drawn: Drawn, data: ms.Dataset) -> tuple[str, str]:
    """PSNR, with its median, and SSIM of the held-out photographs."""
    pairs = [(drawn(view.camera).clip(0, 1), view.image) for view in data.test]
    psnr = [ms.psnr(*pair) for pair in pairs]
    return f"{np.mean(psnr):.2f} ({np.median(psnr):.2f})", f"{np.mean([ms.ssim(*p) for p in pairs]):.3f}"


def psnr_of(scored: tuple[str, str]) -> float:
    """The mean PSNR among ``scores``."""
    return float(scored[0].split()[0])


def as_nerfstudio(data: ms.Dataset, photographs: Path, project: Path) -> Path:
    """``project``: the training photographs of ``data`` as nerfstudio has them, with the known points."""
    (project / "images").mkdir(parents=True)
    frames = []
    for number, view in enumerate(data.train):
        camera, file = view.camera, f"images/{number:04d}.png"
        ms.save_image(project / file, view.image)
        pose = np.linalg.inv(camera.world_to_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append(
            {
                "file_path": file,
                "transform_matrix": pose.tolist(),
                **{"w": camera.width, "h": camera.height, "cx": camera.cx, "cy": camera.cy},
                **{"fl_x": camera.fx, "fl_y": camera.fy},
            }
        )
    content = {"camera_model": "OPENCV", "frames": frames, "ply_file_path": "points.ply"}
    (project / "transforms.json").write_text(json.dumps(content))
    known = ms.load_points(photographs)
    if known is None:
        rng = np.random.default_rng(0)
        places = RANDOM_SIDE * (rng.random((RANDOM_POINTS, 3)) - 0.5)
        colors = rng.integers(0, 256, places.shape)
    else:
        places, colors = known.positions, known.colors
    write_points(project / "points.ply", places, colors)
    return project


def write_points(path: Path, places: np.ndarray, colors: np.ndarray) -> None:
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    table = np.empty(len(places), columns)
    for values, names in ((places, "x y z"), (colors, "red green blue")):
        for axis, name in enumerate(names.split()):
            table[name] = values[:, axis]
    kinds = {"<f4": "float", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(places)}"]
    head += [f"property {kinds[kind]} {name}" for name, kind in columns]
    path.write_bytes("\n".join([*head, "end_header", ""]).encode() + table.tobytes())


def affordable_steps(program: Path, project: Path, seconds: float) -> int:
    """Steps of OpenSplat in so many ``seconds``: a quarter at a quarter of the size, a quarter at half of it,
    the rest at the whole."""
    each = []
    for factor in (4, 2, 1):
        sizes = ["-d", str(factor), "--num-downscales", "0"]
        short, longer = (
            opensplat(program, project, project / "pilot.ply", steps, sizes).wall
            for steps in (2, 2 + PILOT_STEPS)
        )
        each.append((longer - short) / PILOT_STEPS)
    return max(40, round(seconds / (0.25 * each[0] + 0.25 * each[1] + 0.5 * each[2])))


def run_opensplat(program: Path, project: Path, made: Path, steps: int) -> Used:
    """OpenSplat as it is made for 30,000 steps, with its schedule shortened to so many ``steps``."""
    part = max(1, steps // 4)
    sizes = ["--num-downscales", "2", "--resolution-schedule", str(part), "--sh-degree-interval", str(part)]
    sizes += ["--warmup-length", str(part), "--refine-every", str(max(20, steps // 20))]
    return opensplat(program, project, made, steps, sizes)


def opensplat(program: Path, project: Path, made: Path, steps: int, more: list[str]) -> Used:
    command = [program, project, "-o", made, "-n", str(steps), "--keep-crs", "--cpu", *more]
    return run([*ON_CORE, "0", *command], env={**os.environ, "OMP_NUM_THREADS": "1"})


if __name__ == "__main__":
    main()
