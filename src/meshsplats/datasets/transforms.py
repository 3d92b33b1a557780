"""``transforms.json`` and its kin: NeRF-synthetic, instant-ngp, nerfstudio.

Poses are camera-to-world with OpenGL axes (+x right, +y up, looking along -z). Specification:
docs.nerf.studio/quickstart/data_conventions.html and the files of the NeRF-synthetic scenes.
"""

from __future__ import annotations

import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from meshsplats._common.choices import MAX_SIDE
from meshsplats._common.json_files import read_json
from meshsplats.datasets.image_files import Frame, ImageIndex, find, inside, is_readable, leads_out
from meshsplats.datasets.lens import Lens
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.images.reading import read_header
from meshsplats.scene.camera import from_opengl

MAX_FRAMES = 200_000
_SPLITS = ("train_filenames", "val_filenames", "test_filenames")
_RADIAL = ("k1", "k2", "k3", "k4")
_TANGENTIAL = ("p1", "p2")
_PERSPECTIVE = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


@dataclass(frozen=True)
class Transforms:
    """The content of such a file."""

    frames: list[Frame]
    """In file order."""
    splits: dict[str, set[str]]
    """Files of each split the file names: 'train', 'val', 'test'; empty if it names none."""


def read_transforms(path: Path) -> Transforms:
    """The frames of ``path``. Where sizes are not in the file they are read from the images beside it; a
    frame whose image is missing then has no lens.

    Raises FileFormatError, which names the frame and the field, for what is broken.
    """
    content = _read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise FileFormatError(f"{path}: needs a list 'frames' with at least one frame")
    if len(frames) > MAX_FRAMES:
        raise FileFormatError(f"{path}: {len(frames):,} frames, more than the {MAX_FRAMES:,} accepted")
    splits = {}
    for key in _SPLITS:
        if content.get(key) is not None:
            names = content[key]
            if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
                raise FileFormatError(f"{path}: {key!r} must be a list of file names")
            splits[key.removesuffix("_filenames")] = set(names)
    common = {key: value for key, value in content.items() if key != "frames"}
    index = ImageIndex(path.parent)
    found = [_frame(path, index, common, f, i) for i, f in enumerate(frames)]
    masks = [(str(given.get("mask_path")), frame.mask) for given, frame in zip(frames, found, strict=True)]
    for what, pairs in (("images", [(frame.name, frame.file) for frame in found]), ("masks", masks)):
        moved = [f"{a}: {b}" for a, b in pairs if b and leads_out(a) and not leads_out(b)]
        if moved:
            warnings.warn(
                f"{path}: {len(moved)} {what} have paths of another machine; files of this folder that end in"
                f" the same parts are used instead ({moved[0][:200]})",
                DataWarning,
                stacklevel=2,
            )
    return Transforms(found, splits)


def points_file(path: Path) -> str | None:
    """The point cloud that ``path`` names, relative to its folder, found as images are; None if it names
    none."""
    named = _read_json(path).get("ply_file_path")
    if named is not None and not isinstance(named, str):
        raise FileFormatError(f"{path}: 'ply_file_path' must be a file name")
    return _here(path.parent, named) if named else None


def _read_json(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict):
        raise FileFormatError(f"{path}: must be a JSON object with 'frames'")
    return content


def _frame(path: Path, index: ImageIndex, common: dict[str, Any], frame: object, i: int) -> Frame:
    where = f"{path}: frame {i}"
    if not isinstance(frame, dict):
        raise FileFormatError(f"{where}: must be a JSON object")
    file, mask = frame.get("file_path"), frame.get("mask_path") or None
    if not isinstance(file, str) or not file:
        raise FileFormatError(f"{where}: needs a 'file_path'")
    if mask is not None and not isinstance(mask, str):
        raise FileFormatError(f"{where}: 'mask_path' must be a file name")
    name, file = file.removeprefix("./"), _here(path.parent, file)
    where = f"{where} ({file[:60]!r})"
    # Some writers name what they do not know, with null.
    values = common | {key: value for key, value in frame.items() if value is not None}
    values = {key: value for key, value in values.items() if value is not None}
    lens = _lens(index, values, file, where)
    mask = _here(path.parent, mask) if mask else None
    return Frame(name, file, lens, _world_to_camera(frame, where), mask)


def _here(folder: Path, file: str) -> str:
    """``file``, or for a path that leads out of ``folder`` the last parts of it, as many as possible, that
    are those of a file there."""
    if leads_out(file):
        parts = PurePosixPath(file.replace("\\", "/")).parts
        for i in range(1, len(parts)):
            if ".." not in parts[i:] and folder.joinpath(*parts[i:]).is_file():
                return "/".join(parts[i:])
    return file


