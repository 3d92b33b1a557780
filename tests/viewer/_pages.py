"""A small scene for pages, as fixtures, and how screenshots compare with images."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

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


@pytest.fixture(name="cloud", scope="module")
def cloud_fixture() -> ms.GaussianCloud:
    return still_life()[0]


@pytest.fixture(name="mesh", scope="module")
def mesh_fixture() -> ms.SplatMesh:
    return still_life()[1]


@pytest.fixture(name="cameras", scope="module")
def cameras_fixture() -> list[ms.Camera]:
    return still_life()[2]


def levels(image: np.ndarray) -> np.ndarray:
    """A rendered image as a screenshot has it."""
    return np.rint(255 * image.clip(0, 1)).astype(int)
