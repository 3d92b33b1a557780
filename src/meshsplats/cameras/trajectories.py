"""Cameras on orbits and domes around a subject, or turning inside a room."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from meshsplats._common.arrays import checked_array
from meshsplats._common.geometry import direction
from meshsplats._common.kinds import as_whole, need_array, need_numbers
from meshsplats.cameras.framing import (
    DEFAULT_UP,
    Framable,
    fit_images,
    front_axes,
    guess_up,
    middle,
    need_scene,
    scene_bounds,
    unit_up,
)
from meshsplats.scene.camera import Camera, checked_side

NEAR_SHARE = 0.01
"""Near plane of these cameras as a share of their distance from the subject's middle, which ``distance_of``
has from it again."""


def look_at(
    center: Sequence[float] | np.ndarray,
    target: Sequence[float] | np.ndarray,
    *,
    up: Sequence[float] | np.ndarray = DEFAULT_UP,
    width: int = 800,
    height: int = 800,
    fov: float = 45.0,
    near: float | None = None,
    name: str = "",
) -> Camera:
    """A camera that looks at a point.

    Straight along ``up``, the front of the scene is at the lower edge of the image.

    Args:
        center: (3,) position of the camera, world frame.
        target: (3,) point in the centre of the image.
        up: (3,) direction towards the image's upper edge.
        width, height: of the image, pixels.
        fov: angle in degrees, 1 to 170, that the shorter side of the image spans.
        near: depth of the near plane, scene units; None: it follows the scene.
        name: of the camera.

    Raises ValueError if the two points coincide or are not finite, and for a value out of range.
    """
    text = {"path": "three numbers say where it is, (0, 0, 1) for one"}
    need_array(center=center, target=target, up=up, wanted="a point (3,)", instead=text)
    width, height = _checked_lens(width, height, fov)
    center = checked_array("center", center, np.float64, (3,))
    upward = unit_up(up)
    forward = checked_array("target", target, np.float64, (3,)) - center
    length = np.linalg.norm(forward)
    if length == 0:
        raise ValueError("center and target must differ")
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
    scene: Framable,
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
    """``count`` cameras evenly spaced on a circle around the subject of ``scene``, looking at its middle.

    Args:
        scene: splats, a mesh or points (n, 3); ``framing.scene_bounds`` decides what counts as the subject.
        count: number of cameras, at least 1.
        elevation: degrees above the subject's horizon, -90 to 90.
        azimuth: degrees of the first camera, 0 in front (``framing.front_axes``), 90 at the right-hand side.
        up: (3,) direction; None: ``framing.guess_up``.
        width, height: of the images, pixels.
        fov: angle in degrees, 1 to 170, that the shorter side of the image spans.
        distance: multiple of the distance at which the subject just fits into the image of every view.
        target: (3,) point to look at and to circle, at the same distance; None: the subject's middle.

    Raises ValueError for an empty scene or a value out of range.
    """
    need_scene(scene)
    need_numbers(elevation=elevation, azimuth=azimuth)
    count = _checked_count(count)
    angles = [(azimuth + 360 * i / count, elevation) for i in range(count)]
    return around_subject(scene, angles, up, width, height, fov, distance, target)


def dome(
    scene: Framable,
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
    """``count`` cameras evenly spread over a dome around the subject, the upper half of a sphere.

    They stand on a Fibonacci spiral: equal steps in height, the golden angle in azimuth, so that each camera
    has the same share of the surface.

    Args:
        whole: use the whole sphere.

    The other arguments, and errors, are those of ``orbit``.
    """
    need_scene(scene)
    count = _checked_count(count)
    golden = 180 * (3 - 5**0.5)
    lowest = -1.0 if whole else 0.0
    heights = 1 - (1 - lowest) * (np.arange(count) + 0.5) / count
    angles = [(i * golden % 360, float(np.degrees(np.arcsin(h)))) for i, h in enumerate(heights)]
    return around_subject(scene, angles, up, width, height, fov, distance, target)


def look_around(
    scene: Framable,
    count: int = 60,
    *,
    elevation: float = 0.0,
    azimuth: float = 0.0,
    up: Sequence[float] | np.ndarray | None = None,
    width: int = 800,
    height: int = 800,
    fov: float = 75.0,
) -> list[Camera]:
    """``count`` cameras in the middle of ``scene``, say a room, that make one full turn to the right.

    Args:
        elevation: degrees above the horizon in which they look.

    The other arguments, and errors, are those of ``orbit``.
    """
    need_scene(scene)
    need_numbers(elevation=elevation, azimuth=azimuth)
    count = _checked_count(count)
    width, height = _checked_lens(width, height, fov)
    bounds = scene_bounds(scene)
    axes = front_axes(guess_up(scene) if up is None else unit_up(up))
    lens: dict[str, Any] = {"width": width, "height": height, "fov": fov, "near": bounds.radius * NEAR_SHARE}
    cameras = []
    for i in range(count):
        # At azimuth 0 they look forward; angles grow to the right.
        gaze = direction(axes, 180 - azimuth - 360 * i / count, elevation)
        target = bounds.center + bounds.radius * gaze
        cameras.append(look_at(bounds.center, target, up=axes[1], name=f"view_{i:04d}", **lens))
    return cameras


def around_subject(
    scene: Framable,
    angles: Sequence[tuple[float, float]],
    up: Sequence[float] | np.ndarray | None,
    width: int,
    height: int,
    fov: float,
    distance: float,
    aim: Sequence[float] | np.ndarray | None = None,
) -> list[Camera]:
    """Cameras at ``angles``, (azimuth, elevation) in degrees, around the subject, all of which they show.

    The other arguments are those of ``orbit``; ``aim`` is its ``target``.
    """
    need_numbers(distance=distance)
    width, height = _checked_lens(width, height, fov)
    if not (np.isfinite(distance) and distance > 0):
        raise ValueError(f"distance must be positive, got {distance}")
    if not all(np.isfinite(a) and -90 <= e <= 90 for a, e in angles):
        raise ValueError("azimuth must be finite and elevation between -90 and 90 degrees")
    bounds = scene_bounds(scene)
    axes = front_axes(guess_up(scene) if up is None else unit_up(up))
    directions = [direction(axes, azimuth, elevation) for azimuth, elevation in angles]
    lens: dict[str, Any] = {"up": axes[1], "width": width, "height": height, "fov": fov}
    target = middle(bounds, axes)
    around = [look_at(target + d, target, **lens) for d in directions]
    rotations = [camera.world_to_camera[:3, :3] for camera in around]
    slopes = (width / 2 / around[0].fx, height / 2 / around[0].fy)
    target, fit = fit_images(bounds, target, rotations, slopes)
    if aim is not None:
        target = np.asarray(aim, np.float64)
        if target.shape != (3,) or not np.isfinite(target).all():
            raise ValueError(f"target must be three finite numbers, got {aim!r}")
    away = distance * fit
    return [
        look_at(target + away * d, target, near=away * NEAR_SHARE, name=f"view_{i:04d}", **lens)
        for i, d in enumerate(directions)
    ]


def distance_of(camera: Camera) -> float:
    """Distance, scene units, of a camera of ``orbit`` or ``dome`` from the middle of the subject."""
    assert camera.near is not None
    return camera.near / NEAR_SHARE


def _checked_count(count: int) -> int:
    if (whole := as_whole("count", count)) < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    return whole


def _checked_lens(width: int, height: int, fov: float) -> tuple[int, int]:
    """Sides of images, whose ``fov`` is checked, too."""
    need_numbers(fov=fov)
    if not 1 <= fov <= 170:
        raise ValueError(f"fov must lie between 1 and 170 degrees, got {fov}")
    return checked_side("width", width), checked_side("height", height)
