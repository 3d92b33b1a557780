"""The start camera in ``settings.json`` of SuperSplat's viewer.

SuperSplat Studio writes the file, and its viewer reads it beside the splats: the Experience Settings 1 and
2 of https://developer.playcanvas.com/user-manual/supersplat/developers/. The ``position`` and ``target`` of
a camera are in the viewer's world, whose y axis points up: it turns splats half round about z. ``fov`` is
in degrees, across the longer side of the image.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.cameras.trajectories import look_at
from meshsplats.errors import FileFormatError
from meshsplats.scene.camera import Camera

NAME = "settings.json"
FOV = 75.0
"""Degrees where the file names none."""
NEAR_SHARE = 0.02
"""Near plane as a share of the distance of the target."""
_SIDE = 800
_MOST = 1e9
_DEFAULT = np.array([[2.0, 2.0, -2.0], [0.0, 0.0, 0.0]])
"""Position and target that PlayCanvas's splat-transform 2 writes for every scene, of any size."""
_HALF_TURN = np.array([-1.0, -1.0, 1.0])


def start_camera(content: object, path: Path, *, chosen: bool = False) -> Camera | None:
    """The camera with which the viewer starts, of a square image; None if the ``content`` of the JSON file
    ``path`` names none, or is another program's. ``chosen``: None, too, for the default of the program that
    writes such files, which knows nothing of the scene.

    Raises FileFormatError for a camera that is broken.
    """
    if not isinstance(content, dict):
        return None
    pose, cameras = content.get("camera"), content.get("cameras")
    if content.get("version") == 2 and isinstance(cameras, list) and cameras:
        pose = cameras[0].get("initial") if isinstance(cameras[0], dict) else None
    if not isinstance(pose, dict) or not ("position" in pose and "target" in pose):
        return None
    points = np.array([_point(pose, key, path) for key in ("position", "target")])
    if chosen and (points == _DEFAULT).all():
        return None
    place, target = _HALF_TURN * points
    fov = pose.get("fov") or FOV
    if type(fov) not in (int, float) or not 1 <= fov <= 170:
        raise FileFormatError(
            f"{path}: the camera's 'fov' must lie between 1 and 170 degrees, got {str(fov)[:40]}"
        )
    away = float(np.linalg.norm(target - place))
    if away == 0:
        raise FileFormatError(f"{path}: the camera's 'position' and 'target' must differ")
    return look_at(
        place, target, width=_SIDE, height=_SIDE, fov=float(fov), near=NEAR_SHARE * away, name="start"
    )


def _point(pose: dict[str, Any], key: str, path: Path) -> np.ndarray:
    value = pose[key]
    numbers = isinstance(value, list) and all(type(v) in (int, float) and abs(v) < _MOST for v in value)
    if not numbers or len(value) != 3:
        raise FileFormatError(
            f"{path}: the camera's {key!r} must be three finite numbers, got {str(value)[:60]}"
        )
    return np.array(value, np.float64)
