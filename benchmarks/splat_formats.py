"""Sizes, losses and times of splats in every format that is written, beside those of splat-transform.

    python benchmarks/splat_formats.py --data DATA --node NODE_FOLDER
    python benchmarks/splat_formats.py SPLATS ... --divide 9 --count 1000000 --formats 'spz 3' sog

NODE_FOLDER: where 'npm install @playcanvas/splat-transform' was run. Both programs convert the same float
.ply, one right after the other, as processes of their own: reading and the start of Python or node are in
the times, which are processor seconds. Loss: PSNR against the float splats in images of 400 pixels, three
from around the scene, on black, with the harmonics of the file.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from _common import SCENES, Report, arguments, run

import meshsplats as ms

WRITERS = {
    "ply": ("ply", {}, []),
    "compressed.ply": ("compressed.ply", {}, []),
    "splat": ("splat", {}, None),
    "spz 3": ("spz", {"spz_version": 3}, ["--spz-version", "3"]),
    "spz 4": ("spz", {"spz_version": 4}, ["--spz-version", "4"]),
    "sog": ("sog", {}, []),
    "glb": ("glb", {}, []),
    "usdc": ("usdc", {}, None),
    "usdz": ("usdz", {}, None),
}
"""Ending, our options, and theirs; None: they do not write it."""
UNREADABLE = ("glb",)
"""Theirs are not compared: floats, too."""


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("splats", nargs="*", type=Path, help="files; by default the scenes of DATA")
    parser.add_argument("--node", type=Path, help="folder with splat-transform")
    parser.add_argument("--count", type=int, help="only so many splats of each file, evenly spread")
    parser.add_argument("--divide", type=int, help="each splat into so many that lie one after the other")
    parser.add_argument("--formats", nargs="+", choices=[*WRITERS], default=[*WRITERS])
    parser.add_argument("--views", type=int, default=3, help="0: no images")
    options = parser.parse_args()
    scenes = {path.stem: path for path in options.splats}
    scenes = scenes or {name: options.data / "splats" / scene.splats for name, scene in SCENES.items()}
    with Report(options) as report, tempfile.TemporaryDirectory() as folder:
        for name, path in scenes.items():
            cloud = ms.load_gaussians(path)
            if options.divide:
                cloud = divided(cloud, options.divide)
            if options.count:
                cloud = cloud.take(np.linspace(0, len(cloud) - 1, options.count).astype(np.int64))
            report.say(f"{name}, {len(cloud):,} splats of degree {cloud.sh_degree}:")
            report.table(
                "format", "bytes a splat", "dB", "s", "theirs: bytes a splat", "dB", "s", "size ratio"
            )
            place = {"elevation": 20, "width": 400, "height": 400}
            cameras = ms.orbit(cloud, options.views, **place) if options.views else []
            truths = [ms.draw_splats(cloud, camera).color for camera in cameras]
            source = Path(folder) / "source.ply"
            ms.save_gaussians(replace(cloud, up=None), source)
            for format_ in options.formats:
                report.row(format_, *row(format_, source, len(cloud), cameras, truths, options.node))
            report.say()


def divided(cloud: ms.GaussianCloud, parts: int) -> ms.GaussianCloud:
    """``cloud`` as some programs thicken splats: ``parts`` of each in place of one, one after the other, with
    its rotation, scale and colour, and half as far from its centre as it is wide."""
    many = cloud.take(np.repeat(np.arange(len(cloud)), parts))
    steps = np.random.default_rng(0).normal(scale=0.5, size=(len(many), 3)) * many.scales
    return replace(many, means=many.means + np.einsum("nij,nj->ni", many.rotations, steps))


def row(
    format_: str,
    source: Path,
    count: int,
    cameras: Sequence[ms.Camera],
    truths: Sequence[np.ndarray],
    node: Path | None,
) -> list[str]:
    """Our figures and theirs."""
    ending, ours, theirs = WRITERS[format_]
    own = source.with_name(f"ours.{ending}")
    code = (
        "import sys, meshsplats as ms; ms.save_gaussians(ms.load_gaussians(sys.argv[1]), sys.argv[2], **%r)"
    )
    used = run([sys.executable, "-W", "ignore", "-c", code % ours, source, own])
    cells = [f"{own.stat().st_size / count:.2f}", loss(own, cameras, truths), f"{used.processor:.2f}"]
    if node is None or theirs is None or format_ in UNREADABLE:
        return [*cells, "", "", "", ""]
    other = source.with_name(f"theirs.{ending}")
    program = node / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    words = ["node", program, "-q", "-w", "-g", "cpu", *theirs, source, other]
    try:
        used = run(words, stderr=subprocess.DEVNULL)
    except subprocess.CalledProcessError:  # two scales a splat, for example
        return [*cells, "fails", "", "", ""]
    size = other.stat().st_size
    cells += [f"{size / count:.2f}", loss(other, cameras, truths), f"{used.processor:.2f}"]
    return [*cells, f"{own.stat().st_size / size:.3f}"]


def loss(path: Path, cameras: Sequence[ms.Camera], truths: Sequence[np.ndarray]) -> str:
    """PSNR over all views."""
    if not cameras:
        return ""
    cloud = ms.load_gaussians(path)
    errors = [
        np.mean((ms.draw_splats(cloud, camera).color - truth) ** 2)
        for camera, truth in zip(cameras, truths, strict=True)
    ]
    mean = float(np.mean(errors))
    return f"{-10 * np.log10(mean):.1f}" if mean > 1e-12 else "over 120"


if __name__ == "__main__":
    main()
