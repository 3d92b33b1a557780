"""Surfaces of splats against the splats, and against photographs: quality, time, size.

    python benchmarks/surfaces.py --data ../shared/data playbot guitar truck
    python benchmarks/surfaces.py --data ../shared/data --faces 40000 lego
    python benchmarks/surfaces.py --data ../shared/data --fans playbot guitar
    python benchmarks/surfaces.py --data ../shared/data --views 32 --size 400 --rounds 0 building stone

For each scene the surface with default options, by images of degree 0. Its images, 2 x 2 samples, are
compared with those of the splats (degree 0, means over areas, on white) from the standard cameras, eight of
400 pixels at the given distances; places from the first eight views that are found, from which no surface is
made. lego is fitted to photographs and compared with those that are held out.
"colours" is the same surface with vertex colours, as fused; "opaque" are the splats' own images, each
pixel opaque in its own colour or white: what an opaque surface of these colours could reach at best. With
--fans the splats as triangles are compared in place of surfaces: `convert`, no fine-tuning, `.glb`.

FLIP is the difference that people see where two images take turns (Andersson and others 2020; 0: none, 1: the
largest), by its authors' package: pip install flip-evaluator. LPIPS needs networks that no package brings.
Seconds are those of the processor, of all threads.
"""

from __future__ import annotations

import tempfile
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from _common import DATA, PHOTOGRAPHED, SCENES, Report, Scene, Stopwatch, arguments, mean_psnr

import meshsplats as ms
from meshsplats.datasets.splat_targets import HELD_OUT as HELD_OUT_VIEWS
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.surfaces.options import SurfaceOptions

DISTANCES = ("mid", "close")
SOLID = 0.5
"""Alpha from which a pixel of "opaque" is."""
HELD_OUT = "held-out photographs"
PLACES = {
    name: Scene(name, f"places/{path}")
    for name, path in (
        ("building", "building_300k_sh3/lod-meta.json"),
        ("stone", "stone_186k_sh3/meta.json"),
        ("park", "park_526k_sh0/meta.json"),
    )
}
FOUND = "found views"
NUMBERS = ("faces", "texture", "views", "size", "rounds", "resolution")
"""Options of surfaces, by default theirs."""


class Truth(NamedTuple):
    """What the images of a surface are compared with."""

    name: str
    cameras: list[ms.Camera]
    images: list[np.ndarray]
    """On white."""
    opaque: list[np.ndarray]
    """The same, each pixel opaque or white."""


def truths(name: str, data: Path, photographs: ms.Dataset | None, threads: int | None) -> Iterator[Truth]:
    if photographs is not None:
        views = photographs.test
        images = [view.load().over((1, 1, 1)) for view in views]
        yield Truth(HELD_OUT, [view.camera for view in views], images, [])
        return
    scene = PLACES.get(name) or SCENES[name]
    cloud = scene.cloud(data)
    for distance in [FOUND] if name in PLACES else DISTANCES:
        cameras = scene.cameras(data, distance) if distance != FOUND else found_views(cloud)
        drawn = [
            ms.draw_splats(cloud, camera, sh_degree=0, background=(0, 0, 0), threads=threads)
            for camera in cameras
        ]
        opaque = []
        for image in drawn:
            own = image.color / np.maximum(image.alpha, 1e-3)[..., None]
            opaque.append(np.where(image.alpha[..., None] >= SOLID, own, 1))
        images = [image.color + (1 - image.alpha)[..., None] for image in drawn]
        yield Truth(distance, cameras, images, opaque)


def found_views(cloud: ms.GaussianCloud) -> list[ms.Camera]:
    """Those that are held out of surfaces."""
    more = HELD_OUT_VIEWS + SurfaceOptions().views
    return list(ms.find_cameras(cloud, more).cameras[:HELD_OUT_VIEWS])


def flip(image: np.ndarray, truth: np.ndarray) -> float:
    """FLIP of two images; nan without its package."""
    try:
        from flip_evaluator import evaluate
    except ImportError:
        return float("nan")
    pair = (np.ascontiguousarray(i.clip(0, 1), np.float32) for i in (truth, image))
    return float(evaluate(*pair, "LDR", applyMagma=False)[1])


def scores(shown: BaseMesh | ms.SplatMesh, truth: Truth, threads: int | None) -> tuple[str, str]:
    """Mean PSNR in dB and mean FLIP."""
    drawn = [
        ms.render(shown, camera, background=(1, 1, 1), samples=2, threads=threads).color
        if isinstance(shown, ms.SplatMesh)
        else ms.draw_surface(shown, camera, threads=threads)
        for camera in truth.cameras
    ]
    differences = [flip(*pair) for pair in zip(drawn, truth.images, strict=True)]
    return f"{mean_psnr(drawn, truth.images):.2f}", f"{np.mean(differences):.4f}"


def of_fans(options: Namespace) -> None:
    """The table of splats as triangles."""
    with Report(options) as report, tempfile.TemporaryDirectory() as folder:
        report.table("scene", "compared with", "triangles", "fans dB", "FLIP", "MB", "seconds")
        for name in options.scenes:
            cloud = SCENES[name].cloud(options.data).of_degree(0)
            watch = Stopwatch()
            mesh = ms.convert(cloud, threads=options.threads)
            seconds = watch.processor
            path = Path(folder) / "fans.glb"
            ms.save_mesh(mesh, path)
            for truth in truths(name, options.data, None, options.threads):
                found = scores(mesh, truth, options.threads)
                size = f"{path.stat().st_size / 1e6:.1f}"
                report.row(name, truth.name, f"{len(mesh.faces):,}", *found, size, f"{seconds:.1f}")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="+", choices=[*SCENES, *PLACES, "lego"])
    parser.add_argument("--data", type=Path, default=DATA)
    for name in NUMBERS:
        parser.add_argument(f"--{name}", type=int)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--fans", action="store_true")
    options = parser.parse_args()
    if options.fans:
        of_fans(options)
        return
    threads = options.threads
    with Report(options) as report, tempfile.TemporaryDirectory() as folder:
        report.table(
            *("scene", "compared with", "triangles", "colours dB", "FLIP", "surface dB", "FLIP"),
            *("opaque dB", "MB", "seconds"),
        )
        for name in options.scenes:
            scene = SCENES.get(name) or PLACES.get(name) or PHOTOGRAPHED[name]
            cloud = scene.cloud(options.data)
            photographs = ms.load_dataset(options.data / scene.photographs) if scene.photographs else None
            chosen = {part: getattr(options, part) for part in NUMBERS if getattr(options, part) is not None}
            more = {"sh_degree": 0, "threads": threads} | chosen
            plain = ms.make_surface(cloud, photographs, **more | {"texture": 0, "rounds": 0})
            watch = Stopwatch()
            surface = ms.make_surface(cloud, photographs, **more)
            seconds = watch.processor
            path = Path(folder) / "surface.glb"
            ms.save_base(surface, path)
            for truth in truths(name, options.data, photographs, threads):
                found = [value for base in (plain, surface) for value in scores(base, truth, threads)]
                bound = f"{mean_psnr(truth.opaque, truth.images):.2f}" if truth.opaque else ""
                size = f"{path.stat().st_size / 1e6:.1f}"
                shown = [f"{len(surface.faces):,}", *found, bound, size, f"{seconds:.0f}"]
                report.row(name, truth.name, *shown)


if __name__ == "__main__":
    main()
