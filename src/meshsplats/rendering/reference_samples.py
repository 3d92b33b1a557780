"""Samples, pixels and the camera's frame in the executable specification."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats.scene.camera import Camera


def checked_background(background: Sequence[float] | np.ndarray, camera: Camera) -> np.ndarray:
    array = np.asarray(background, np.float64)
    if array.shape not in ((3,), (camera.height, camera.width, 3)):
        raise ValueError(
            f"background must have shape (3,) or ({camera.height}, {camera.width}, 3), got {array.shape}"
        )
    return array


def sample_positions(camera: Camera, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y (n,) in pixels of all samples, row by row: pixel centres where ``samples`` is 1."""
    if not (samples == int(samples) and samples >= 1):
        raise ValueError(f"samples must be a whole number from 1 on, got {samples}")
    across = (np.arange(camera.width * samples) + 0.5) / samples
    down = (np.arange(camera.height * samples) + 0.5) / samples
    y, x = np.meshgrid(down, across, indexing="ij")
    return x.ravel(), y.ravel()


def pixel_means(values: np.ndarray, camera: Camera, samples: int) -> np.ndarray:
    """(h, w, c) means over the samples of each pixel of ``values`` (n, c)."""
    grid = values.reshape(camera.height, samples, camera.width, samples, values.shape[1])
    return grid.mean(axis=(1, 3))


def to_camera(points: np.ndarray, camera: Camera) -> np.ndarray:
    """(n, 3) world points in the camera's frame."""
    columns = camera.world_to_camera[:3].T
    x, y, z = points.astype(np.float64).T[:, :, None]
    # Summed term by term so that a point's rounding does not depend on its row.
    return x * columns[0] + y * columns[1] + z * columns[2] + columns[3]
