"""Meshes for depth buffers: PSNR at held-out cameras, near, middle and far, and processor time.

    python benchmarks/engines.py --data DATA --scenes playbot guitar truck [--steps 400] [--views 100]
        [--soft-share 0.05] [--opaque-share 1] [--hidden-hits 1] [--threads 1] [-o FOLDER]
        [--max-triangles N] [--color-rate 0.05] [--position-rate 0.04] [--anneal-share 0.25]

Trains on images of the splats at degree 0 and judges at DATA/cameras on white, against means over each pixel.
benchmarks/viewers/viewers.py --mesh draws the meshes of FOLDER with three.js and Babylon.js.
"""

from __future__ import annotations

from pathlib import Path

from _common import DISTANCES, SCENES, Report, Stopwatch, areas, arguments, images, mean_psnr

import meshsplats as ms
from meshsplats.scene.mesh import solid_faces


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=[*SCENES])
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--soft-share", type=float, default=0.05)
    parser.add_argument("--opaque-share", type=float, default=1.0)
    parser.add_argument("--hidden-hits", type=int, default=1)
    parser.add_argument("--max-triangles", type=int, help="at the start, with similar splats merged")
    defaults = ms.FinetuneConfig()
    for name in ("color_rate", "position_rate", "anneal_share"):
        option = f"--{name.replace('_', '-')}"
        parser.add_argument(option, type=float, default=getattr(defaults, name))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, help="folder for the meshes")
    args = parser.parse_args()
    config = ms.make_config(
        steps=args.steps,
        opacity="cutoff",
        soft_share=args.soft_share,
        opaque_share=args.opaque_share,
        hidden_hits=args.hidden_hits,
        color_rate=args.color_rate,
        position_rate=args.position_rate,
        anneal_share=args.anneal_share,
    )
    with Report(args) as report:
        heads = ("triangles", "opaque, blended", "cameras", "1 x 1", "2 x 2", "4 x 4", "processor s")
        report.table("scene", *heads)
        for name in args.scenes:
            watch = Stopwatch()
            cloud = SCENES[name].cloud(args.data)
            dataset = ms.splat_dataset(cloud, train=args.views, test=0, sh_degree=0)
            cameras = [view.camera for view in dataset.train]
            mesh = ms.starting_mesh(cloud, cameras, max_triangles=args.max_triangles)
            run = ms.RunOptions(report_every=0, threads=args.threads)
            tuned = ms.finetune(mesh, dataset, config, run=run)
            seconds = watch.processor
            if args.output:
                args.output.mkdir(exist_ok=True)
                ms.save_mesh(tuned, args.output / f"{name}.npz")
            solid = int(solid_faces(tuned).sum())
            sizes = (f"{len(mesh.faces):,}", f"{solid:,}, {len(tuned.faces) - solid:,}")
            for distance in DISTANCES:
                cameras = SCENES[name].cameras(args.data, distance)
                truths = areas(cloud, cameras, sh_degree=0)
                scores = [mean_psnr(images(tuned, cameras, samples=side), truths) for side in (1, 2, 4)]
                report.row(name, *sizes, distance, *(f"{score:.2f}" for score in scores), f"{seconds:.0f}")


if __name__ == "__main__":
    main()
