"""Cameras placed by the extent of a scene: around its subject, or in free places inside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats.cameras.framing import (
    SAMPLE,
    SURROUNDINGS,
    Bounds,
    front_axes,
    guess_up,
    middle,
    scene_bounds,
    unit_up,
    weighted_quantile,
)
from meshsplats.cameras.trajectories import NEAR_SHARE, look_at
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud

STEPS = (1.324717957244746**-1, 1.324717957244746**-2, 2**0.5 - 1)
"""Steps of Kronecker's sequence for azimuth, height and distance: its points modulo 1 fill the unit cube
evenly in every run of successive points. The first two are powers of the inverse of the plastic number, the
most even pair known: directions matter most."""
OBJECT_ELEVATIONS = (0.0, 60.0)
ALL_ELEVATIONS = (-60.0, 60.0)
SURROUNDED_ELEVATIONS = (3.0, 60.0)
"""Degrees above the horizon. Few captures show anything from below, and flat ground seen from the side is so
hard to match that such views make the others worse."""
INSIDE_ELEVATIONS = (-35.0, 35.0)
DISTANCES = (0.9, 1.1)
"""Multiples of the distance at which the subject just fits."""
LONG = 0.5
"""A subject is long if less than this share of the opacity that is out of reach of cameras around most of it
is out of reach around the middle of its extent."""
SURROUNDINGS_SHARE = 0.01
"""A subject has surroundings if more than this share of the opacity lies beyond it."""
MOST = 2_000_000
"""Splats, at most, that tell whether a subject has surroundings."""
STANDS = 12
"""Largest number of places for cameras inside a scene."""
CANDIDATES = 512
"""Number of points that are tried as such places."""
ROOMY = 0.4
"""Least clearance of a place as a share of the largest one."""


def has_surroundings(cloud: GaussianCloud) -> bool:
    """Whether more than ``SURROUNDINGS_SHARE`` of the opacity lies far outside the subject, as
    ``framing.scene_bounds`` has it."""
    step = -(-len(cloud) // MOST)
    center = scene_bounds(cloud).center
    distance = np.linalg.norm(cloud.means[::step] - center, axis=1)
    weights = cloud.opacities[::step].astype(np.float64)
    if weights.sum() == 0:
        return False
    far = distance > SURROUNDINGS * weighted_quantile(distance, weights, 0.5)
    return bool(weights[far].sum() > SURROUNDINGS_SHARE * weights.sum())


def outside_cameras(
    cloud: GaussianCloud,
    count: int,
    *,
    elevations: tuple[float, float] = OBJECT_ELEVATIONS,
    distance: tuple[float, float] = DISTANCES,
    up: Sequence[float] | np.ndarray | None = None,
    width: int = 400,
    height: int = 400,
    fov: float = 50.0,
) -> list[Camera]:
    """``count`` cameras that look at a subject (``target_of``), evenly over directions and distances.

    Directions are even on the sphere between two ``elevations`` (degrees), distances on a logarithmic scale.
    Every run of successive cameras is evenly spread, too. The other arguments are those of ``splat_dataset``.
    """
    axes = front_axes(guess_up(cloud) if up is None else unit_up(up))
    bounds = scene_bounds(cloud)  # refuses an empty cloud
    return cameras_around(
        bounds, target_of(bounds, axes), axes, count, elevations, distance, size=(width, height), fov=fov
    )


def cameras_around(
    bounds: Bounds,
    target: np.ndarray,
    axes: np.ndarray,
    count: int,
    elevations: tuple[float, float] = OBJECT_ELEVATIONS,
    distance: tuple[float, float] = DISTANCES,
    *,
    size: tuple[int, int],
    fov: float = 50.0,
) -> list[Camera]:
    """Those of ``outside_cameras`` for a subject of these ``bounds`` and up and front ``axes`` (3, 3), which
    look at ``target`` (3,), with images of ``size``, width and height."""
    # Surroundings may have most of the opacity; then only the subject has to fit.
    reach = float(np.linalg.norm(bounds.points - bounds.center, axis=1).max(initial=0))
    fit = (min(bounds.radius, reach) or bounds.radius) / np.sin(np.radians(fov / 2))
    turns, heights, share = _sequence(count)
    low, high = np.sin(np.radians(elevations))
    away = fit * distance[0] * (distance[1] / distance[0]) ** share
    return [
        look_at(
            target + away[i] * _towards(axes, 2 * np.pi * turns[i], low + (high - low) * heights[i]),
            target,
            up=axes[1],
            width=size[0],
            height=size[1],
            fov=fov,
            near=away[i] * NEAR_SHARE,
            name=f"view_{i:04d}",
        )
        for i in range(count)
    ]


def target_of(bounds: Bounds, axes: np.ndarray) -> np.ndarray:
    """(3,) where cameras around a subject with these up and front ``axes`` (3, 3) look: where most of the
    opacity is; or, of a long one, the middle of its extent. Around the body of a guitar, its head would often
    be out of the image."""
    half_way = middle(bounds, axes)
    beyond, of_half_way = (
        bounds.weights[np.linalg.norm(bounds.points - point, axis=1) > bounds.radius].sum()
        for point in (bounds.center, half_way)
    )
    return half_way if of_half_way < LONG * beyond else bounds.center


def _sequence(count: int) -> np.ndarray:
    """(3, count) numbers in [0, 1)."""
    return (0.5 + np.outer(STEPS, np.arange(count))) % 1


def _towards(axes: np.ndarray, turn: float, height: float) -> np.ndarray:
    """(3,) unit direction ``turn`` radians around the up axis; ``height``: the sine of its elevation."""
    right, upward, forward = axes
    level = np.sqrt(1 - height * height)
    return level * (np.sin(turn) * right + np.cos(turn) * forward) + height * upward


def inside_cameras(
    cloud: GaussianCloud,
    count: int,
    *,
    up: Sequence[float] | np.ndarray | None = None,
    width: int = 400,
    height: int = 400,
    fov: float = 75.0,
) -> list[Camera]:
    """``count`` cameras inside the scene that look outwards, in all directions near the horizon.

    They stand in up to ``STANDS`` places, far from each other, in the middle parts of the scene where the
    nearest splat is farthest away; the cameras in each place look in all directions.
    """
    axes = front_axes(guess_up(cloud) if up is None else unit_up(up))
    places, clearances = _free_places(cloud, axes, max(1, min(STANDS, count // 6)))
    low, high = np.sin(np.radians(INSIDE_ELEVATIONS))
    turns, heights, _ = _sequence(count)
    cameras = []
    for i in range(count):
        stand = i % len(places)
        direction = _towards(axes, 2 * np.pi * turns[i], low + (high - low) * heights[i])
        cameras.append(
            look_at(
                places[stand],
                places[stand] + clearances[stand] * direction,
                up=axes[1],
                width=width,
                height=height,
                fov=fov,
                near=clearances[stand] * 0.05,
                name=f"view_{i:04d}",
            )
        )
    return cameras


def _free_places(cloud: GaussianCloud, axes: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Up to ``count`` points (k, 3) between the splats, and (k,) how far the nearest splat is from each."""
    bounds = scene_bounds(cloud)  # refuses an empty cloud
    solid = np.flatnonzero(cloud.opacities > 0.1)
    rows = (solid if len(solid) else np.arange(len(cloud)))[:: -(-max(len(solid), 1) // SAMPLE)]
    points = cloud.means[rows].astype(np.float64)
    reach = 2 * np.median(cloud.scales[rows].astype(np.float64), axis=1)
    along = bounds.points @ axes.T
    low, high = (
        np.array([weighted_quantile(along[:, k], bounds.weights, q) for k in range(3)]) for q in (0.02, 0.98)
    )
    # The middle three quarters across and the middle half in height: people do not crawl.
    middle, half = (low + high) / 2, (high - low) / 2 * [0.75, 0.5, 0.75]
    # Kronecker's sequence of the plastic number's powers fills a cube evenly.
    steps = 1.2207440846057596 ** -np.arange(1, 4)
    inner = 2 * ((0.5 + np.arange(CANDIDATES)[:, None] * steps) % 1) - 1
    tried = (middle + half * inner) @ axes
    clearance = np.empty(CANDIDATES)
    square = (points**2).sum(axis=1)
    for start in range(0, CANDIDATES, 64):
        some = tried[start : start + 64]
        apart = np.maximum((some**2).sum(axis=1)[:, None] - 2 * some @ points.T + square, 0)
        clearance[start : start + 64] = (np.sqrt(apart) - reach).min(axis=1)
    best = clearance.max()
    if best <= 0:
        raise ValueError("no free place was found inside the scene; is it an object (placement 'object')?")
    roomy = np.flatnonzero(clearance >= ROOMY * best)
    chosen = [int(roomy[clearance[roomy].argmax()])]
    while len(chosen) < min(count, len(roomy)):
        away = np.linalg.norm(tried[roomy][:, None] - tried[chosen], axis=2).min(axis=1)
        chosen.append(int(roomy[away.argmax()]))
    return tried[chosen], clearance[chosen]
