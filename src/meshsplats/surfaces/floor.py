"""The ground of a place, closed where views saw none, so that it can be walked on.

Open surfaces lack the ground where furniture hid it, below the photographer, and between views. Seen from
above, the place is a grid of cells; where a cell has no ground, it gets that of a membrane between the known
ground around it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from meshsplats._common.geometry import level_axes
from meshsplats.scene.camera import Camera

CELL = 2.0
"""Side of a cell in voxels."""
STEEPEST = 0.5
"""Least cosine between up and the normal of a triangle that carries a walker: slopes of 60 degrees."""
REACH = 1.0
"""How far the ground is closed beyond the convex hull of what lies below the cameras, in heights of the
eye."""
STEP = 0.35
"""How far ground may lie above or below that around the nearest camera, in heights of the eye: what is higher
is furniture, what is lower noise."""
AROUND = 300
"""Cells around a camera by which the height of its ground is known..."""
LOW = 0.25
"""...and the quantile of their heights, as what stands on the ground is above it."""
TUCKED = 0.5
"""How far the rim of new ground lies below the ground around it, in voxels."""


class _Plan(NamedTuple):
    """The place from above: cells, (rows, columns), along two level axes."""

    axes: np.ndarray
    """(3, 3) rows: the two level axes, up."""
    low: np.ndarray
    """(2,) the lowest corner."""
    cell: float
    shape: tuple[int, int]

    def centers(self) -> np.ndarray:
        """(rows * columns, 2)."""
        rows, columns = np.indices(self.shape).reshape(2, -1)
        return self.low + self.cell * (np.stack([rows, columns], axis=1) + 0.5)


def missing_ground(
    vertices: np.ndarray,
    faces: np.ndarray,
    cameras: Sequence[Camera],
    up: np.ndarray,
    voxel: float,
    margin: float = np.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """What a place lacks of the ground below and between ``cameras``.

    Args:
        vertices, faces: (n, 3) and (m, 3), an open surface, whose triangles face what is empty.
        cameras: at the height of the eye.
        up: (3,) unit direction.
        voxel: distance of the points of the grid that the surface is from; new ground has cells of twice it.
        margin: how far around the cameras ground counts, scene units: more than eyes are high. A background
            that reaches far beyond would have as many cells as nothing can hold.

    Returns:
        Vertices (k, 3) float64 and triangles (l, 3) int32, whose rim lies below the ground around it. None
        where there is all of the ground, or nothing to tell where it is.
    """
    from scipy.spatial import cKDTree

    nothing = np.empty((0, 3)), np.empty((0, 3), np.int32)
    eyes = np.array([camera.center for camera in cameras], np.float64)
    plan = _plan_of(vertices, eyes, up, CELL * voxel, margin)
    centers, feet, eye = plan.centers(), eyes @ plan.axes[:2].T, eyes @ up
    nearest = cKDTree(feet).query(centers)[1]
    top = _top_below(vertices, faces, plan, eye[nearest].reshape(plan.shape)).ravel()
    known = np.flatnonzero(np.isfinite(top))
    if not len(known):
        return nothing
    near = cKDTree(centers[known]).query(feet, k=min(AROUND, len(known)))[1].reshape(len(feet), -1)
    below = np.quantile(top[known][near], LOW, axis=1)
    height = float(np.median(eye - below))
    area = _within(centers, feet, REACH * height)
    level = below[nearest]
    ground = np.isfinite(top) & (np.abs(top - level) <= STEP * height)
    missing = area & ~(top >= level - STEP * height)
    if not missing.any() or not ground.any():
        return nothing
    heights = _membrane(np.where(ground, top, np.nan).reshape(plan.shape))
    return _sheet(missing.reshape(plan.shape), heights, plan, TUCKED * voxel)


def _plan_of(vertices: np.ndarray, eyes: np.ndarray, up: np.ndarray, cell: float, margin: float) -> _Plan:
    """The plan around what lies below the cameras and, within the ``margin`` around that, the surface."""
    axes = np.stack([*level_axes(up), up])
    level, feet = np.concatenate([vertices, eyes]) @ axes[:2].T, eyes @ axes[:2].T
    low = np.maximum(level.min(axis=0), feet.min(axis=0) - margin) - cell
    high = np.minimum(level.max(axis=0), feet.max(axis=0) + margin) + cell
    rows, columns = np.ceil((high - low) / cell).astype(int)
    return _Plan(axes, low, cell, (int(rows), int(columns)))


def _top_below(vertices: np.ndarray, faces: np.ndarray, plan: _Plan, eye: np.ndarray) -> np.ndarray:
    """(rows, columns) height of the highest triangle that faces up and lies below ``eye`` (rows, columns) at
    the middle of each cell; minus infinity where there is none."""
    top = np.full(plan.shape, -np.inf)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    upward = faces[normals @ plan.axes[2] > STEEPEST * np.linalg.norm(normals, axis=1)]
    places = (vertices[upward] @ plan.axes.T).astype(np.float64)
    places[..., :2] = (places[..., :2] - plan.low) / plan.cell - 0.5  # middles of cells are whole numbers
    firsts = np.maximum(np.ceil(places[..., :2].min(axis=1)), 0).astype(int)
    lasts = np.minimum(np.floor(places[..., :2].max(axis=1)), np.array(plan.shape) - 1).astype(int)
    for (a, b, c), first, last in zip(places, firsts, lasts, strict=True):
        if (first > last).any():
            continue
        x, y = np.ogrid[first[0] : last[0] + 1, first[1] : last[1] + 1]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        v = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        w = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        height = a[2] + v * (b[2] - a[2]) + w * (c[2] - a[2])
        part = np.s_[first[0] : last[0] + 1, first[1] : last[1] + 1]
        good = (v >= 0) & (w >= 0) & (v + w <= 1) & (height < eye[part])
        top[part] = np.where(good, np.maximum(top[part], height), top[part])
    return top


def _within(points: np.ndarray, feet: np.ndarray, reach: float) -> np.ndarray:
    """(n,) bool: which ``points`` (n, 2) are within ``reach`` of the convex hull of ``feet`` (k, 2)."""
    from scipy.spatial import ConvexHull

    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = reach * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    hull = ConvexHull((feet[:, None] + circle).reshape(-1, 2))
    inside = points @ hull.equations[:, :2].T + hull.equations[:, 2] <= 0
    return np.asarray(inside.all(axis=1))


def _membrane(heights: np.ndarray) -> np.ndarray:
    """``heights`` (rows, columns) with those that are NaN filled: each the mean of its neighbours."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    number = np.arange(heights.size).reshape(heights.shape)
    pairs = np.concatenate(
        [
            np.stack([number[:-1].ravel(), number[1:].ravel()]),
            np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()]),
        ],
        axis=1,
    )
    links = sparse.coo_matrix((np.ones(pairs.shape[1]), pairs), (heights.size, heights.size)).tocsr()
    links = links + links.T
    open_, values = np.isnan(heights).ravel(), heights.ravel().copy()
    laplacian = sparse.diags(np.asarray(links.sum(axis=1)).ravel()) - links
    known = np.flatnonzero(~open_)
    right = -laplacian[open_][:, known] @ values[known]
    values[open_] = spsolve(laplacian[open_][:, open_].tocsc(), right)
    return values.reshape(heights.shape)


