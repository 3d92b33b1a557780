"""Views of a place from within, stored with its object in a Blender file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from meshsplats.blender.inside import frame, meshes
from meshsplats.cameras.framing import scene_bounds
from meshsplats.scene.camera import Camera

VIEWS = "MeshSplats view"
"""Name of an object's property: views of a place from within, the first one to open with, as ``remember``
stores them; none of what is seen from around."""
_NUMBERS = 18
"""Stored numbers of a view: its pose, the tangent of half its angle, its near plane."""
_SIDE = 400
"""Side in pixels of the images of ``within``."""
_CHANGE = 0.2
"""Share of its radius by which a place may have moved or grown since its views were stored."""


class View(NamedTuple):
    """A view of a place from within, in Blender's world."""

    pose: np.ndarray
    """(4, 4) camera to world; Blender's cameras look along -z."""
    half: float
    """Tangent of half the angle that is to be seen at least."""
    near: float
    """What is nearer is not to be seen."""
    away: float
    """Distance of the middle of the place."""

    def camera(self, width: int, height: int) -> Camera:
        """As a camera of images of this size."""
        return _camera(self.pose, self.half, self.near, width, height)


def remember(obj: Any, views: Sequence[Camera]) -> None:
    """Stores with ``obj`` ``views`` of it from within, relative to the object's origin; none of what is seen
    from around, in which they need not be looked for again."""
    numbers: list[float] = []
    for view in views:
        half = max(view.width / view.fx, view.height / view.fy) / 2
        numbers += [*frame.camera_pose(view, np.eye(3)).ravel().tolist(), half, view.near or 0.0]
    points = meshes.local_points(obj)
    if not len(points):  # too faint or small to be seen
        return
    bounds = scene_bounds(points)
    obj[VIEWS] = [*numbers, *bounds.center.tolist(), float(bounds.radius)]


def opening(objs: Sequence[Any]) -> View | None:
    """The first view that is stored with one of ``objs``, where that stands now; None of objects, which are
    seen from around."""
    for obj in objs:
        stored = _stored(obj)
        for numbers in () if stored is None else stored:
            pose = np.array(obj.matrix_world) @ numbers[:16].reshape(4, 4)
            scale = np.linalg.norm(pose[:3, :3], axis=0)
            if np.linalg.det(pose[:3, :3]):
                pose[:3, :3] = _upright(pose[:3, :3])
                away = float(np.linalg.norm(scene_bounds(meshes.world_points(obj)).center - pose[:3, 3]))
                near = min(numbers[17] * scale[2], away / 10) or away / 1000
                return View(pose, float(numbers[16]), near, away)
    return None


def within(obj: Any, origin: np.ndarray) -> list[Camera] | None:
    """The views that are stored with ``obj``, in a frame in which the object's origin lies at ``origin``
    (3,); none of what is seen from around. None where it is not known, or only the one to open with: then
    they are to be looked for."""
    stored = _stored(obj)
    if stored is None or len(stored) == 1:
        return None
    cameras = [_camera(n[:16].reshape(4, 4), n[16], n[17], _SIDE, _SIDE) for n in stored]
    return [camera.relative_to(-origin) for camera in cameras]


def _stored(obj: Any) -> np.ndarray | None:
    """(n, ``_NUMBERS``) views of ``obj``; None if nothing is stored, if the property is of someone else, or
    if the mesh was cropped, joined with others or scaled since."""
    try:
        numbers = np.array(obj.get(VIEWS, ()), np.float64).ravel()
    except (TypeError, ValueError):  # a file may hold anything by this name
        return None
    whole = len(numbers) // _NUMBERS * _NUMBERS
    views, bounds = numbers[:whole].reshape(-1, _NUMBERS), numbers[whole:]
    if not len(numbers) or not np.isfinite(numbers).all() or not (views[:, 16] > 0).all():
        return None
    if len(bounds) == 4:
        points = meshes.local_points(obj)
        now = scene_bounds(points) if len(points) else None
        moved = np.inf if now is None else np.linalg.norm(now.center - bounds[:3])
        if now is None or max(moved, abs(now.radius - bounds[3])) > _CHANGE * bounds[3]:
            return None
    return views if len(bounds) in (0, 4) else None


def _upright(axes: np.ndarray) -> np.ndarray:
    """(3, 3) the rotation of a camera that looks and stands as ``axes`` (3, 3) do, its columns, which its
    place may have mirrored or stretched."""
    backward = axes[:, 2] / np.linalg.norm(axes[:, 2])
    right = np.cross(axes[:, 1], backward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(backward, right), backward], axis=1)


def _camera(pose: np.ndarray, half: float, near: float, width: int, height: int) -> Camera:
    focal = min(width, height) / (2 * half)
    matrix = frame.world_to_camera(pose)
    return Camera(matrix, focal, focal, width / 2, height / 2, width, height, near=near or None)
