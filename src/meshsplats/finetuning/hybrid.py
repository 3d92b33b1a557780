"""The blended part of a mesh for depth buffers (``soft_share``): fans of splats that have no opaque stand-in.

A viewer draws the opaque triangles first, with its depth buffer, and blends the others over them in the order
of the file. Where few fragments lie in front of the opaque ones, that order hardly matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.datasets.views import View
from meshsplats.finetuning.state import MAX_OPACITY
from meshsplats.rendering import render
from meshsplats.rendering.backward import TapeOptions
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.rendering.engine import scatter_to_vertices
from meshsplats.scene.mesh import SplatMesh, solid_faces

SOLID = 1 - 0.5 / 255
"""Least opacity of a fragment of opaque triangles, which blended ones do not reach."""
ERROR_VIEWS = 24
"""Maximum number of training views, evenly spread, in which splats are compared with opaque triangles."""
ERROR_SAMPLES = 2
"""Samples along each side of a pixel there."""
COLOR_SLOPE = 0.06
"""Greatest difference of a corner of an opaque triangle from the mean of its corners, per pixel of the
triangle's least height. Of 0.05 to 0.2 the best in three.js with MSAA."""
SLOPE_VIEWS = 12
"""Maximum number of training views, evenly spread, in which these heights are measured."""


def with_soft_splats(
    core: SplatMesh, start: SplatMesh, views: Sequence[View], share: float, threads: int | None = None
) -> SplatMesh:
    """``core``, opaque triangles, with fans of ``start``, the mesh that it was made from, in place of those
    that fail most.

    A splat is scored by the sum over the pixels of ``views`` of T a (1 - a) e, with the opacity a of its
    fragments and the transmittance T in front of them: the expected loss of drawing a fragment opaque with
    probability a has this factor. e is the squared error of ``core`` less that of ``start``. Of the splats
    with positive scores, those with the highest score per triangle take up to ``share`` times as many
    triangles as ``start`` has.

    Returns:
        A mesh whose opaque triangles have three corners of opacity 1, and its blended ones none.
    """
    assert core.face_splat is not None
    assert start.face_splat is not None
    scores = softness(core, start, views, threads)
    triangles = np.bincount(start.face_splat, minlength=len(scores))
    best = np.argsort(-scores / np.maximum(triangles, 1), kind="stable")
    best = best[scores[best] > 0]
    chosen = np.zeros(len(scores), bool)
    chosen[best[np.cumsum(triangles[best]) <= share * len(start.faces)]] = True
    soft = start.take(chosen[start.face_splat])
    colors = soft.colors.copy()
    colors[:, 3] = np.minimum(colors[:, 3], MAX_OPACITY)
    rest = core.take(~chosen[core.face_splat])
    # The plain colours of ``start`` are not those of the end of the run.
    return SplatMesh.joined([rest, replace(soft, colors=colors, plain_colors=None)], same_splats=True)


def softness(
    core: SplatMesh, start: SplatMesh, views: Sequence[View], threads: int | None = None
) -> np.ndarray:
    """The score of each splat, by its index; see ``with_soft_splats``."""
    assert start.face_splat is not None
    sums = np.zeros(len(start.vertices))
    triangles = start.triangles._replace(values=np.zeros((len(start.vertices), 1), np.float32))
    drawing = CpuEngine(threads)
    for view in subsample(views, ERROR_VIEWS):
        background, camera = view.background, view.camera
        opaque = render(core, camera, background=background, samples=ERROR_SAMPLES, threads=threads).color
        rendering = drawing.tape(triangles, camera, TapeOptions(background))
        error, blended = (
            np.square(color - view.image).sum(axis=2, keepdims=True) for color in (opaque, rendering.color)
        )
        error -= blended
        if view.mask is not None:
            error[~view.mask] = 0  # masked values may be anything
        sums += scatter_to_vertices(rendering, error)[:, 0]
    # A corner has the sum of e T a, weighted by its barycentric weight: by these, 1 - a is interpolated.
    sums *= 1 - start.colors[:, 3]
    splats = start.splats
    # Vertices of no triangle are not drawn: their sums are 0, wherever they are added.
    return np.bincount(splats.numbers[splats.of_vertex], sums, int(splats.numbers[-1]) + 1)


class ColorLimits:
    """Limits how fast the colours of opaque triangles change in the image.

    With MSAA, a GPU shades a pixel once, at its centre, also where a triangle covers only other samples of
    it. A triangle much smaller than a pixel then shows colours that are extrapolated far beyond its corners.

    Attributes:
        limits: (n,) greatest difference of a corner from the mean of its triangle, for its opaque triangles.
    """

    def __init__(self, mesh: SplatMesh, limits: np.ndarray) -> None:
        self.limits = limits
        self._corners = mesh.faces[solid_faces(mesh)]
        if limits.shape != (len(self._corners),):
            raise ValueError(f"{len(self._corners)} opaque triangles, but limits of shape {limits.shape}")

    @classmethod
    def measured(cls, mesh: SplatMesh, views: Sequence[View]) -> ColorLimits:
        """Limits for the opaque triangles of ``mesh``, at the size that they have in ``views``, the median of
        those that see them. Triangles that no view sees have none."""
        corners = mesh.vertices[mesh.faces[solid_faces(mesh)]]
        return cls(mesh, COLOR_SLOPE * _least_heights(corners, views))

    def apply(self, colors: np.ndarray) -> None:
        """Moves RGB of vertices, ``colors`` (v, 4), in place: the corners of each triangle beyond its limit
        towards their mean, down to the limit. A vertex of several takes the mean of its places."""
        rgb = colors[self._corners, :3]
        mean = rgb.mean(axis=1, keepdims=True)
        difference = rgb - mean
        largest = np.abs(difference).max(axis=(1, 2))
        beyond = np.flatnonzero(largest > self.limits)
        share = (self.limits[beyond] / largest[beyond])[:, None, None]
        moved = (mean[beyond] + share * difference[beyond]).reshape(-1, 3)
        vertices = self._corners[beyond].ravel()
        counts = np.bincount(vertices, minlength=len(colors))
        found = np.flatnonzero(counts)
        for channel in range(3):
            sums = np.bincount(vertices, moved[:, channel], len(colors))
            colors[found, channel] = sums[found] / counts[found]


def _least_heights(corners: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """(n,) least height of each of the triangles ``corners`` (n, 3, 3) in pixels, seen from in front: the
    median over the ``views`` whose image has its middle; infinite where none has."""
    corners = corners.astype(np.float64)
    sides = np.roll(corners, -1, axis=1) - corners
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    heights = areas / np.where(longest > 0, longest, 1)
    middles = corners.mean(axis=1)
    scales = []
    for view in subsample(views, SLOPE_VIEWS):
        camera = view.camera
        positions, depths = camera.project(middles)
        seen = camera.in_image(positions)
        scale = np.sqrt(camera.fx * camera.fy) / np.where(seen, depths, 1)
        scales.append(np.where(seen, scale, np.nan).astype(np.float32))
    ordered = np.sort(scales, axis=0)  # NaN last
    count = np.isfinite(ordered).sum(axis=0)
    middle = np.take_along_axis(ordered, (np.maximum(count, 1) // 2)[None], axis=0)[0]
    return np.where(count > 0, heights * np.where(count > 0, middle, 1), np.inf)
