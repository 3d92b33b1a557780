"""Neighbours by the cells of a grid, against all pairs in NumPy."""

import numpy as np
import pytest

from meshsplats._core.cells import VertexGrid, nearest_vertices, sums_around


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def vertex_grid(rng):
    """One vertex in each of some cells of a grid that is not a cube."""
    shape, low, side = (6, 9, 7), np.array([-2.0, 1, 0.5]), 0.7
    filled = rng.random(shape) < 0.2
    cells = np.argwhere(filled)
    ids = np.full(shape, -1, np.int32)
    ids[tuple(cells.T)] = np.arange(len(cells))
    vertices = (low + side * (cells + rng.random(cells.shape))).astype(np.float32)
    return VertexGrid(ids, low, side, vertices, rng.normal(size=vertices.shape)), cells


@pytest.mark.parametrize("reach", [1, 2])
def test_the_nearest_vertex_is_that_of_all_pairs(rng, reach):
    grid, cells = vertex_grid(rng)
    high = grid.low + grid.side * np.array(grid.ids.shape)
    places = rng.uniform(grid.low - 3, high + 3, (400, 3))
    places[0] = 1e150  # a stray
    normals = rng.normal(size=places.shape)
    found_at, found = nearest_vertices(places, normals, grid, reach=reach, facing_away=9.0, threads=3)
    cell = np.floor((places - grid.low) / grid.side)
    away = np.square(places[:, None] - grid.vertices).sum(axis=2)
    away *= np.where(normals @ grid.normals.T < 0, 9, 1)
    away[(np.abs(cell[:, None] - cells) > reach).any(axis=2)] = np.inf
    np.testing.assert_array_equal(found, np.isfinite(away.min(axis=1)))
    assert 0.1 < found.mean() < 0.9
    np.testing.assert_array_equal(found_at[found], away.argmin(axis=1)[found])
    alone = nearest_vertices(places, normals, grid, reach=reach, facing_away=9.0, threads=1)
    np.testing.assert_array_equal(alone[0], found_at)


def test_sums_around_are_those_of_all_pairs(rng):
    points, values, middles = rng.random((300, 3)), rng.random((20, 5)), rng.random((20, 3))
    cells = rng.integers(20, size=300).astype(np.int32)
    beside = np.where(
        rng.random((20, 6)) < 0.7, rng.permuted(np.tile(np.arange(20), (20, 1)), axis=1)[:, :6], -1
    )
    beside = beside.astype(np.int32)
    found = sums_around(points, cells, beside, middles, values, deviation=0.4, threads=2)
    weights = np.exp(-np.square(points[:, None] - middles).sum(axis=2) / (2 * 0.4**2))
    near = np.zeros((20, 20))
    for row, others in enumerate(beside):
        near[row, others[others >= 0]] = 1
    np.testing.assert_allclose(found, (weights * near[cells]) @ values, rtol=1e-12)
