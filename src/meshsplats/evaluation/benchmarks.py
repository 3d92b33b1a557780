"""Benchmark protocols of the splatting literature: which scenes, which resolution, which views are held
out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Protocol:
    """A benchmark of several scenes, each a folder of photographs in the folder of the data set."""

    title: str
    scenes: Mapping[str, int]
    """Scene: by how much its pictures are smaller than the originals (``images_2``, ``images_4``)."""
    reported: Mapping[str, tuple[float, float, float]]
    """Figures from the literature for the same scenes: PSNR, SSIM, LPIPS (VGG)."""
    test_every: int = 8
    sh_degree: int = 0


_OUTDOOR = {"bicycle": 4, "garden": 4, "stump": 4}
_INDOOR = {"bonsai": 2, "counter": 2, "kitchen": 2, "room": 2}

PROTOCOLS: Mapping[str, Protocol] = {
    "mipnerf360": Protocol(
        "Mip-NeRF 360, 7 scenes",
        _OUTDOOR | _INDOOR,
        {"MeshSplats paper": (28.08, 0.817, 0.229), "3DGS-30K": (28.69, 0.87, 0.220)},
    ),
    "mipnerf360-9": Protocol(
        "Mip-NeRF 360, 9 scenes", _OUTDOOR | {"flowers": 4, "treehill": 4} | _INDOOR, {}
    ),
    "tanks-and-temples": Protocol(
        "Tanks and Temples",
        {"train": 1, "truck": 1},
        {"MeshSplats paper": (21.71, 0.766, 0.248), "3DGS-30K": (23.14, 0.841, 0.183)},
    ),
    "deep-blending": Protocol(
        "Deep Blending",
        {"drjohnson": 1, "playroom": 1},
        {"MeshSplats paper": (29.50, 0.890, 0.254), "3DGS-30K": (29.41, 0.903, 0.243)},
    ),
}
"""Those of Table 1 of arXiv 2502.07754, at the resolutions of the 3DGS paper: every 8th view by name is held
out, splats count at degree 0; the background is what each scene's splats were trained over. Its 7 scenes of
Mip-NeRF 360 are the public ones; the other two are to be had on request."""

_SUFFIXES = (".npz", ".glb", ".gltf", ".ply", ".obj", ".splat", ".spz", ".sog")


def find_input(folder: Path, scene: str) -> Path | None:
    """Mesh, splats or model folder of ``scene`` in ``folder``: ``scene.npz``, ``scene.ply`` or ``scene/``."""
    for suffix in _SUFFIXES:
        if (folder / (scene + suffix)).is_file():
            return folder / (scene + suffix)
    return folder / scene if (folder / scene).is_dir() else None
