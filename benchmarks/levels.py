"""Levels that are only converted: PSNR on 8 held-out views of each level, and processor time.

    python benchmarks/levels.py SPLATS [SPLATS ...] [--times]

Degree 0, look 'area', 2 x 2 samples a pixel. *plain*: every level merged from all splats, with the filter of
`convert`; *now*: as `meshsplats levels --no-tune` makes it. --times: processor seconds of the parts of the
command instead, with the views that it scores.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import meshsplats as ms
from meshsplats.evaluation.viewers import choose_alpha
from meshsplats.levels import (
    level_targets,
    likeness,
    make_level,
    merged,
    merges_further,
    plan_levels,
    views_to_score,
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("splats", type=Path, nargs="+")
    parser.add_argument("--times", action="store_true")
    args = parser.parse_args()
    for path in args.splats:
        cloud = ms.load_gaussians(path)
        print(f"{path.stem}, {len(cloud):,} splats", flush=True)
        source = cloud
        for level in plan_levels(len(cloud), 4):
            clock = [time.process_time()]
            targets = level_targets(cloud, level, sh_degree=0)
            cameras = [view.camera for view in targets.test]
            splats = merged(source, level, cameras)
            source = splats if merges_further(level) else source
            clock.append(time.process_time())
            mesh = make_level(splats, level, targets)
            clock.append(time.process_time())
            if not args.times:
                plain = ms.convert(cloud, cameras=cameras, max_splats=level.splats)
                scores = [likeness(each, cloud, cameras, sh_degree=0) for each in (plain, mesh)]
                print(f"{level.width} px: plain {scores[0]:.2f}, now {scores[1]:.2f} dB", flush=True)
                continue
            choice = choose_alpha(mesh, cameras)
            clock.append(time.process_time())
            with tempfile.TemporaryDirectory() as folder:
                ms.save_mesh(mesh, Path(folder) / "level.glb", **choice.options)
            clock.append(time.process_time())
            score = likeness(mesh, cloud, cameras[: views_to_score(len(mesh.faces), len(cloud))])
            clock.append(time.process_time())
            names = ("merge", "make", "choose alpha", "save", "score")
            parts = [f"{name} {b - a:.1f}" for name, a, b in zip(names, clock, clock[1:], strict=False)]
            print(f"{level.width} px: {', '.join(parts)} s; {score:.2f} dB", flush=True)


if __name__ == "__main__":
    main()
