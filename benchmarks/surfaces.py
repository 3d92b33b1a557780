"""Surfaces of splats against the splats: quality, time, size.

    python benchmarks/surfaces.py --data ../shared/data playbot guitar truck

For each scene the surface with default options, by images of degree 0. PSNR is that of its images, 2 x 2
samples, against the splats' (degree 0, means over areas, on white) from the standard cameras, eight of 400
pixels at the given distances. "colours" is the same surface with colours of vertices, as fused. Seconds are
those of the processor, of all threads.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from _common import DATA, SCENES, Report, Stopwatch, arguments

import meshsplats as ms


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="+", choices=list(SCENES))
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--faces", type=int, default=20_000)
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    with Report(options) as report, tempfile.TemporaryDirectory() as folder:
        report.table("scene", "distance", "triangles", "colours dB", "surface dB", "MB", "seconds")
        for name in options.scenes:
            scene = SCENES[name]
            cloud = scene.cloud(options.data)
            more = {"faces": options.faces, "sh_degree": 0, "threads": options.threads}
            plain = ms.make_surface(cloud, texture=0, rounds=0, **more)
            watch = Stopwatch()
            surface = ms.make_surface(cloud, **more)
            seconds = watch.processor
            path = Path(folder) / "surface.glb"
            ms.save_base(surface, path)
            for distance in ("mid", "close"):
                cameras = scene.cameras(options.data, distance)
                truths = [ms.draw_splats(cloud, camera, sh_degree=0).color for camera in cameras]
                scores = [
                    np.mean(
                        [ms.psnr(ms.draw_surface(base, c), t) for c, t in zip(cameras, truths, strict=True)]
                    )
                    for base in (plain, surface)
                ]
                size = f"{path.stat().st_size / 1e6:.1f}"
                values = [f"{len(surface.faces):,}", *(f"{s:.2f}" for s in scores), size, f"{seconds:.0f}"]
                report.row(name, distance, *values)


if __name__ == "__main__":
    main()
