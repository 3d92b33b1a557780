"""Geometry that several rooms share: rotations, directions, vertex normals, the spacing of points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

_SPACING_LEVELS = 20
"""Halvings of the extent down to the smallest cell for ``spacing``."""
STRAYS = 1024
"""Extent of a scene, as a multiple of that of 98 % of its points, from which on the others are strays."""

_GLOBE = (6.3e6, 6.45e6)
"""Distances of the ground from the middle of the Earth, metres."""
_FLATTENING = 1.0067394967
"""(a / b)^2 of the ellipsoid of WGS 84."""


def away_from_ground(place: np.ndarray) -> np.ndarray | None:
    """(3,) unit normal of the Earth's ellipsoid below ``place`` (3,), metres from its middle (ECEF); None for
    a place that is not on the ground."""
    if not _GLOBE[0] < np.linalg.norm(place) < _GLOBE[1]:
        return None
    normal: np.ndarray = place * [1, 1, _FLATTENING]
    return normal / np.linalg.norm(normal)


def rotation_rows(w: Any, x: Any, y: Any, z: Any) -> Iterator[tuple[Any, Any, Any]]:
    """The three rows of the rotation matrix of unit quaternions w, x, y, z, one after the other.

    Args:
        w, x, y, z: numbers, or arrays of one shape and float type; so are the entries of the rows.
    """
    yield 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    yield 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    yield 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


def quaternions_of(rotations: np.ndarray) -> np.ndarray:
    """(n, 4) unit quaternions w, x, y, z of proper rotation matrices (n, 3, 3)."""
    r = rotations
    trace = np.trace(r, axis1=1, axis2=2)
    # 4 q q^T: each row is a multiple of q, and the row with the largest diagonal is the most exact.
    k = np.empty((len(r), 4, 4))
    k[:, 0, 0] = 1 + trace
    for i in range(3):
        j, m = (i + 1) % 3, (i + 2) % 3
        k[:, 0, i + 1] = k[:, i + 1, 0] = r[:, m, j] - r[:, j, m]
        k[:, i + 1, i + 1] = 1 - trace + 2 * r[:, i, i]
        k[:, i + 1, j + 1] = k[:, j + 1, i + 1] = r[:, i, j] + r[:, j, i]
    best = np.diagonal(k, axis1=1, axis2=2).argmax(axis=1)
    q = k[np.arange(len(r)), best]
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def quaternion_product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(n, 4) Hamilton products of the quaternion ``p`` with each of ``q``; w, x, y, z."""
    a, b, c, d = p
    left = np.array([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]])
    return q @ left.T


def direction(axes: np.ndarray, azimuth: float, elevation: float) -> np.ndarray:
    """(3,) unit vector at ``azimuth`` and ``elevation`` in degrees, from a subject outwards.

    Azimuth 0 is in front of the subject, 90 at its right-hand side; elevation 90 is above it.

    Args:
        axes: (3, 3) rows right, up, forward of someone who stands in front (``framing.front_axes``).
    """
    a, e = np.radians(azimuth), np.radians(elevation)
    right, up, forward = axes
    return np.cos(e) * (np.sin(a) * right - np.cos(a) * forward) + np.sin(e) * up


