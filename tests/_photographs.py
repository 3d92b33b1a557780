"""A data set of photographs made from images that a test draws itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from _datasets import save, write_json

from meshsplats.scene.camera import Camera


def write_photographs(folder: Path, cameras: Sequence[Camera], images: Sequence[np.ndarray]) -> Path:
    """A nerfstudio folder: ``images`` (h, w, 3) or (h, w, 4) in [0, 1], one for each camera."""
    frames = []
    for i, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        save(folder / "images" / f"{i:04d}.png", np.asarray(image))
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