def _sheet(
    missing: np.ndarray, heights: np.ndarray, plan: _Plan, tucked: float
) -> tuple[np.ndarray, np.ndarray]:
    """Ground (n, 3), (m, 3) for the ``missing`` cells and those around them, at ``heights``, both (rows,
    columns); corners that touch no missing cell lie lower by ``tucked``."""
    rows, columns = plan.shape
    touched = np.zeros((rows + 1, columns + 1), bool)
    sums, counts = np.zeros(touched.shape), np.zeros(touched.shape)
    for i, j in np.ndindex(2, 2):
        part = np.s_[i : rows + i, j : columns + j]
        touched[part] |= missing
        sums[part] += heights
        counts[part] += 1
    corner = sums / counts - np.where(touched, 0, tucked)
    wide = touched[:-1, :-1] | touched[1:, :-1] | touched[:-1, 1:] | touched[1:, 1:]
    i, j = np.nonzero(wide)
    number = np.arange(corner.size).reshape(corner.shape)
    a, b, c, d = number[i, j], number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    used, index = np.unique(triangles, return_inverse=True)
    x, y = np.unravel_index(used, corner.shape)
    level = plan.low + plan.cell * np.stack([x, y], axis=1)
    points = np.column_stack([level, corner[x, y]]) @ plan.axes
    return points, index.reshape(-1, 3).astype(np.int32)