def level_axes(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (3,) at right angles to each other and to the unit vector ``up``."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


_CANCELLED = 1e-6
"""Length of a sum of normals, as a share of the sum of their lengths, up to which they cancel out."""


def vertex_normals(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    same_place: np.ndarray | None = None,
    fallback: Sequence[float] | np.ndarray = (0, 0, 1),
) -> np.ndarray:
    """(n, 3) float64 unit normals at the vertices of a mesh: area-weighted means of the triangles' normals.

    Args:
        vertices: (n, 3); the triangles' normals are computed in their float type.
        faces: (m, 3) vertex indices.
        same_place: (n,) index of a place for each vertex; vertices of one place share a normal. By default,
            each vertex is a place of its own.
        fallback: (3,) vector where the triangles around a vertex have no area, or their normals cancel out,
            as on cards with triangles of both windings.
    """
    place = np.arange(len(vertices)) if same_place is None else same_place
    count = int(place.max()) + 1 if len(place) else 0
    corners = [faces[:, k] for k in range(3)]
    coordinates = np.ascontiguousarray(vertices.T)
    edges = [[p[corners[k]] - p[corners[0]] for p in coordinates] for k in (1, 2)]
    if same_place is not None:
        corners = [place[corner] for corner in corners]
    sums, squares = np.empty((count, 3)), np.zeros(len(faces))
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        doubled = edges[0][i] * edges[1][j] - edges[0][j] * edges[1][i]  # twice the area times the normal
        squares += np.square(doubled, dtype=np.float64)
        sums[:, axis] = sum(np.bincount(corner, doubled, minlength=count) for corner in corners)
    length = np.sqrt(np.einsum("ij,ij->i", sums, sums))
    around = sum(np.bincount(corner, np.sqrt(squares), minlength=count) for corner in corners)
    lost = length <= _CANCELLED * around
    sums[lost] = fallback
    return (sums / np.where(lost, 1, length)[:, None])[place]


def edge_groups(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The half edges of triangles (m, 3), from corner i of a triangle to its next corner, sorted by the edge
    on which they lie.

    Returns:
        (3 m,) int64 half edges, 3 * triangle + i; (k + 1,) int64 where those of each edge begin.
    """
    tails, heads = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel()
    keys = np.minimum(tails, heads) * (int(faces.max(initial=0)) + 1) + np.maximum(tails, heads)
    order = np.argsort(keys, kind="stable")
    return order, np.concatenate([[0], np.flatnonzero(np.diff(keys[order])) + 1, [len(keys)]])


def spacing(points: np.ndarray, share: int = 8) -> np.ndarray:
    """(n,) float32 spacing of ``points`` (n, 3) around each of them, in their units.

    Concretely, the points are sorted into an octree of cubic cells; a point's spacing is ``side /
    sqrt(count)`` of the smallest cell around it that holds at least ``share`` points, as if these lay on a
    surface. Points in one spot have the spacing of the smallest cell, 2^-20 of the extent.
    """
    levels = _SPACING_LEVELS
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    n = len(points)
    if n == 1 or (high == low).all():
        return np.zeros(n, np.float32)
    # The cells divide the place where nearly all points are: strays would leave a few of them for the rest.
    usual = np.quantile(points[:: -(-n // 20_000)].astype(np.float64), (0.01, 0.99), axis=0)
    side = float(np.ptp(usual, axis=0).max())
    if 0 < STRAYS * side < float((high - low).max()):
        low = np.maximum(low, usual[0] - STRAYS / 4 * side)
        high = np.minimum(high, usual[1] + STRAYS / 4 * side)
        points = np.clip(points, low, high)
    extent = float((high - low).max())
    cells = ((points - low) * ((1 << levels) * (1 - 1e-9) / extent)).astype(np.uint64)
    code = _interleaved(cells)  # Morton order: cells of every level are runs of points
    order = np.argsort(code)  # points of one cell get one spacing: their order does not matter
    code = code[order]
    found = np.full(n, extent / np.sqrt(n), np.float32)
    settled = np.zeros(n, bool)
    for level in range(levels + 1):
        parent = code >> np.uint64(3 * level)
        starts = np.flatnonzero(np.concatenate([[True], parent[1:] != parent[:-1]]))
        counts = np.diff(np.append(starts, n))
        enough = np.repeat(counts >= share, counts) & ~settled
        if enough.any():
            side = extent / (1 << (levels - level))
            found[enough] = np.repeat(side / np.sqrt(counts), counts)[enough]
            settled |= enough
            if settled.all():
                break
    result = np.empty(n, np.float32)
    result[order] = found
    return result


def _interleaved(cells: np.ndarray) -> np.ndarray:
    """(n,) uint64 Morton codes of the indices (n, 3) of cells, 21 bits along each axis."""
    code = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        code |= _every_third_bit(cells[:, axis]) << np.uint64(axis)
    return code


def _every_third_bit(values: np.ndarray) -> np.ndarray:
    """21-bit numbers with two zero bits after each bit."""
    v = values.astype(np.uint64)
    for shift, mask in [
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ]:
        v = (v | (v << np.uint64(shift))) & np.uint64(mask)
    return v


def morton_codes(points: np.ndarray, low: np.ndarray, side: float, levels: int) -> np.ndarray:
    """(n,) uint64 codes of the cells of an octree that ``points`` (n, 3) lie in.

    Concretely, a code has three bits for each of the ``levels``, the coarsest on top: bit 0 is the half along
    x, bit 1 along y, bit 2 along z.

    Args:
        points: points; those outside the root cell count as on its border.
        low, side: (3,) least corner and side of the root cell.
        levels: 1 to 21.
    """
    steps = (points.astype(np.float64) - low) * ((1 << levels) / side)
    cells = np.clip(steps, 0, (1 << levels) - 1).astype(np.uint64)
    return _interleaved(cells)


def affine_parts(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3, 3) linear part and (3,) shift, float64, of a map (4, 4), (3, 4) or (3, 3).

    Raises ValueError for another shape or last row, and for a matrix that is singular or not finite.
    """
    matrix = np.asarray(matrix, np.float64)
    if matrix.shape not in ((3, 3), (3, 4), (4, 4)):
        raise ValueError(f"the transform must have shape (4, 4), (3, 4) or (3, 3), got {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise ValueError("the transform is not finite")
    if len(matrix) == 4 and (matrix[3] != (0, 0, 0, 1)).any():
        raise ValueError(f"the last row of the transform must be 0 0 0 1, got {matrix[3].tolist()}")
    linear = matrix[:3, :3]
    stretch = np.linalg.svd(linear, compute_uv=False)
    if stretch[2] <= 1e-12 * stretch[0]:
        raise ValueError("the transform flattens space (a singular matrix)")
    return linear, np.zeros(3) if matrix.shape == (3, 3) else matrix[:3, 3]
