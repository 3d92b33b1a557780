"""What kind of scene splats show: an object, a relief, a ring around one, a place, a landscape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from meshsplats.cameras.framing import front_axes, scene_bounds, unit_up, weighted_quantile
from meshsplats.cameras.placing import cameras_around
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.viewpoints.sample import COARSE, AllSplats, Sample
from meshsplats.viewpoints.search import Places

Kind = Literal["object", "relief", "ring", "place", "aerial"]

FEWEST = 1000
"""Scenes of fewer splats are objects: there is nothing to find."""
USUAL = 30_000
"""Splats of scenes that are coarser because they have fewer count as if there were so many..."""
MANY = 400_000
"""...and of scenes that are finer because they have more than these, as if there were so few: from afar, even
the noise around a capture of ten million looks fine."""
OUTSIDE_VIEWS = 10
OUTSIDE_SIDE = 48
OUTSIDE_SPLATS = 400_000
"""Number of splats, at most, that the dome is judged by."""
FINE = 0.908
"""Share of opaque pixels with fine splats, seen from the dome, from which on a scene is an object."""
SURELY_FINE, FEW_SPLATS = 0.95, 80_000
"""That share from which on a scene surely is one, by so many splats."""
FLAT = 0.2
"""Height of a landscape, as a share of its width..."""
LANDSCAPE = 50_000
"""...and its number of splats, at least."""
FLOWN_OVER = 1.5
"""Spread of places above a landscape, in depths of their views: less, and they surround a subject."""
MOST_DEPTHS = 400
"""Views, at most, whose depths tell what is usual."""
MOST_SURE = 0.45
"""How sure it is at most whether a scene is a ring or a place: they look much alike."""


def fineness_outside(cloud: GaussianCloud, up: np.ndarray, threads: int | None = None) -> float:
    """Share of fine splats in what the dome around the scene shows, 0 to 1."""
    return _fineness(subsample_of(cloud), _coarse(len(cloud)), _dome(cloud, up), threads)


def _coarse(count: int) -> float:
    """The angle of a coarse splat, radians, in a scene of ``count``."""
    return float(COARSE * (min(max(count, USUAL), MANY) / count) ** 0.5)


def _dome(cloud: GaussianCloud, up: np.ndarray) -> list[Camera]:
    """Cameras around where most of the opacity is, for which ``FINE`` was chosen."""
    bounds, axes = scene_bounds(cloud), front_axes(unit_up(up))
    return cameras_around(bounds, bounds.center, axes, OUTSIDE_VIEWS, size=(OUTSIDE_SIDE, OUTSIDE_SIDE))


def _fineness(cloud: GaussianCloud, coarse: float, cameras: Sequence[Camera], threads: int | None) -> float:
    """``fineness_outside`` of these splats, where an angle is ``coarse``."""
    splats, fine = AllSplats(cloud, threads), []
    for camera in cameras:
        log_angle, alpha, _ = splats.look(camera, OUTSIDE_SIDE)
        fine.append((alpha / (1 + (np.exp(log_angle) / coarse) ** 2)).sum() / max(alpha.sum(), 1e-3))
    return float(np.mean(fine))


def surely_object(cloud: GaussianCloud, up: np.ndarray, threads: int | None = None) -> bool:
    """Whether a glance at few splats says that a scene is an object."""
    if _is_landscape(cloud, up):
        return False
    return glance(cloud, up, threads) >= SURELY_FINE


def glance(cloud: GaussianCloud, up: np.ndarray, threads: int | None = None) -> float:
    """``fineness_outside`` of few of the splats, each wider as it stands for others."""
    few = subsample_of(cloud, FEW_SPLATS)
    wider = (len(cloud) / len(few)) ** 0.5
    few = replace(few, scales=few.scales * np.float32(wider))
    return _fineness(few, wider * _coarse(len(cloud)), _dome(cloud, up), threads)


def _is_landscape(cloud: GaussianCloud, up: np.ndarray) -> bool:
    return len(cloud) >= LANDSCAPE and flatness(subsample_of(cloud), up) < FLAT


def subsample_of(cloud: GaussianCloud, most: int = OUTSIDE_SPLATS) -> GaussianCloud:
    """The splats, or every so many of them, evenly spread, at most ``most``."""
    step = -(-len(cloud) // most)
    return cloud if step == 1 else cloud.take(np.arange(0, len(cloud), step))


def kind_from_outside(
    cloud: GaussianCloud, up: np.ndarray, threads: int | None = None
) -> tuple[Kind | None, float]:
    """'object' or 'aerial' if the scene is to be seen from outside, else None; and how sure, 0 to 1."""
    if len(cloud) < FEWEST:
        return "object", 1.0
    fine = fineness_outside(cloud, up, threads)
    if fine < FINE:
        return None, float(np.clip(0.3 + 2 * (FINE - fine), 0, 1))
    sure = float(np.clip(0.3 + (fine - FINE) / (1 - FINE), 0, 1))
    if _is_landscape(cloud, up):
        return "aerial", sure
    return "object", sure


def flatness(cloud: GaussianCloud, up: np.ndarray) -> float:
    """Height of a scene as a share of its narrower width, without its strays."""
    points, weights = cloud.means.astype(np.float64), cloud.opacities.astype(np.float64)
    level = points - np.outer(points @ up, up)
    level -= np.median(level, axis=0)
    _, axes = np.linalg.eigh((level[:, :, None] * level[:, None]).mean(axis=0))
    spans = [
        weighted_quantile(along, weights, 0.95) - weighted_quantile(along, weights, 0.05)
        for along in (points @ up, level @ axes[:, 1])
    ]
    return spans[0] / max(spans[1], 1e-12 * max(spans[0], 1e-12))


def kind_from_inside(sample: Sample, places: Places, up: np.ndarray) -> tuple[Kind, float]:
    """What good views from ``places`` have in common: all look one way (a ring around a subject), or not (a
    place); and how sure, 0 to 1."""
    best = places.best()
    good = np.maximum(best.worth - 0.5 * best.worth.max(axis=1, keepdims=True), 0)
    mean = (
        np.einsum("kd,dj->kj", good, sample.gaze, optimize=False)
        / np.maximum(good.sum(axis=1), 1e-9)[:, None]
    )
    one_way = float(np.linalg.norm(mean, axis=1).mean())
    closed = float((best.alpha[:, np.abs(sample.gaze @ up) < 0.5] > 0.9).mean())
    tilt = float((mean @ up).mean() / max(one_way, 1e-9))
    above = float((best.places @ up > np.quantile(sample.means @ up, 0.9)).mean())
    if tilt < -0.6 and above > 0.9 and _flown_over(sample, best):
        return "aerial", 0.5
    inward = (one_way - 0.5) / 0.15 - (closed - 0.6) / 0.3
    return ("ring" if inward > 0 else "place"), float(np.clip(0.2 + 0.1 * abs(inward), 0, MOST_SURE))


def usual_depth(sample: Sample, places: Places, good: np.ndarray) -> float:
    """Median of the depths of some of the ``good`` (k, DIRECTIONS) views from ``places``."""
    views = np.argwhere(good)
    views = views[:: -(-len(views) // MOST_DEPTHS)]
    return float(np.median([sample.depth_along(places.depth[i], sample.gaze[j]) for i, j in views]))


def _flown_over(sample: Sample, best: Places) -> bool:
    good = best.worth >= 0.9 * best.worth.max(axis=1, keepdims=True)
    return bool(np.linalg.norm(best.places.std(axis=0)) > FLOWN_OVER * usual_depth(sample, best, good))
