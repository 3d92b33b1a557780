"""Camera: a pinhole with OpenCV axes. Orbits and domes round a scene, and camera files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshsplats._arrays import checked_array

MAX_SIDE = 1 << 15
"""Largest picture side in pixels."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes: +x right, +y down, +z forward.

    Concretely, a world point p is at ``X = world_to_camera[:3, :3] @ p + world_to_camera[:3, 3]`` in the camera's
    frame and on the picture at ``(fx * X[0] / X[2] + cx, fy * X[1] / X[2] + cy)`` pixels from the top left corner;
    the centre of pixel (row, col) is at (col + 0.5, row + 0.5).
    """

    world_to_camera: np.ndarray
    """(4, 4) float64 rigid transform."""
    fx: float
    """Focal length in pixels, horizontal."""
    fy: float
    """Focal length in pixels, vertical."""
    cx: float
    """Principal point in pixels from the left edge."""
    cy: float
    """Principal point in pixels from the top edge."""
    width: int
    height: int
    near: float = 0.01
    """Nothing nearer than this depth (z, scene units) is drawn."""
    name: str = ""

    def __post_init__(self) -> None:
        matrix = checked_array("world_to_camera", self.world_to_camera, np.float64, (4, 4))
        rotation = matrix[:3, :3]
        if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6 or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4:
            raise ValueError("world_to_camera must be a rigid transform: orthonormal rotation, last row 0 0 0 1")
        if np.linalg.det(rotation) < 0:
            raise ValueError("world_to_camera must not mirror: its rotation has determinant -1")
        object.__setattr__(self, "world_to_camera", matrix)
        for name in ("fx", "fy", "near"):
            value = float(getattr(self, name))
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, got {value}")
            object.__setattr__(self, name, value)
        for name in ("cx", "cy"):
            value = float(getattr(self, name))
            if not np.isfinite(value):
                raise ValueError(f"{name} must be finite, got {value}")
            object.__setattr__(self, name, value)
        for name in ("width", "height"):
            value = getattr(self, name)
            if int(value) != value or not 1 <= value <= MAX_SIDE:
                raise ValueError(f"{name} must be a whole number from 1 to {MAX_SIDE}, got {value}")
            object.__setattr__(self, name, int(value))

    @property
    def center(self) -> np.ndarray:
        """(3,) float64 position in the world frame."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]