def _lens(index: ImageIndex, values: dict[str, Any], file: str, where: str) -> Lens | None:
    size = _size(index, values, file, where)
    if size is None:
        return None
    width, height = size
    model = values.get("camera_model") or ("OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV")
    model = model.upper() if isinstance(model, str) else model
    if model == "EQUIRECTANGULAR":
        return Lens(model, 1, 1, width / 2, height / 2, width, height)
    if model not in (*_PERSPECTIVE, *_FISHEYE):
        raise FileFormatError(
            f"{where}: camera_model {str(model)[:40]!r} is not known here; known: "
            + ", ".join((*_PERSPECTIVE, *_FISHEYE, "EQUIRECTANGULAR"))
        )
    fx, fy = _focals(values, width, height, where)
    cx, cy = _number(values, "cx", where, width / 2), _number(values, "cy", where, height / 2)
    k1, k2, k3, k4 = (_number(values, key, where, 0.0) for key in _RADIAL)
    p1, p2 = (_number(values, key, where, 0.0) for key in _TANGENTIAL)
    coefficients: tuple[float, ...]
    if model in _FISHEYE:
        if p1 or p2:
            raise FileFormatError(f"{where}: a fisheye has no tangential terms p1, p2")
        name, coefficients = "OPENCV_FISHEYE", (k1, k2, k3, k4)
    elif k3 or k4:
        if k4:
            raise FileFormatError(
                f"{where}: k4 is {k4:g}; programs differ in what it means for {model}: leave it out"
            )
        name, coefficients = "FULL_OPENCV", (k1, k2, p1, p2, k3, 0, 0, 0)
    elif k1 or k2 or p1 or p2:
        name, coefficients = "OPENCV", (k1, k2, p1, p2)
    else:
        name, coefficients = "PINHOLE", ()
    try:
        return Lens(name, fx, fy, cx, cy, width, height, coefficients)
    except ValueError as error:
        raise FileFormatError(f"{where}: {error}") from None


def _size(index: ImageIndex, values: dict[str, Any], file: str, where: str) -> tuple[int, int] | None:
    """(width, height) that the intrinsics are meant for."""
    if "w" in values and "h" in values:
        sides = (_number(values, "w", where), _number(values, "h", where))
        if not all(side == int(side) and 1 <= side <= MAX_SIDE for side in sides):
            raise FileFormatError(
                f"{where}: 'w' and 'h' must be whole numbers from 1 to {MAX_SIDE},"
                f" got {sides[0]:g}, {sides[1]:g}"
            )
        return int(sides[0]), int(sides[1])
    found = find(index.folder, file, where)
    alike = [name for name in index.by_last_parts(file) if is_readable(name)] if found is None else []
    if len(alike) == 1:
        found = inside(index.folder, alike[0], where)
    if found is None:
        return None
    header = read_header(found)
    return header.width, header.height


def _focals(values: dict[str, Any], width: int, height: int, where: str) -> tuple[float, float]:
    focals = []
    for axis, side in (("x", width), ("y", height)):
        length, angle = f"fl_{axis}", f"camera_angle_{axis}"
        if length in values:
            focals.append(_number(values, length, where))
        elif angle in values:
            view = _number(values, angle, where)
            if not 0 < view < np.pi:
                raise FileFormatError(f"{where}: {angle!r} must lie between 0 and pi radians, got {view:g}")
            focals.append(side / 2 / np.tan(view / 2))
    if not focals:
        raise FileFormatError(f"{where}: needs a focal length 'fl_x' or a viewing angle 'camera_angle_x'")
    if min(focals) <= 0:
        raise FileFormatError(f"{where}: focal lengths must be positive, got {min(focals):g}")
    # One of them serves both axes: pixels are square unless two are given.
    return focals[0], focals[-1]


def _world_to_camera(frame: dict[str, Any], where: str) -> np.ndarray:
    key = "transform_matrix"
    matrix = None
    try:
        given = np.array(frame.get(key), dtype=object)
        if given.shape in ((4, 4), (3, 4)) and all(type(v) in (int, float) for v in given.ravel()):
            matrix = given.astype(np.float64)
    except (ValueError, OverflowError):
        pass
    if matrix is None or not np.isfinite(matrix).all() or np.abs(matrix[:, :4]).max() > 1e9:
        raise FileFormatError(
            f"{where}: {key!r} must be a 4 x 4 matrix of finite numbers, from camera to world"
        )
    if len(matrix) == 4 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise FileFormatError(f"{where}: the last row of {key!r} must be 0 0 0 1")
    result = from_opengl(matrix)
    if result is None:
        raise FileFormatError(
            f"{where}: {key!r} is no rotation and translation (it scales, shears or mirrors)"
        )
    return result


def _number(values: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    value: Any = values.get(key, default)
    if isinstance(value, str):  # as some writers have their numbers
        with suppress(ValueError):
            value = float(value)
    if type(value) not in (int, float) or not -1e12 < value < 1e12:  # false for NaN too
        raise FileFormatError(f"{where}: {key!r} must be a finite number, got {str(value)[:40]!r}")
    return float(value)
