"""Trains a mesh on the training views of a COLMAP data set, and draws its test views for nvs-bench.

    python train_and_render.py DATA_FOLDER OUTPUT_FOLDER [--minutes 30] [--max-splats 200000]

Every eighth image by name is a test view, as nvs-bench counts them. Its image goes to
OUTPUT_FOLDER/test_renders under the same name, as .png; the mesh to OUTPUT_FOLDER/mesh.npz.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import meshsplats as ms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--max-splats", type=int, default=200_000)
    options = parser.parse_args()
    dataset = ms.load_dataset(options.data, test_every=8)
    points = ms.load_points(options.data, origin=dataset.origin)
    mesh = ms.train(dataset, points=points, minutes=options.minutes, max_splats=options.max_splats)
    renders = options.output / "test_renders"
    renders.mkdir(parents=True, exist_ok=True)
    ms.save_mesh(mesh, options.output / "mesh.npz")
    for view in dataset.test:
        image = ms.render(mesh, view.camera, background=(0, 0, 0), samples=2).color
        ms.save_image(renders / f"{Path(view.name).stem}.png", image)


if __name__ == "__main__":
    main()
