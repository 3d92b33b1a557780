"""Camera: a pinhole with OpenCV axes. Orbits and domes round a scene, and camera files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._arrays import checked_array, evenly
from meshsplats.errors import FileFormatError
from meshsplats.framing import (
    DEFAULT_UP,
    Scene,
    fit_pictures,
    front_axes,
    guess_up,
    middle,
    scene_bounds,
    unit_up,
)

MAX_SIDE = 1 << 15
"""Largest picture side in pixels."""
MAX_FILE_BYTES = 16 << 20
"""A larger file of cameras is refused."""
MAX_CAMERAS = 20_000
NEAR_SHARE = 0.01
"""Near plane of the cameras made here, as a share of their distance to the subject's middle."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes: +x right, +y down, +z forward.

    Concretely, a world point p is at ``X = world_to_camera[:3, :3] @ p + world_to_camera[:3, 3]`` in the
    camera's frame and on the picture at ``(fx * X[0] / X[2] + cx, fy * X[1] / X[2] + cy)`` pixels from the
    top left corner; the centre of pixel (row, col) is at (col + 0.5, row + 0.5).
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
        if (
            np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6
            or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4
        ):
            raise ValueError(
                "world_to_camera must be a rigid transform: orthonormal rotation, last row 0 0 0 1"
            )
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

    @property
    def up(self) -> np.ndarray:
        """(3,) float64 unit direction of the picture's upper edge in the world frame."""
        return -self.world_to_camera[1, :3]

    def scaled(self, factor: float) -> Camera:
        """The same view on a picture ``factor`` times as large, its sides rounded to whole pixels, at least
        1."""
        if not (np.isfinite(factor) and factor > 0):
            raise ValueError(f"factor must be positive, got {factor}")
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        x, y = width / self.width, height / self.height  # not quite the factor where a side was rounded
        return replace(
            self, width=width, height=height, fx=self.fx * x, cx=self.cx * x, fy=self.fy * y, cy=self.cy * y
        )

    def within(self, side: int) -> Camera:
        """The same view on a picture no side of which is longer than ``side`` pixels; never a larger one."""
        return self.scaled(min(1.0, side / max(self.width, self.height)))

    def sees(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool: points (n, 3) in front of the camera that project into the picture."""
        matrix = self.world_to_camera.astype(np.float32)
        x, y, z = (points @ matrix[:3, :3].T + matrix[:3, 3]).T
        front = z > self.near
        depth = np.where(front, z, 1)
        u, v = self.fx * x / depth + self.cx, self.fy * y / depth + self.cy
        return front & (u >= 0) & (u < self.width) & (v >= 0) & (v < self.height)


def a_few(cameras: Sequence[Camera], most: int, side: int) -> list[Camera]:
    """Every k-th of ``cameras``, at most ``most``, with pictures of at most ``side`` pixels: enough to learn
    what they see."""
    return [camera.within(side) for camera in evenly(cameras, most)]


def look_at(
    center: Sequence[float] | np.ndarray,
    target: Sequence[float] | np.ndarray,
    *,
    up: Sequence[float] | np.ndarray = DEFAULT_UP,
    width: int = 800,
    height: int = 800,
    fov: float = 45.0,
    near: float = 0.01,
    name: str = "",
) -> Camera:
    """Camera at ``center`` (3,) that looks at ``target`` (3,) with ``up`` (3,) towards the picture's upper
    edge.

    Parameters
    ----------
    fov: angle in degrees, 1 to 170, that the shorter side of the picture spans.
    near: as in Camera.

    Raises ValueError if the two points coincide. Looking straight along ``up``, the scene's front is at the
    lower edge.
    """
    if not 1 <= fov <= 170:
        raise ValueError(f"fov must lie between 1 and 170 degrees, got {fov}")
    center = np.asarray(center, np.float64)
    upward = unit_up(up)
    forward = np.asarray(target, np.float64) - center
    length = np.linalg.norm(forward)
    if not (np.isfinite(length) and length > 0):
        raise ValueError("center and target must be finite and differ")
    forward /= length
    right = np.cross(forward, upward)
    if np.linalg.norm(right) < 1e-6:
        right = front_axes(upward)[0]
        right = right - forward * (right @ forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ center
    focal = min(width, height) / 2 / np.tan(np.radians(fov) / 2)
    return Camera(matrix, focal, focal, width / 2, height / 2, width, height, near, name)


def orbit(
    scene: Scene,
    count: int = 60,
    *,
    elevation: float = 15.0,
    azimuth: float = 0.0,
    up: Sequence[float] | np.ndarray | None = None,
    width: int = 800,
    height: int = 800,
    fov: float = 45.0,
    distance: float = 1.0,
    target: Sequence[float] | np.ndarray | None = None,
) -> list[Camera]:
    """``count`` cameras evenly spaced on a circle round the subject of ``scene``, all looking at its middle.

    Parameters
    ----------
    scene: GaussianCloud, SplatMesh or points (n, 3); see ``framing.scene_bounds`` for what counts as the
        subject.
    elevation: degrees above the subject's horizon, -90 to 90.
    azimuth: degrees of the first camera, 0 in front (``framing.front_axes``), 90 at the right-hand side.
    up: (3,) direction; None: ``framing.guess_up``.
    fov: angle in degrees, 1 to 170, that the shorter side of the picture spans.
    distance: multiple of the distance at which the subject just fits the picture in every view.
    target: (3,) point to look at and to go round, from as far away; None: the subject's middle.

    Raises ValueError for an empty scene or a value out of range.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    angles = [(azimuth + 360 * i / count, elevation) for i in range(count)]
    return round_subject(scene, angles, up, width, height, fov, distance, target)


def dome(
    scene: Scene,
    count: int = 32,
    *,
    whole: bool = False,
    up: Sequence[float] | np.ndarray | None = None,
    width: int = 800,
    height: int = 800,
    fov: float = 45.0,
    distance: float = 1.0,
    target: Sequence[float] | np.ndarray | None = None,
) -> list[Camera]:
    """``count`` cameras spread evenly over the upper half of a sphere round the subject, or all of it.

    The points are those of a Fibonacci spiral: equal steps in height, the golden angle in azimuth, so that
    each camera has the same share of the surface. Parameters are those of ``orbit``.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    golden = 180 * (3 - 5**0.5)
    lowest = -1.0 if whole else 0.0
    heights = 1 - (1 - lowest) * (np.arange(count) + 0.5) / count
    angles = [(i * golden % 360, float(np.degrees(np.arcsin(h)))) for i, h in enumerate(heights)]
    return round_subject(scene, angles, up, width, height, fov, distance, target)


def look_around(
    scene: Scene,
    count: int = 60,
    *,
    elevation: float = 0.0,
    azimuth: float = 0.0,
    up: Sequence[float] | np.ndarray | None = None,
    width: int = 800,
    height: int = 800,
    fov: float = 75.0,
) -> list[Camera]:
    """``count`` cameras that stand in the middle of ``scene``, a room say, and turn once round to the right.

    ``elevation`` is the direction they look in, above the horizon; the other parameters are those of
    ``orbit``.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    bounds = scene_bounds(scene)
    axes = front_axes(guess_up(scene) if up is None else unit_up(up))
    lens: dict[str, Any] = {"width": width, "height": height, "fov": fov, "near": bounds.radius * NEAR_SHARE}
    cameras = []
    for i in range(count):
        # Azimuth 0 looks forward, and a turn to the right is a growing angle.
        direction = _direction(axes, 180 - azimuth - 360 * i / count, elevation)
        target = bounds.center + bounds.radius * direction
        cameras.append(look_at(bounds.center, target, up=axes[1], name=f"view_{i:04d}", **lens))
    return cameras


def _direction(axes: np.ndarray, azimuth: float, elevation: float) -> np.ndarray:
    """Unit vector from the subject to a camera; ``axes`` as from ``front_axes``."""
    a, e = np.radians(azimuth), np.radians(elevation)
    right, up, forward = axes
    return np.cos(e) * (np.sin(a) * right - np.cos(a) * forward) + np.sin(e) * up


def round_subject(
    scene: Scene,
    angles: Sequence[tuple[float, float]],
    up: Sequence[float] | np.ndarray | None,
    width: int,
    height: int,
    fov: float,
    distance: float,
    aim: Sequence[float] | np.ndarray | None = None,
) -> list[Camera]:
    """Cameras at (azimuth, elevation) degrees, at the distance from which every picture shows the subject."""
    if not (np.isfinite(distance) and distance > 0):
        raise ValueError(f"distance must be positive, got {distance}")
    if not all(np.isfinite(a) and -90 <= e <= 90 for a, e in angles):
        raise ValueError("azimuth must be finite and elevation between -90 and 90 degrees")
    bounds = scene_bounds(scene)
    axes = front_axes(guess_up(scene) if up is None else unit_up(up))
    directions = [_direction(axes, azimuth, elevation) for azimuth, elevation in angles]
    lens: dict[str, Any] = {"up": axes[1], "width": width, "height": height, "fov": fov}
    target = middle(bounds, axes)
    around = [look_at(target + direction, target, **lens) for direction in directions]
    rotations = [camera.world_to_camera[:3, :3] for camera in around]
    slopes = (width / 2 / around[0].fx, height / 2 / around[0].fy)
    target, fit = fit_pictures(bounds, target, rotations, slopes)
    if aim is not None:
        target = np.asarray(aim, np.float64)
        if target.shape != (3,) or not np.isfinite(target).all():
            raise ValueError(f"the target must be three finite numbers, got {aim!r}")
    away = distance * fit
    return [
        look_at(target + away * d, target, near=away * NEAR_SHARE, name=f"view_{i:04d}", **lens)
        for i, d in enumerate(directions)
    ]


def load_cameras(path: str | Path) -> list[Camera]:
    """Cameras of a JSON file, in file order.

    Two forms are read. Ours is a list of ``{name, width, height, fx, fy, cx, cy, world_to_camera}`` with a
    4x4 matrix and OpenCV axes; ``name``, ``near``, and cx and cy (then the picture's centre) may be missing.
    The other is the ``cameras.json`` that INRIA's 3DGS trainer writes: ``{img_name, width, height, position,
    rotation, fx, fy}`` with ``rotation`` (3x3) from camera to world and the principal point at the picture's
    centre. A folder stands for the ``cameras.json`` in it.

    Raises FileFormatError, which names the camera and the field, for a file that is broken or of another
    kind, and OSError if it cannot be opened.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "cameras.json"
    entries = read_json(path)
    if not isinstance(entries, list):
        other = isinstance(entries, dict) and "frames" in entries
        what = " with 'frames': of a data set, which load_dataset and --data read" if other else ""
        raise FileFormatError(
            f"{path}: a camera file is a JSON list of cameras, this is a JSON {_kind(entries)}{what}"
        )
    if not entries:
        raise FileFormatError(f"{path}: holds no camera")
    if len(entries) > MAX_CAMERAS:
        raise FileFormatError(
            f"{path}: {len(entries)} cameras, more than the {MAX_CAMERAS} that are accepted"
        )
    return [_camera_from_json(entry, f"{path}: camera {i}") for i, entry in enumerate(entries)]


def read_json(path: Path) -> Any:
    """The content of a file of cameras. FileFormatError if it is no JSON, or larger than any such file is."""
    with open(path, "rb") as file:
        text = file.read(MAX_FILE_BYTES + 1)
    if len(text) > MAX_FILE_BYTES:
        raise FileFormatError(f"{path}: larger than {MAX_FILE_BYTES >> 20} MiB, which no file of cameras is")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: not a JSON file ({str(error)[:120]})") from None


def save_cameras(cameras: Sequence[Camera], path: str | Path) -> None:
    """Writes the JSON list that ``load_cameras`` reads; a file of that name is replaced. No digit is lost."""
    from meshsplats.formats.atomic import write_text

    entries = [
        {key: getattr(camera, key) for key in ("name", "width", "height", "fx", "fy", "cx", "cy", "near")}
        | {"world_to_camera": camera.world_to_camera.tolist()}
        for camera in cameras
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
    defaults = {"cx": width / 2, "cy": height / 2, "near": 0.01}
    lens = {
        key: float(_numbers(entry, key, (), where)) if key in entry or key not in defaults else defaults[key]
        for key in ("fx", "fy", "cx", "cy", "near")
    }
    try:
        return Camera(matrix, width=width, height=height, name=name, **lens)  # type: ignore[arg-type]
    except ValueError as error:
        raise FileFormatError(f"{where}: {error}") from None


def _numbers(entry: dict, key: str, shape: tuple[int, ...], where: str) -> np.ndarray:
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
