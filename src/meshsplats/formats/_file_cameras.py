"""Cameras of files whose cameras look along -z of their node, y up: glTF and USD."""

from __future__ import annotations

import numpy as np

from meshsplats._common.choices import MAX_SIDE
from meshsplats.scene.camera import OPENGL, Camera

_SIDE = 800
"""Height of the images, pixels; files name only their shape."""


def placed_camera(matrix: np.ndarray, angle: float, shape: float, name: str) -> Camera:
    """The camera of a node at (4, 4) ``matrix``, whose scale counts for nothing.

    ``angle``: radians from the lower edge of the image to the upper one; ``shape``: width by height. Raises
    ValueError for values that no camera has, and for a matrix that mirrors.
    """
    if not 0.01 < angle < 3.1 or not 1 / 16 <= shape <= 16:
        raise ValueError(
            "a camera needs an angle from the lower to the upper edge (yfov) of 0.01 to 3.1 radians and an"
            f" aspect ratio of 1/16 to 16, got {angle:g} and {shape:g}"
        )
    if not np.isfinite(matrix).all():
        raise ValueError("the place of a camera is not finite")
    left, size, right = np.linalg.svd(matrix[:3, :3])
    axes = left @ right
    if size.min() <= 0 or np.linalg.det(axes) < 0:
        raise ValueError("the node of a camera mirrors it, or has no size")
    rotation = (axes * OPENGL).T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ matrix[:3, 3]
    width = min(round(_SIDE * shape), MAX_SIDE)
    focal = _SIDE / 2 / np.tan(angle / 2)
    return Camera(pose, focal, focal, width / 2, _SIDE / 2, width, _SIDE, name=name)


def near_plane(camera: Camera, points: np.ndarray) -> float:
    """The near plane that files name: that of ``camera``, or one that is small beside the extent of the
    ``points`` (n, 3) of the scene."""
    return camera.near or float(np.ptp(points, axis=0).max()) / 10_000 or 1e-6
