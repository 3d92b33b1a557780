"""nerfstudio's ``camera_path.json``, as its viewer and gsplat's save it.

The list ``camera_path`` has the cameras of all images: ``camera_to_world``, 16 numbers row by row with OpenGL
axes, and ``fov``, the angle in degrees from top to bottom. Without it, the list ``keyframes`` has those that
the path leads through: ``matrix``, 16 numbers row by row, or as text column by column (viewers up to 2023).
Poses are in the frame of nerfstudio's training, which is that of the splats it exports. Specification:
nerfstudio/cameras/camera_paths.py and nerfstudio/viewer/render_panel.py of nerfstudio 1.1.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.scene.camera import Camera, from_opengl


def is_camera_path(content: object) -> bool:
    """Whether the content of a JSON file is a camera path."""
    return isinstance(content, dict) and any(
        isinstance(content.get(key), list) for key in ("camera_path", "keyframes")
    )


def cameras_of_path(content: dict[str, Any], path: Path, most: int) -> list[Camera]:
    """The cameras of a camera path, of at most ``most``. FileFormatError, which names camera and field, for
    what is broken or no pinhole."""
    kind = content.get("camera_type") or "perspective"
    if str(kind).lower() not in ("perspective", "pinhole"):
        raise FileFormatError(
            f"{path}: a camera path of type {str(kind)[:40]!r}; only 'perspective' is read: choose it in the"
            " viewer"
        )
    key = "camera_path" if content.get("camera_path") else "keyframes"
    entries = content.get(key)
    if not isinstance(entries, list) or not entries:
        raise FileFormatError(
            f"{path}: a camera path without cameras: neither 'camera_path' nor 'keyframes' has any"
        )
    if len(entries) > most:
        raise FileFormatError(f"{path}: {len(entries)} cameras, more than the {most} that are accepted")
    width, height = (_number(content, f"render_{side}", str(path)) for side in ("width", "height"))
    result = []
    for i, entry in enumerate(entries):
        where = f"{path}: {key} {i}"
        if not isinstance(entry, dict):
            raise FileFormatError(f"{where}: must be a JSON object")
        fov = _number(
            entry if entry.get("fov") is not None else {"fov": content.get("default_fov")}, "fov", where
        )
        if not 0 < fov < 180:
            raise FileFormatError(f"{where}: 'fov' must lie between 0 and 180 degrees, got {fov:g}")
        focal = height / 2 / np.tan(np.radians(fov) / 2)
        matrix = _world_to_camera(entry, "camera_to_world" if key == "camera_path" else "matrix", where)
        try:
            result.append(
                Camera(matrix, focal, focal, width / 2, height / 2, width, height, name=f"{key} {i}")  # type: ignore[arg-type]
            )
        except ValueError as error:
            raise FileFormatError(f"{where}: {error}") from None
    return result


def _number(values: dict[str, Any], key: str, where: str) -> float:
    value: Any = values.get(key)
    if type(value) not in (int, float) or not abs(value) < 1e9:  # true for NaN, too
        raise FileFormatError(f"{where}: field {key!r} must be a finite number, got {json.dumps(value)[:60]}")
    return float(value)


def _world_to_camera(entry: dict[str, Any], key: str, where: str) -> np.ndarray:
    given, columns = entry.get(key), False
    if isinstance(given, str):
        columns = True
        try:
            given = json.loads(given)
        except (ValueError, RecursionError):
            given = None
    try:
        flat = np.array(given, dtype=object).ravel()
        numbers = flat.astype(np.float64) if all(type(v) in (int, float) for v in flat) else np.zeros(0)
    except (ValueError, TypeError, OverflowError):
        numbers = np.zeros(0)
    if len(numbers) not in (12, 16) or not (np.abs(numbers) < 1e9).all():
        raise FileFormatError(f"{where}: field {key!r} must be 16 finite numbers, from camera to world")
    matrix = np.vstack([numbers.reshape(-1, 4), [0, 0, 0, 1]])[:4]
    matrix = numbers.reshape(4, 4).T if columns and len(numbers) == 16 else matrix
    result = from_opengl(matrix)
    if result is None:
        raise FileFormatError(f"{where}: field {key!r} is no rotation and translation (it scales or mirrors)")
    return result
