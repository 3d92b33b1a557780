"""From the world of a splat file to Blender's, where z points up. NumPy only."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshsplats.cameras.framing import front_axes
from meshsplats.scene.camera import Camera, to_opengl


def to_blender(up: np.ndarray) -> np.ndarray:
    """(3, 3) float64 rotation from the world frame to Blender's for a unit ``up``: the scene stands upright
    and faces -y, as Blender's front view expects."""
    right, upward, forward = front_axes(np.asarray(up, np.float64))
    return np.stack([right, forward, upward])


def up_of(obj: Any) -> np.ndarray:
    """(3,) Blender's up direction in the frame of the object ``obj``."""
    up = np.array(obj.matrix_world.to_3x3().inverted_safe())[:, 2]
    return up if np.linalg.norm(up) > 0 else np.array([0.0, 0.0, 1.0])


def camera_pose(camera: Camera, rotation: np.ndarray) -> np.ndarray:
    """(4, 4) float64 camera-to-world matrix in Blender's frame; Blender's cameras look along -z with y up."""
    pose = to_opengl(camera.world_to_camera)
    pose[:3] = rotation @ pose[:3]
    return pose


def world_to_camera(pose: np.ndarray) -> np.ndarray:
    """(4, 4) float64 of the camera that has this ``camera_pose``."""
    return np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0]))


def lens(camera: Camera, sensor_width: float = 36.0) -> dict[str, Any]:
    """Blender's settings for the camera's lens, sensor fit HORIZONTAL: ``lens`` in mm, ``shift_x``,
    ``shift_y``, ``pixel_aspect_x``, ``pixel_aspect_y`` (these two belong to the scene)."""
    aspect = (camera.fy / camera.fx, 1.0) if camera.fy >= camera.fx else (1.0, camera.fx / camera.fy)
    ratio = aspect[1] / aspect[0]
    return {
        "lens": camera.fx * sensor_width / camera.width,
        "shift_x": (camera.width / 2 - camera.cx) / camera.width,
        "shift_y": (camera.cy - camera.height / 2) * ratio / camera.width,
        "pixel_aspect_x": aspect[0],
        "pixel_aspect_y": aspect[1],
    }


def sun_direction(azimuth: float, elevation: float) -> np.ndarray:
    """(3,) unit vector to the sun in Blender's frame, from degrees as in ``LightOptions.sun``."""
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(e) * np.sin(a), -np.cos(e) * np.cos(a), np.sin(e)])
