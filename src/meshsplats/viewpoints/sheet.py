"""A sheet of small images of views, in their order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats.rendering.api import render_splats
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud

COLUMNS = 6
MOST = 24
SIDE = 200
"""Pixels of the longer side of each image."""
GAP = 4


def contact_sheet(
    cloud: GaussianCloud, cameras: Sequence[Camera], *, threads: int | None = None
) -> np.ndarray:
    """(h, w, 3) float32 image of what up to ``MOST`` of the ``cameras`` see of the splats, row by row.

    All cameras have images of one size.
    """
    images = [render_splats(cloud, camera.within(SIDE), threads=threads).color for camera in cameras[:MOST]]
    height, width = images[0].shape[:2]
    columns = min(COLUMNS, len(images))
    rows = -(-len(images) // columns)
    sheet = np.ones((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), np.float32)
    for i, image in enumerate(images):
        top, left = i // columns * (height + GAP), i % columns * (width + GAP)
        sheet[top : top + height, left : left + width] = image.clip(0, 1)
    return sheet
