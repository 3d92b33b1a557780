"""Which splats are kept: crop box, opacity, importance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats.scene.gaussians import GaussianCloud

THOMSEN = 1.6075
"""Exponent of Thomsen's formula for the surface of an ellipsoid, within 1.1 % of the true value."""


def disc_areas(sigma: np.ndarray) -> np.ndarray:
    """(n, 3) products of pairs of standard deviations ``sigma`` (n, 3): planes 1-2, 1-3 and 2-3."""
    return np.stack([sigma[:, 0] * sigma[:, 1], sigma[:, 0] * sigma[:, 2], sigma[:, 1] * sigma[:, 2]], axis=1)


def mean_shadow(areas: np.ndarray) -> np.ndarray:
    """(n,) product of the two standard deviations of a Gaussian's projection, averaged over all directions.

    Along the unit vector v of the splat's frame the product is ``sqrt((v3 a12)^2 + (v2 a13)^2 + (v1
    a23)^2)``, the shadow of an ellipsoid. The mean shadow of a convex body is a quarter of its surface
    (Cauchy), for which Thomsen's approximation is used.

    Args:
        areas: (n, 3) as from ``disc_areas``.
    """
    a, b, c = areas.T
    largest = np.maximum(np.maximum(a, b), c)
    unit = np.power(areas.T / np.where(largest > 0, largest, 1), THOMSEN)
    return largest * np.power((unit[0] + unit[1] + unit[2]) / 3, 1 / THOMSEN)


def choose_splats(
    cloud: GaussianCloud,
    *,
    crop: tuple[float, ...] | None = None,
    min_opacity: float | None = None,
    max_splats: int | None = None,
) -> GaussianCloud:
    """The splats within the limits, in their old order.

    Args:
        crop: box x0 y0 z0 x1 y1 z1 in the world that the centres must lie in.
        min_opacity: least opacity, 0 to 1.
        max_splats: keep this many, those with the greatest opacity times mean projected area.

    Raises ValueError if no splat is left.
    """
    rows = np.flatnonzero(within(cloud, crop, min_opacity))
    if crop is not None and not len(rows):
        refuse_empty_box(cloud, crop)
    if max_splats is not None and max_splats < len(rows):
        importance = cloud.opacities[rows] * mean_shadow(disc_areas(cloud.scales[rows]))
        rows = rows[most_important(importance, max_splats)]
    if not len(rows):
        raise ValueError(f"none of the {len(cloud)} splats is left: all are fainter than {min_opacity:.4g}")
    return cloud.take(rows)


def within(cloud: GaussianCloud, crop: Sequence[float] | None, min_opacity: float | None) -> np.ndarray:
    """(n,) bool: splats whose centre lies ``inside`` the box ``crop`` and whose opacity is at least
    ``min_opacity``. None: no such limit."""
    keep = np.ones(len(cloud), bool)
    if crop is not None:
        keep &= inside(cloud.means, crop, cloud.origin)
    if min_opacity:
        keep &= cloud.opacities >= min_opacity
    return keep


def inside(points: np.ndarray, box: Sequence[float], origin: np.ndarray) -> np.ndarray:
    """(n,) bool: ``points`` (n, 3), relative to ``origin``, inside the ``box`` x0 y0 z0 x1 y1 z1 of the
    world, borders included."""
    corners = np.asarray(box, np.float64) - np.tile(origin, 2)
    return np.all((points >= corners[:3]) & (points <= corners[3:]), axis=1)


def refuse_empty_box(cloud: GaussianCloud, crop: Sequence[float]) -> None:
    """Raises ValueError if no centre lies in the box ``crop``, x0 y0 z0 x1 y1 z1."""
    if inside(cloud.means, crop, cloud.origin).any():
        return
    low, high = cloud.means.min(axis=0) + cloud.origin, cloud.means.max(axis=0) + cloud.origin
    box = np.asarray(crop, np.float64)
    raise ValueError(
        f"the crop box {_point(box[:3])} to {_point(box[3:])} holds none of the {len(cloud)} splats:"
        f" their centres lie in {_point(low)} to {_point(high)}"
    )


def most_important(importance: np.ndarray, count: int) -> np.ndarray:
    """(n,) bool: the ``count`` splats of greatest ``importance`` (ties: lower index first)."""
    keep = np.ones(len(importance), bool)
    if count < len(importance):
        keep[np.argsort(-importance, kind="stable")[count:]] = False
    return keep


def _point(values: np.ndarray) -> str:
    digits = 4 if np.abs(values).max() < 1e4 else 9
    return "(" + ", ".join(f"{v:.{digits}g}" for v in values) + ")"
