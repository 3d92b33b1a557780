"""Camera files: JSON, in our own form or that of the 3D Gaussian Splatting code."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.arrays import checked_array
from meshsplats._common.foreign import what_it_is
from meshsplats._common.json_files import read_json
from meshsplats._common.kinds import need_all, need_path
from meshsplats._files.atomic import write_text
from meshsplats.cameras.camera_path import cameras_of_path, is_camera_path
from meshsplats.cameras.viewer_settings import start_camera
from meshsplats.errors import FileFormatError
from meshsplats.scene.camera import Camera

MAX_CAMERAS = 20_000


def load_cameras(
    path: str | os.PathLike[str], *, origin: Sequence[float] | np.ndarray = (0, 0, 0)
) -> list[Camera]:
    """Cameras of a JSON file, in file order.

    They are relative to the point ``origin`` (3,) of the world, which is to be that of the scene that they
    look at, ``GaussianCloud.origin`` or ``SplatMesh.origin``.

    Four forms are read. Ours is a list of ``{name, width, height, fx, fy, cx, cy, world_to_camera}`` with a
    4x4 matrix and OpenCV axes; ``name``, ``near`` (then it follows the scene), and cx and cy (then the
    image's centre) may be missing. Another is the ``cameras.json`` that INRIA's 3DGS trainer writes:
    ``{img_name, width, height, position, rotation, fx, fy}`` with ``rotation`` (3x3) from camera to world and
    the principal point at the image's centre. The third is nerfstudio's ``camera_path.json``, whose cameras
    are in the frame of the splats that ``ns-export`` writes. The fourth is the start camera in the
    ``settings.json`` of SuperSplat's viewer. For a folder, its ``cameras.json`` is read.

    Raises FileFormatError, which names the camera and the field, for a file that is broken or of another
    format, and OSError if it cannot be opened.
    """
    need_path(path=path)
    point = checked_array("origin", origin, np.float64, (3,))
    path = Path(path)
    if path.is_dir():
        path = _file_in(path)
    if path.is_file() and (what := _foreign(path)):
        raise FileFormatError(f"{path}: {what}; a camera file is a JSON list of cameras")
    entries = read_json(path)
    if is_camera_path(entries):
        found = cameras_of_path(entries, path, MAX_CAMERAS)
        return [camera.relative_to(point) for camera in found]
    if (start := start_camera(entries, path)) is not None:
        return [start.relative_to(point)]
    if not isinstance(entries, list):
        other = isinstance(entries, dict) and "frames" in entries
        what = " with 'frames', a data set: read it with load_dataset or ``data``" if other else ""
        raise FileFormatError(
            f"{path}: a camera file is a JSON list of cameras, this is a JSON {_kind(entries)}{what}"
        )
    if not entries:
        raise FileFormatError(f"{path}: holds no camera")
    if len(entries) > MAX_CAMERAS:
        raise FileFormatError(
            f"{path}: {len(entries)} cameras, more than the {MAX_CAMERAS} that are accepted"
        )
    found = [_camera_from_json(entry, f"{path}: camera {i}") for i, entry in enumerate(entries)]
    return [camera.relative_to(point) for camera in found]


def model_folder(source: Path) -> Path | None:
    """The folder of a trained model, with a ``cameras.json``, that ``source`` is, or that it lies in as
    ``point_cloud/iteration_N`` or a file there; else None."""
    folder = source if source.is_dir() else source.absolute().parent
    if re.fullmatch(r"iteration_[0-9]+", folder.name) and folder.absolute().parent.name == "point_cloud":
        folder = folder.absolute().parent.parent
    elif folder != source:
        return None
    return folder if (folder / "cameras.json").is_file() else None


def _file_in(folder: Path) -> Path:
    """The camera file of a model folder. FileFormatError for the folder of a data set, which has another
    option."""
    path = folder / "cameras.json"
    names = (
        "transforms.json",
        "transforms_train.json",
        "sparse",
        "images.txt",
        "images.bin",
        "poses_bounds.npy",
    )
    there = [] if path.is_file() else [name for name in names if (folder / name).exists()]
    if there:
        raise FileFormatError(
            f"{folder}: a data set ({there[0]} is there): read it with load_dataset, or with ``data`` in"
            " place of ``cameras``"
        )
    return path


def _foreign(path: Path) -> str:
    """What a file is that cannot be JSON; empty if it can, or if that is unknown."""
    with open(path, "rb") as file:
        head = file.read(64)
    return "" if re.match(rb"(\xef\xbb\xbf)?\s*[\[{]", head) else what_it_is(path)


def save_cameras(
    cameras: Sequence[Camera],
    path: str | os.PathLike[str],
    *,
    origin: Sequence[float] | np.ndarray = (0, 0, 0),
) -> None:
    """Writes the JSON list that ``load_cameras`` reads, to the last digit; replaces a file of that name.

    Cameras that are relative to the point ``origin`` (3,) of the world are written in the world.

    Raises TypeError for what is no list of cameras, ValueError for an ``origin`` that is not three finite
    numbers, and OSError if the file cannot be written.
    """
    need_all(Camera, cameras=cameras)
    need_path(path=path)
    point = checked_array("origin", origin, np.float64, (3,))
    fields = ("name", "width", "height", "fx", "fy", "cx", "cy")
    entries = [
        {key: getattr(camera, key) for key in fields}
        | ({} if camera.near is None else {"near": camera.near})
        | {"world_to_camera": camera.world_to_camera.tolist()}
        for camera in (camera.relative_to(-point) for camera in cameras)
    ]
    write_text(path, json.dumps(entries, indent=1) + "\n")


def _camera_from_json(entry: object, where: str) -> Camera:
    if not isinstance(entry, dict):
        raise FileFormatError(f"{where}: must be a JSON object, got a JSON {_kind(entry)}")
    name = entry.get("name", entry.get("img_name", ""))
    if not isinstance(name, str) or len(name) > 1000:
        raise FileFormatError(f"{where}: field 'name' must be a string of up to 1000 characters")
    where = f"{where} ({name[:60]!r})" if name else where
    width, height = (float(_numbers(entry, key, (), where)) for key in ("width", "height"))
    matrix = np.eye(4)
    if "world_to_camera" in entry:
        matrix = _numbers(entry, "world_to_camera", (4, 4), where)
    elif "rotation" in entry and "position" in entry:
        rotation = _numbers(entry, "rotation", (3, 3), where).T
        matrix[:3, :3] = rotation
        matrix[:3, 3] = -rotation @ _numbers(entry, "position", (3,), where)
    else:
        has = ", ".join(entry)[:200]
        raise FileFormatError(f"{where}: needs 'world_to_camera', or 'rotation' and 'position'; it has {has}")
    defaults = {"cx": width / 2, "cy": height / 2, "near": None}
    lens = {
        key: float(_numbers(entry, key, (), where)) if key in entry or key not in defaults else defaults[key]
        for key in ("fx", "fy", "cx", "cy", "near")
    }
    try:
        return Camera(matrix, width=width, height=height, name=name, **lens)  # type: ignore[arg-type]
    except ValueError as error:
        raise FileFormatError(f"{where}: {error}") from None


def _numbers(entry: dict[str, Any], key: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """Field ``key`` as a float64 array of that shape, () for a single number."""
    if key not in entry:
        raise FileFormatError(f"{where}: field {key!r} is missing")
    try:
        value = np.array(entry[key], dtype=object)
        fits = value.shape == shape and all(type(v) in (int, float) for v in value.ravel())
        number = value.astype(np.float64) if fits else None
    except (ValueError, OverflowError):  # ragged lists; an integer of a thousand digits
        number = None
    if number is None or not np.isfinite(number).all():
        wanted = "a finite number" if shape == () else f"finite numbers of shape {shape}"
        raise FileFormatError(f"{where}: field {key!r} must be {wanted}, got {_shown(entry[key])}")
    return number


def _kind(value: object) -> str:
    if isinstance(value, dict):
        return "object"
    return "list" if isinstance(value, list) else "value"


def _shown(value: object) -> str:
    if isinstance(value, (dict, list)):
        return f"a JSON {_kind(value)} of {len(value)}"
    return json.dumps(value)[:60]
