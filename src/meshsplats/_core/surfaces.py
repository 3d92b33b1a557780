"""Surfaces in the compiled core: their distances on a grid from depth images, and images of their textures.

Callers have checked their arrays: C-contiguous, of the types and shapes named here. All results have the same
bits with any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from meshsplats._core.library import pointer, run, thread_count
from meshsplats._core.structures import CameraStruct, FusingStruct, TextureStruct


class Grid(NamedTuple):
    """A grid of points around a scene, in its frame and units."""

    low: np.ndarray
    """(3,) float64 the lowest corner."""
    voxel: float
    """Distance of neighbouring points."""
    shape: tuple[int, ...]
    """Number of points along each axis."""
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the ball within which the points are evenly spaced..."""
    radius: float = 0.0
    """...and its radius r; 0: they are everywhere. Beyond it, points at the distance d from the centre lie
    r * (2 - r / d) from it on the grid (Barron and others 2022), so that those from which one looks at far
    things are the closest."""

    def contracted(self, points: np.ndarray) -> np.ndarray:
        """Where (n, 3) points of the scene lie, on a scale on which the grid is even."""
        return self._scaled(points, lambda ratio: (2 - 1 / ratio) / ratio)

    def in_scene(self, points: np.ndarray) -> np.ndarray:
        """The points of the scene whose ``contracted`` are ``points`` (n, 3)."""
        return self._scaled(points, lambda ratio: 1 / (np.maximum(2 - ratio, 1e-3) * ratio))

    def _scaled(self, points: np.ndarray, factor: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        if not self.radius:
            return points
        beside = points - self.center
        ratio = np.linalg.norm(beside, axis=1, keepdims=True) / self.radius
        return np.where(ratio > 1, self.center + factor(np.maximum(ratio, 1)) * beside, points)


def fuse_depth(
    total: np.ndarray,
    weight: np.ndarray,
    depth: np.ndarray,
    camera: CameraStruct,
    grid: Grid,
    *,
    truncation: float,
    behind: float,
    threads: int | None = None,
) -> None:
    """Adds the distances to the surface of a depth image to those of a grid.

    Args:
        total, weight: (x, y, z) float32, added to: sums of truncated distances along the rays, positive in
            front of the surface, in units of the truncation, and their weights.
        depth: (h, w) float32 camera depth, infinite in empty pixels.
        truncation: of the distances, scene units, and more where the grid is contracted; points that lie
            farther behind are left out.
        behind: weight of distances behind the surface, 1 of those before it.
    """
    run(
        "ms_fuse_depth",
        FusingStruct(
            camera=camera,
            size=grid.shape,
            low=tuple(grid.low),
            voxel=grid.voxel,
            center=grid.center,
            radius=grid.radius,
            truncation=truncation,
            behind=behind,
            depth=pointer(depth),
            sum=pointer(total),
            weight=pointer(weight),
            threads=thread_count(threads),
        ),
    )


class Samples(NamedTuple):
    """What the samples of an image show of a textured surface."""

    uv: np.ndarray
    """(rows, columns, 2) float32 texture coordinates: u to the right, v down, 0 to 1 within the texture."""
    covered: np.ndarray
    """(rows, columns) bool: which samples show the surface."""
    per_pixel: int
    """Samples along each side of a pixel."""


def texture_samples(
    samples: Samples, texels: np.ndarray, empty: np.ndarray, *, threads: int | None = None
) -> np.ndarray:
    """(rows, columns, 3) float32 colours of the samples: of the texture (th, tw, 3) float32, bilinear between
    the centres of texels and repeated beyond its border, and ``empty`` (3,) where nothing is covered."""
    color = np.empty((*samples.covered.shape, 3), np.float32)
    # A row of them: NumPy spreads three values over an image pixel by pixel.
    color[:] = np.tile(empty, (color.shape[1], 1)) if empty.ndim == 1 else empty
    struct = _struct(samples, texels, threads)
    struct.color = pointer(color)
    run("ms_texture", struct)
    return color


def coordinate_gradients(
    samples: Samples, texels: np.ndarray, gradient: np.ndarray, *, threads: int | None = None
) -> np.ndarray:
    """(rows, columns, 2) float32 gradient of a loss with respect to the texture coordinates of the samples.
    ``gradient`` (h, w, 4) float32 is, for each pixel, that with respect to the colour of each of its samples;
    the fourth value has no effect."""
    result = np.zeros_like(samples.uv)
    struct = _struct(samples, texels, threads)
    struct.gradient, struct.uv_gradient = pointer(gradient), pointer(result)
    run("ms_texture_backward", struct)
    return result


def texel_sums(
    samples: Samples, texels: np.ndarray, values: np.ndarray, *, threads: int | None = None
) -> np.ndarray:
    """(th, tw, 4) float32: for each texel the sum of ``values`` (h, w, 4) float32, which all samples of a
    pixel have, with the weights by which the texel is interpolated at the samples."""
    result = np.zeros((*texels.shape[:2], 4), np.float32)
    struct = _struct(samples, texels, threads)
    struct.gradient, struct.texel_sums = pointer(values), pointer(result)
    run("ms_texture_backward", struct)
    return result


def relax_texels(
    samples: Samples,
    texels: np.ndarray,
    values: np.ndarray,
    sums: np.ndarray,
    *,
    share: float,
    doubt: float,
    threads: int | None = None,
) -> None:
    """Moves each of the texels (th, tw, 3) float32 down the mean of ``values``, in place.

    With the sums s and w of ``texel_sums`` of ``values`` (h, w, 4), a texel t becomes
    t - share * s / (w + doubt), within 0 and 1. ``sums`` (th, tw, 4) float32 is memory, overwritten.
    """
    struct = _struct(samples, texels, threads)
    struct.gradient, struct.texel_sums, struct.relaxed = pointer(values), pointer(sums), pointer(texels)
    struct.share, struct.doubt = share, doubt
    run("ms_texture_backward", struct)


def _struct(samples: Samples, texels: np.ndarray, threads: int | None) -> TextureStruct:
    rows, columns = samples.covered.shape
    return TextureStruct(
        rows=rows,
        columns=columns,
        samples=samples.per_pixel,
        threads=thread_count(threads),
        height=texels.shape[0],
        width=texels.shape[1],
        uv=pointer(samples.uv),
        covered=pointer(samples.covered),
        texels=pointer(texels),
    )
