"""Subdivision of a face into triangles, in barycentric coordinates and so independent of its shape."""

from __future__ import annotations

from math import isqrt

import numpy as np

MAX_PER_FACE = 256
"""Maximum number of triangles in one layer of a face."""


def face_pattern(count: int) -> np.ndarray:
    """(count, 3, 3) float32: barycentric corners of ``count`` triangles that cover a face exactly once.

    Concretely, ``face_pattern(n)[j, k]`` are the barycentric coordinates of corner k of triangle j. A square
    count n * n divides each edge into n equal parts, so that vertices of neighbouring faces with the same
    count coincide. Other counts start from the square below and bisect the largest triangles. All triangles
    have the winding of the face; a count of 1 is the face itself.

    Raises ValueError unless ``count`` lies in 1 to ``MAX_PER_FACE``.
    """
    if not 1 <= count <= MAX_PER_FACE:
        raise ValueError(f"a face carries 1 to {MAX_PER_FACE} triangles per layer, got {count}")
    n = isqrt(count)
    grid: list[list[tuple[int, int]]] = []
    for row in range(n):  # (i, j): i steps towards the second corner, j towards the third
        for i in range(n - row):
            grid.append([(i, row), (i + 1, row), (i, row + 1)])
            if i + row < n - 1:
                grid.append([(i + 1, row), (i + 1, row + 1), (i, row + 1)])
    steps = np.array(grid, np.float64)
    second, third = steps[..., 0], steps[..., 1]
    triangles = list(np.stack([n - second - third, second, third], axis=-1) / n)
    for _ in range(count - n * n):
        largest = int(np.argmax([abs(np.linalg.det(t)) for t in triangles]))
        a, b, c = triangles.pop(largest)
        # Bisect the longest edge, as measured in an equilateral face.
        lengths = [float(np.square(edge).sum()) for edge in (b - c, c - a, a - b)]
        for _ in range(int(np.argmax(np.round(lengths, 9)))):
            a, b, c = b, c, a
        middle = (b + c) / 2
        triangles += [np.stack([a, b, middle]), np.stack([a, middle, c])]
    return np.stack(triangles).astype(np.float32)


def counts_by_area(areas: np.ndarray, mean: float) -> np.ndarray:
    """(m,) int64 triangles per layer for faces of ``areas`` (m,).

    Counts are square numbers from 1 to ``MAX_PER_FACE``, roughly proportional to area, with an average as
    close to ``mean`` as these squares allow.
    """
    share = areas / areas.mean() if len(areas) and areas.mean() > 0 else np.ones(len(areas))
    low, high = 1e-6, 1e6
    counts = np.ones(len(areas))
    # Bisect the logarithm of the factor whose rounded counts have the requested mean.
    for _ in range(60):
        factor = (low * high) ** 0.5
        counts = np.clip(np.rint(np.sqrt(share * mean * factor)), 1, isqrt(MAX_PER_FACE)) ** 2
        if counts.mean() < mean:
            low = factor
        else:
            high = factor
    return counts.astype(np.int64)
