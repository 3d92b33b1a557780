"""A small scene for pages, and how screenshots compare with images."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

import meshsplats as ms
from meshsplats.demo_scene import make_scene

WIDTH, HEIGHT = 120, 96
"""Of the scene's cameras, in pixels."""


@lru_cache
def still_life() -> tuple[ms.GaussianCloud, ms.SplatMesh, list[ms.Camera]]:
    """Splats, the mesh made of them and three cameras."""
    cloud = make_scene(300)
    cameras = ms.orbit(cloud, 3, width=WIDTH, height=HEIGHT, elevation=20, distance=0.9)
    return cloud, ms.convert(cloud), cameras


def levels(image: np.ndarray) -> np.ndarray:
    """A rendered image as a screenshot has it."""
    return np.rint(255 * image.clip(0, 1)).astype(int)
