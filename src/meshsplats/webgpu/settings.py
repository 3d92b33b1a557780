"""What holds for all windows of an image, and the uniform of a frame that is made of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import MIN_TRANSMITTANCE
from meshsplats.scene.order import Order
from meshsplats.webgpu import kernels
from meshsplats.webgpu.device import BUDGET
from meshsplats.webgpu.layout import tiles_of


@dataclass(frozen=True)
class DrawSettings:
    """What does not change from window to window."""

    samples: int = 1
    max_layers: int = 0
    min_transmittance: float = MIN_TRANSMITTANCE
    cutoff: float = -1.0
    filter_px2: float = 0.0
    order: Order = "fragment"
    queue: int = kernels.QUEUE
    long_queue: int = kernels.LONG_QUEUE
    budget: int | None = None
    """Loop iterations of one walk through a tile list; None: those of the device."""


def frame_uniform(
    camera: Camera,
    settings: DrawSettings,
    counts: dict[str, int],
    capacity: int,
    offsets: Sequence[int],
    pose: np.ndarray | None = None,
) -> np.ndarray:
    """The bytes of the uniform ``Frame``; ``pose`` (4, 4) float64 overrides that of the camera."""
    s = settings.samples
    w, h = camera.width * s, camera.height * s
    data = np.zeros(64, np.float32)
    words = data.view(np.uint32)
    matrix = camera.world_to_camera if pose is None else pose
    for i in range(3):
        data[4 * i : 4 * i + 3] = matrix[i, :3]
    center = camera.center if pose is None else -np.linalg.solve(pose[:3, :3], pose[:3, 3])
    data[12:15] = center
    data[16:19] = center - data[12:15]
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy]) * s
    data[20:24] = lens
    assert camera.near is not None
    data[24:28] = camera.near, settings.min_transmittance, settings.cutoff, settings.filter_px2 * s * s
    words[28:32] = w, h, tiles_of(w), tiles_of(h)
    words[32:36] = counts["vertices"], counts["faces"], counts["runs"], counts["splats"]
    words[36:39] = counts["groups"], capacity, settings.max_layers
    words[39] = BUDGET if settings.budget is None else settings.budget
    words[40:43] = offsets
    words[43] = s
    for i in range(3):
        data[44 + 4 * i : 47 + 4 * i] = matrix[i, :3] - data[4 * i : 4 * i + 3]
    data[56:60] = lens - data[20:24]
    words[60] = counts["harmonics"]
    return data
