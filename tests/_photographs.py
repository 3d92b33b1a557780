"""A data set of photographs made from pictures that a test draws itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from _datasets import save, write_json

from meshsplats.camera import Camera


def write_photographs(folder: Path, cameras: Sequence[Camera], pictures: Sequence[np.ndarray]) -> Path:
    """A nerfstudio folder: ``pictures`` (h, w, 3) or (h, w, 4) in [0, 1], one for each camera."""
    frames = []
    for i, (camera, picture) in enumerate(zip(cameras, pictures, strict=True)):
        save(folder / "images" / f"{i:04d}.png", np.asarray(picture))
        pose = np.linalg.inv(camera.world_to_camera)
        pose[:, 1:3] *= -1  # OpenGL: y up, z backward
        frames.append(
            {
                "file_path": f"images/{i:04d}.png",
                "transform_matrix": pose.tolist(),
                **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
                **{"w": camera.width, "h": camera.height},
            }
        )
    write_json(folder / "transforms.json", {"frames": frames})
    return folder
