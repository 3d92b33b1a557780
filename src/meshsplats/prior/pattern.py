"""How a face is divided into triangles, in barycentric coordinates, so that it is the same for all shapes."""

from __future__ import annotations

from math import isqrt

import numpy as np

MOST = 256
"""Most triangles in a layer of one face."""


def face_pattern(count: int) -> np.ndarray:
    """(count, 3, 3) float32: weights of the corners of ``count`` triangles that cover a face once.

    Concretely, ``face_pattern(n)[j, k]`` are the barycentric coordinates of corner k of triangle j. A square
    number n * n has all edges cut into n equal parts, so neighbours with the same number share their
    vertices' places; from the square below, further triangles come by halving, largest first. All wind as
    the face does; 1 is the face itself.

    Raises ValueError unless ``count`` lies in 1 to ``MOST``.
    """
    if not 1 <= count <= MOST:
        raise ValueError(f"a face carries 1 to {MOST} triangles a layer, got {count}")
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
        # The longest edge of an equilateral face.
        lengths = [float(np.square(edge).sum()) for edge in (b - c, c - a, a - b)]
        for _turn in range(int(np.argmax(np.round(lengths, 9)))):
            a, b, c = b, c, a
        middle = (b + c) / 2
        triangles += [np.stack([a, b, middle]), np.stack([a, middle, c])]
    return np.stack(triangles).astype(np.float32)


def counts_by_area(areas: np.ndarray, mean: float) -> np.ndarray:
    """(m,) int64 triangles a layer for faces of ``areas`` (m,): square numbers, about in proportion to area,
    ``mean`` on average as near as the squares from 1 to ``MOST`` allow."""
    share = areas / areas.mean() if len(areas) and areas.mean() > 0 else np.ones(len(areas))
    low, high = 1e-6, 1e6
    counts = np.ones(len(areas))
    for _ in range(
        60
    ):  # for the factor whose rounded numbers have the mean asked for, by halving its logarithm
        factor = (low * high) ** 0.5
        counts = np.clip(np.rint(np.sqrt(share * mean * factor)), 1, isqrt(MOST)) ** 2
        if counts.mean() < mean:
            low = factor
        else:
            high = factor
    return counts.astype(np.int64)
