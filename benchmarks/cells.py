"""Fine-tuning in cells against that of the whole: PSNR everywhere and near the borders of cells.

    python benchmarks/cells.py [--splats 60000] [--cell-splats 16000] [--steps 300] [--views 100]
        [--width 200]

Makes a city and judges the held-out PSNR of the mesh before, tuned as a whole, and tuned in cells. A pixel is
near a border if most of it shows splats that lie within one scene unit of another cell.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from _common import Report, Stopwatch, arguments

import meshsplats as ms
from meshsplats.cluster import Shared
from meshsplats.demo_scene.city import city_blocks
from meshsplats.finetuning.cells import CellOptions, Cells, CellScene, divide, finetune_cells
from meshsplats.rendering.looks import image_of
from meshsplats.scene.gaussians import GaussianCloud

NEAR = 1.0
"""Scene units."""


def near_borders(cells: Cells, means: np.ndarray) -> np.ndarray:
    """(n,) bool: splats within ``NEAR`` of another cell."""
    found = np.zeros(len(means), bool)
    for cell in range(len(cells.low)):
        inside = (means >= cells.low[cell] - NEAR) & (means <= cells.high[cell] + NEAR)
        found |= inside.all(axis=1) & (cells.owner != cell)
    return found


def scores(mesh: ms.SplatMesh, views: Sequence[ms.View], marked: np.ndarray) -> tuple[float, float, float]:
    """Mean PSNR of the images, of their pixels near borders, and of the others."""
    vertices = np.zeros(len(mesh.vertices), np.float32)
    vertices[mesh.faces[marked[mesh.face_splat]]] = 1
    colors = mesh.colors.copy()
    colors[:, :3] = vertices[:, None]
    found = []
    for view in views:
        image = np.clip(image_of(mesh, view.camera, view.background, samples=2)[0], 0, 1)
        border = image_of(replace(mesh, colors=colors), view.camera, (0, 0, 0), samples=2)[0][..., 0] > 0.5
        square = np.square(image - np.clip(view.image, 0, 1)).mean(axis=2)
        found.append([-10 * np.log10(square[rows].mean()) for rows in (square >= 0, border, ~border)])
    return tuple(np.mean(found, axis=0).tolist())


def main() -> None:
    parser = arguments(__doc__)
    for name, value in (("splats", 60_000), ("cell-splats", 16_000), ("steps", 300), ("views", 100)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--width", type=int, default=200)
    given = parser.parse_args()
    cloud = GaussianCloud.joined(list(city_blocks(given.splats, degree=0)))
    dataset = ms.splat_dataset(cloud, train=given.views, test=12, width=given.width)
    config = ms.make_config(steps=given.steps)
    marked = near_borders(divide(cloud.means, given.cell_splats), cloud.means)
    start = ms.starting_mesh(cloud, [view.camera for view in dataset.train])

    def show(name: str, mesh: ms.SplatMesh, seconds: float) -> None:
        decibels = (f"{value:.2f}" for value in scores(mesh, dataset.test, marked))
        report.row(name, *decibels, f"{seconds:.0f}")

    with Report(given) as report, tempfile.TemporaryDirectory() as folder:
        report.table("", "all, dB", "near borders", "elsewhere", "processor s")
        show("before", start, 0.0)
        watch = Stopwatch()
        whole = ms.finetune(start, dataset, config, run=ms.RunOptions(report_every=0))
        show("whole", whole, watch.processor)
        watch = Stopwatch()
        scene = Shared(lambda: CellScene(cloud, dataset))
        options, run = CellOptions(given.cell_splats), ms.RunOptions(folder=Path(folder) / "run")
        mesh = finetune_cells(scene, config, options, run).mesh()
        show("cells", mesh, watch.processor)


if __name__ == "__main__":
    main()
