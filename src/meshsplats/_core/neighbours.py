"""Nearest neighbours among points, in the compiled core."""

from __future__ import annotations

import numpy as np

from meshsplats._core.library import pointer, processors, run
from meshsplats._core.structures import NearestStruct


def nearest(points: np.ndarray, count: int, threads: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The ``count`` nearest neighbours of each of ``points`` (n, 3) float64, n > count.

    Returns:
        (n,) int32 ``order`` of the points in which neighbours lie close to each other; and (n, count) int32:
        row i holds the positions, in that order, of the neighbours of point ``order[i]``, nearest first.
    """
    points = np.ascontiguousarray(points, np.float64)
    order = np.empty(len(points), np.int32)
    found = np.empty((len(points), count), np.int32)
    run(
        "ms_nearest",
        NearestStruct(
            count=len(points),
            neighbours=count,
            threads=threads or processors(),
            points=pointer(points),
            order=pointer(order),
            nearest=pointer(found),
        ),
    )
    return order, found
