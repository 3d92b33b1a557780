"""Quality of a mesh at every size: PSNR against its splats at five sizes, under both looks.

    python benchmarks/sizes.py SPLATS ... --minutes 2 --look area
    python benchmarks/sizes.py SPLATS --mesh tuned.npz
    python benchmarks/sizes.py demo --minutes 2 --image docs/images/sizes.png

Views of ``orbit(cloud, 4, elevation=20)`` on white at degree 0, 200, 400, 800 and 1600 pixels wide and 800
pixels from half as far. Look 'area': the mean of an image four times as large, the mesh at 2 x 2 samples.
Look 'splats': the image of a 3DGS viewer at that size, the mesh at one sample. Rows: converted by default,
converted for the look 'splats' (at the cameras of a framing) and with the filter, and tuned, or the mesh
given. ``demo`` is this project's own scene. ``--image`` shows the middle of one view at four sizes:
splats, converted with a footprint and tuned on viewers' images of 400 pixels, as a mesh without a filter of
its own has to be, and tuned on means over areas.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from _common import Report, Stopwatch, areas, arguments, images, mean_psnr

import meshsplats as ms
from meshsplats.demo_scene import make_scene
from meshsplats.finetuning import RunOptions, make_config, starting_mesh, worthwhile_views
from meshsplats.finetuning.config import worthwhile_zooms

SIZES = {"200": (200, 1), "400": (400, 1), "800": (800, 1), "1600": (1600, 1), "near": (800, 2)}
SAMPLES = {"area": 2, "splats": 1}


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", nargs="+")
    parser.add_argument("--mesh", type=Path, help="a mesh to score instead of those made here")
    parser.add_argument("--minutes", type=float, default=2.0, help="0: convert only")
    parser.add_argument("--steps", type=int, help="steps, instead of a time")
    parser.add_argument("--look", choices=["area", "splats"], default="area", help="of the tuning")
    parser.add_argument("--looks", nargs="+", choices=["area", "splats"], default=["area", "splats"])
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--max-triangles", type=int)
    parser.add_argument("-o", "--output", type=Path, help="folder for the tuned meshes")
    parser.add_argument("--image", type=Path)
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    with Report(options) as report:
        report.table("scene", "mesh", "triangles", "look", *SIZES)
        for name in options.splats:
            cloud = make_scene() if name == "demo" else ms.load_gaussians(name)
            cloud = replace(cloud, sh=cloud.sh[:, :1])
            if options.image:
                image(cloud, options)
                continue
            for label, mesh in meshes(cloud, name, options):
                for look in options.looks:
                    figures = scores(cloud, mesh, look, options)
                    report.row(Path(name).stem, label, f"{len(mesh.faces):,}", look, *figures)


def meshes(cloud: ms.GaussianCloud, name: str, options: argparse.Namespace):
    """Labels and meshes, one by one."""
    if options.mesh:
        yield options.mesh.name, ms.load_mesh(options.mesh)
        return
    limit = {"max_triangles": options.max_triangles}
    yield "converted", ms.convert(cloud, **limit)
    yield "converted, look splats", ms.convert(cloud, look="splats", **limit)
    if cloud.kernel == "3dgs":
        yield "converted, filter", ms.convert(cloud, footprint="filter", **limit)
    if options.minutes or options.steps:
        tuned, description = tune(cloud, options, look=options.look, **limit)
        if options.output:
            options.output.mkdir(exist_ok=True)
            ms.save_mesh(tuned, options.output / f"{Path(name).stem}_{options.look}.npz")
        yield f"tuned, look {options.look}, {description}", tuned


def tune(
    cloud: ms.GaussianCloud, options: argparse.Namespace, *, look: str, zooms=None, samples=None, **start
):
    """As ``meshsplats finetune --look LOOK`` does it."""
    watch = Stopwatch()
    length = {"steps": options.steps} if options.steps else {"minutes": options.minutes}
    config = make_config("default", **length, samples=samples)
    if zooms is None:
        zooms = worthwhile_zooms(config, look, cloud.kernel == "3dgs")
    count = worthwhile_views(config)
    data = ms.splat_dataset(cloud, train=count, look=look, zooms=zooms, threads=options.threads)
    mesh = starting_mesh(cloud, [view.camera for view in data.train], config=config, look=look, **start)
    steps = []
    run = RunOptions(threads=options.threads, report_every=0, spent=watch.wall)
    tuned = ms.finetune(mesh, data, config, run=run, on_progress=lambda progress: steps.append(progress.step))
    return tuned, f"{steps[-1]} steps, {watch.wall:.0f} s"


def cameras(cloud: ms.GaussianCloud, count: int, side: int, zoom: int) -> list[ms.Camera]:
    orbit = ms.orbit(cloud, count, elevation=20, width=800, height=800)
    scaled = [camera.scaled(side / 800) for camera in orbit]
    return [replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom) for camera in scaled]


def scores(cloud: ms.GaussianCloud, mesh: ms.SplatMesh, look: str, options: argparse.Namespace) -> list[str]:
    """Mean PSNR at each size."""
    found = []
    for side, zoom in SIZES.values():
        places = cameras(cloud, options.views, side, zoom)
        truths = areas(cloud, places, look=look, threads=options.threads)
        drawn = images(mesh, places, samples=SAMPLES[look], threads=options.threads)
        found.append(f"{mean_psnr(drawn, truths):.2f}")
    return found


def image(cloud: ms.GaussianCloud, options: argparse.Namespace) -> None:
    from PIL import Image

    from meshsplats.images.writing import save_image, strip, to_bytes

    viewers, _ = tune(cloud, options, look="splats", zooms=(1,), samples=1, footprint="cameras")
    areas, _ = tune(cloud, options, look="area")
    rows = []
    for side in (200, 400, 800, 1600):
        (camera,) = cameras(cloud, 1, side, 1)
        target_image = ms.draw_splats(cloud, camera).color
        images = [target_image] + [ms.render(mesh, camera, samples=2).color for mesh in (viewers, areas)]
        captions = ["splats"]
        for label, image in zip(("tuned at 400 pixels", "tuned on areas"), images[1:], strict=True):
            captions.append(f"{label}: {ms.psnr(np.clip(image, 0, 1), np.clip(target_image, 0, 1)):.1f} dB")
        # The same part of the subject, as large in each row.
        half, (x, y) = side // 8, (round(0.5 * side), round(0.55 * side))
        parts = []
        for image in images:
            part = to_bytes(image[y - half : y + half, x - half : x + half])
            enlarged = Image.fromarray(part).resize((300, 300), Image.Resampling.NEAREST)
            parts.append(np.asarray(enlarged, np.float32) / 255)
        rows.append(strip(parts, [f"{side} px: {captions[0]}", *captions[1:]]))
    save_image(options.image, np.concatenate(rows, axis=0))


if __name__ == "__main__":
    main()
