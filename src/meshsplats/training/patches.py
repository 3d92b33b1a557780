"""Small pieces of surfaces, from the points of matched photographs, of hulls and of spheres."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshsplats._common.geometry import quaternions_of
from meshsplats._core.stereo import SurfaceArrays, fuse_points
from meshsplats.scene.gaussians import SH_C0, GaussianCloud
from meshsplats.training.stereo import Depths

LARGEST = 8.0
"""Standard deviation of a patch, in pixels of its photographs, from which it is cut before all others."""
SPREAD = 1.3
"""Standard deviation of a patch as a multiple of that of its points. Flat ellipses side by side leave gaps;
wider ones blur each other."""
LEAST_SIZE = 0.45
"""Least standard deviation of a patch, in pixels."""
SLIMMEST = 1 / 6
"""Least ratio of a patch's two standard deviations."""
OPACITY, FILLED_OPACITY = 0.95, 0.6
"""Of patches whose points other views confirm, and of those between, which may hang in front of a sky."""
FEWEST_POINTS = 3
"""Points of a patch, at least."""
LEAST_DENSITY = 0.3
"""Points of a patch for each pixel that it covers, at least."""
THICKEST = 8.0
"""Greatest standard deviation of the points across a patch, in pixels."""
SEEN_PAST = 0.25
"""Views that see past a patch, as a share of those that see it, from which it is dropped..."""
MOSTLY = 0.5
"""... or one more, where this share of its points is confirmed."""
OF_SIDE = 0.6
"""Standard deviation of a square patch, as a share of its side."""


class Patches(NamedTuple):
    """Small pieces of surfaces."""

    points: np.ndarray
    """(n, 3) float64."""
    axes: np.ndarray
    """(n, 3, 3) float64 unit vectors: two in the patch, and its normal, of either sign."""
    deviations: np.ndarray
    """(n, 2) float64 standard deviations along the first two, scene units."""
    colors: np.ndarray
    """(n, 3) float32 display RGB."""
    opacities: np.ndarray
    """(n,) float64 opacity at the start."""

    @classmethod
    def squares(cls, points: np.ndarray, normals: np.ndarray, side: float, opacity: float) -> Patches:
        """Grey ones of equal ``side`` at ``points`` (n, 3)."""
        least = np.eye(3)[np.abs(normals).argmin(axis=1)]
        first = np.cross(normals, least)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        axes = np.stack([first, np.cross(normals, first), normals], axis=1)
        n = len(points)
        return cls(
            points,
            axes,
            np.full((n, 2), OF_SIDE * float(side)),
            np.full((n, 3), 0.5, np.float32),
            np.full(n, opacity),
        )

    def select(self, rows: np.ndarray) -> Patches:
        """Those of a mask or of indices."""
        return Patches(*(column[rows] for column in self))

    @classmethod
    def joined(cls, *parts: Patches) -> Patches:
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def fused(
    surface: SurfaceArrays, origin: np.ndarray, depths: Depths, count: int, threads: int | None = None
) -> Patches:
    """At most ``count`` patches for the points of ``surface``, which are relative to ``origin`` (3,): as
    small as the pixels where it has texture, large where it is plain. Patches that are not dense, or that
    views of ``depths`` see past, are left out."""
    found = fuse_points(surface, count, LARGEST, threads)
    first, second, across = found.deviations.T.astype(np.float64)
    area = np.maximum(12 * first * second, 1e-30)  # of a rectangle with these deviations
    points = found.points.astype(np.float64) + origin
    agree, past = depths.counts(points, threads)
    keep = (found.counts >= FEWEST_POINTS) & (found.counts * np.square(found.pixels) > LEAST_DENSITY * area)
    keep &= (first <= 1.3 * LARGEST * found.pixels) & (across < THICKEST * found.pixels)
    keep &= past <= SEEN_PAST * agree + (found.sure > MOSTLY)
    least = LEAST_SIZE * found.pixels.astype(np.float64)
    longer, shorter = np.maximum(SPREAD * first, least), np.maximum(SPREAD * second, least)
    patches = Patches(
        points,
        found.axes.astype(np.float64),
        np.stack([longer, np.maximum(shorter, SLIMMEST * longer)], axis=1),
        found.colors,
        FILLED_OPACITY + (OPACITY - FILLED_OPACITY) * found.sure.astype(np.float64),
    )
    return patches.select(keep)


def flat_splats(patches: Patches) -> GaussianCloud:
    """A flat splat on each of ``patches``."""
    return GaussianCloud(
        patches.points,
        quaternions_of(patches.axes.transpose(0, 2, 1)),
        np.column_stack([patches.deviations, np.zeros(len(patches.points))]),
        patches.opacities,
        (patches.colors[:, None] - 0.5) / SH_C0,
        kernel="2dgs",
    )
