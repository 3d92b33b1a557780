"""Levels that are only converted: PSNR on 8 held-out views of each level, and processor time.

    python benchmarks/levels.py SPLATS [SPLATS ...] [--times]

Degree 0, look 'area', 2 x 2 samples a pixel. *plain*: every level merged from all splats, with the filter of
`convert`; *now*: as `meshsplats levels --no-tune` makes it. --times: processor seconds of the parts of the
command instead, with the views that it scores.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from _common import Report, Stopwatch, arguments

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
    parser = arguments(__doc__)
    parser.add_argument("splats", type=Path, nargs="+")
    parser.add_argument("--times", action="store_true")
    args = parser.parse_args()
    with Report(args) as report:
        if args.times:
            report.table(
                *("scene", "pixels", "merge, s", "make", "choose alpha", "save", "score", "of the level, dB")
            )
        else:
            report.table("scene", "pixels", "plain, dB", "now, dB")
        for path in args.splats:
            for row in rows(ms.load_gaussians(path), args.times):
                report.row(path.stem, *row)


def rows(cloud: ms.GaussianCloud, times: bool) -> Iterator[list[str]]:
    source = cloud
    for level in plan_levels(len(cloud), 4):
        watch = Stopwatch()
        marks = [0.0]
        targets = level_targets(cloud, level, sh_degree=0)
        cameras = [view.camera for view in targets.test]
        splats = merged(source, level, cameras)
        source = splats if merges_further(level) else source
        marks.append(watch.processor)
        mesh = make_level(splats, level, targets)
        marks.append(watch.processor)
        if not times:
            plain = ms.convert(cloud, cameras=cameras, max_splats=level.splats)
            scores = (likeness(each, cloud, cameras, sh_degree=0) for each in (plain, mesh))
            yield [str(level.width), *(f"{score:.2f}" for score in scores)]
            continue
        choice = choose_alpha(mesh, cameras)
        marks.append(watch.processor)
        with tempfile.TemporaryDirectory() as folder:
            ms.save_mesh(mesh, Path(folder) / "level.glb", **choice.options)
        marks.append(watch.processor)
        score = likeness(mesh, cloud, cameras[: views_to_score(len(mesh.faces), len(cloud))])
        marks.append(watch.processor)
        parts = (f"{after - before:.1f}" for before, after in pairwise(marks))
        yield [str(level.width), *parts, f"{score:.2f}"]


if __name__ == "__main__":
    main()
