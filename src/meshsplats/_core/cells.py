"""Neighbours by the cells of a grid, in the compiled core.

Callers have checked their arrays. All results have the same bits with any number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshsplats._core.library import pointer, run, thread_count
from meshsplats._core.structures import CellSumsStruct, NearestVerticesStruct


class VertexGrid(NamedTuple):
    """The vertices of a surface, one or none in each cell of a grid."""

    ids: np.ndarray
    """(x, y, z) int32 vertex of each cell, -1 where there is none."""
    low: np.ndarray
    """(3,) float64 the lowest corner."""
    side: float
    """Of the cells."""
    vertices: np.ndarray
    """(w, 3) float32"""
    normals: np.ndarray
    """(w, 3) float64"""


def nearest_vertices(
    places: np.ndarray,
    normals: np.ndarray,
    grid: VertexGrid,
    *,
    reach: int,
    facing_away: float,
    threads: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """(k,) int64 the vertices of ``grid`` that are nearest to ``places`` (k, 3), and (k,) bool where there is
    one up to ``reach`` cells away along each axis.

    Squared distances to vertices whose normals are more than a right angle from ``normals`` (k, 3) count
    ``facing_away`` times. Of vertices that are as near as each other, that of the lowest cell.
    """
    places, normals = np.ascontiguousarray(places, np.float64), np.ascontiguousarray(normals, np.float64)
    vertices = np.ascontiguousarray(grid.vertices, np.float32)
    vertex_normals = np.ascontiguousarray(grid.normals, np.float64)
    index, found = np.empty(len(places), np.int64), np.empty(len(places), bool)
    run(
        "ms_nearest_vertices",
        NearestVerticesStruct(
            places=pointer(places),
            normals=pointer(normals),
            ids=pointer(grid.ids),
            vertices=pointer(vertices),
            vertex_normals=pointer(vertex_normals),
            index=pointer(index),
            found=pointer(found),
            count=len(places),
            size=grid.ids.shape,
            low=tuple(grid.low),
            side=grid.side,
            facing_away=facing_away,
            reach=reach,
            threads=thread_count(threads),
        ),
    )
    return index, found


def sums_around(
    points: np.ndarray,
    cells: np.ndarray,
    beside: np.ndarray,
    middles: np.ndarray,
    values: np.ndarray,
    *,
    deviation: float,
    threads: int | None = None,
) -> np.ndarray:
    """(n, k) float64: for each of the ``points`` (n, 3) the sum of the ``values`` (m, k) of the cells around
    it, weighted by a Gaussian of the distance to their ``middles`` (m, 3), with this standard ``deviation``.

    ``cells`` (n,) int32 is the cell of each point, ``beside`` (m, j) int32 those around each cell, -1 for
    none. All others are float64.
    """
    total = np.empty((len(points), values.shape[1]))
    run(
        "ms_sum_cells",
        CellSumsStruct(
            points=pointer(points),
            cell=pointer(cells),
            beside=pointer(beside),
            middle=pointer(middles),
            values=pointer(values),
            total=pointer(total),
            count=len(points),
            around=beside.shape[1],
            channels=values.shape[1],
            falloff=1 / (2 * deviation**2),
            threads=thread_count(threads),
        ),
    )
    return total
