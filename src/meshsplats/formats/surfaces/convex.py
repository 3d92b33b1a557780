"""A surface as convex parts, as game engines want colliders that are not triangles one by one."""

from __future__ import annotations

import heapq
import itertools

import numpy as np

from meshsplats.errors import MissingDependencyError

PARTS = 32
"""Largest number of parts."""
FEWEST = 8
"""Parts of fewer triangles are not halved."""
THICK = 0.002
"""Thickness of parts that are flat, relative to the diagonal of the surface's box."""

Hull = tuple[np.ndarray, np.ndarray]
"""Vertices (n, 3) float32 and triangles (m, 3) int32 that face outwards."""


def convex_parts(vertices: np.ndarray, faces: np.ndarray, count: int = PARTS) -> list[Hull]:
    """At most ``count`` convex hulls that together hold all triangles of a mesh, (n, 3) vertices and (m, 3)
    triangles.

    The part whose hull has the largest volume is halved, at the median of its triangles along the longest
    side of its box, until there are enough.

    Raises MissingDependencyError without scipy.
    """
    thick = THICK * float(np.linalg.norm(np.ptp(vertices[faces.ravel()], axis=0)))
    middles, numbers = vertices[faces].mean(axis=1), itertools.count()

    def entry(rows: np.ndarray) -> tuple[float, int, np.ndarray, Hull]:
        hull, volume = _hull(vertices[np.unique(faces[rows])], thick)
        return -volume if len(rows) >= FEWEST else 0.0, next(numbers), rows, hull

    parts = [entry(np.arange(len(faces)))]
    while len(parts) < count and parts[0][0] < 0:
        _, _, rows, _ = heapq.heappop(parts)
        axis = np.ptp(middles[rows], axis=0).argmax()
        sorted_rows = rows[np.argsort(middles[rows, axis], kind="stable")]
        for half in np.array_split(sorted_rows, 2):
            heapq.heappush(parts, entry(half))
    return [hull for *_, hull in sorted(parts, key=lambda part: int(part[2][0]))]


def _hull(points: np.ndarray, thick: float) -> tuple[Hull, float]:
    """The convex hull of ``points`` (n, 3), which are made ``thick`` across the plane next to them, and its
    volume."""
    try:
        from scipy.spatial import ConvexHull
    except ImportError as error:
        raise MissingDependencyError("convex parts need the extra 'base': pip install scipy") from error
    points = points.astype(np.float64)
    middle = points.mean(axis=0)
    across = np.linalg.svd(points - middle, full_matrices=False)[2][-1] if len(points) > 2 else np.eye(3)[0]
    offset = thick / 2 * across
    hull = ConvexHull(np.concatenate([points - offset, points + offset]))
    triangles = hull.simplices
    a, b, c = hull.points[triangles].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
    triangles = np.where(inward[:, None], triangles[:, ::-1], triangles)
    used, index = np.unique(triangles, return_inverse=True)
    return (
        hull.points[used].astype(np.float32),
        index.reshape(-1, 3).astype(np.int32),
    ), float(hull.volume)
