"""Polygons of files as triangles."""

from __future__ import annotations

import numpy as np

_FOLD = 1e-5
"""Share of a polygon's area: a triangle that covers more of it from behind is folded back."""
_TURNS = 16
"""Most corners around which a fan is tried."""
_STEP = 500
"""What it takes to look at a corner for an ear, in comparisons with other corners..."""
_WORK = 1 << 27
"""... of which a file may take so many, some 20 seconds. What is left then becomes fans."""


def corner_places(points: np.ndarray, corners: np.ndarray) -> np.ndarray | None:
    """(k, 3) the ``points`` (v, 3) at the ``corners`` (k,) of polygons; None where one is not among them."""
    known = len(corners) > 0 and corners.min() >= 0 and corners.max() < len(points)
    return points[corners] if known else None


def cut_polygons(lengths: np.ndarray, places: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Polygons with ``lengths`` (n,) corners each, one after the other, as triangles.

    Fans around the first corner; but where ``places`` (k, 3), the positions of all corners, show that
    triangles of one are folded back, a fan around another corner, or else ears. Points and lines give none.

    Returns:
        (f, 3) int64 corners of the triangles, among the k; (f,) int64 polygon of each.
    """
    if (lengths == 3).all():
        return np.arange(3 * len(lengths)).reshape(-1, 3), np.arange(len(lengths))
    per_face = np.maximum(lengths - 2, 0)
    owner = np.repeat(np.arange(len(lengths)), per_face)
    first = np.cumsum(lengths) - lengths
    start = first[owner]
    step = np.arange(len(owner)) - (np.cumsum(per_face) - per_face)[owner]
    cut = np.stack([start, start + step + 1, start + step + 2], axis=1)
    if places is not None:
        with np.errstate(all="ignore"):  # places may be anything
            _unfold(cut, owner, lengths, first, places)
    return cut, owner


def _unfold(
    cut: np.ndarray, owner: np.ndarray, lengths: np.ndarray, first: np.ndarray, places: np.ndarray
) -> None:
    """Cuts those polygons anew whose fans in ``cut`` are folded."""
    of_wide = np.flatnonzero(lengths[owner] > 3)
    fans, polygon = cut[of_wide], owner[of_wide]
    normals = _normals(places, fans)
    whole = np.stack([np.bincount(polygon, column, len(lengths)) for column in normals.T], axis=1)
    folded, work = np.unique(polygon[_behind(normals, whole[polygon])]), _WORK
    for n in np.unique(lengths[folded]).tolist():
        left = folded[lengths[folded] == n]
        fan = np.stack([np.zeros(n - 2, np.int64), np.arange(1, n - 1), np.arange(2, n)], axis=1)
        for turn in range(1, min(n, _TURNS)):
            others = first[left, None, None] + (fan + turn) % n
            better = ~_behind(_normals(places, others), whole[left, None]).any(axis=1)
            _put(cut, owner, left[better], others[better])
            left = left[~better]
        for number in left.tolist() if n > 4 else ():
            begin = int(first[number])
            flat = _flat(places[begin : begin + n].astype(np.float64), whole[number])
            ears, steps = _ears(flat, work // (_STEP + n))
            work -= steps * (_STEP + n)
            _put(cut, owner, np.array([number]), begin + ears[None])


def _put(cut: np.ndarray, owner: np.ndarray, polygons: np.ndarray, triangles: np.ndarray) -> None:
    """Replaces the triangles in ``cut`` of the ``polygons`` (p,) by ``triangles`` (p, t, 3)."""
    cut[np.searchsorted(owner, polygons)[:, None] + np.arange(triangles.shape[1])] = triangles


def _normals(places: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(..., 3) float64 normals of ``triangles`` (..., 3), of twice their area."""
    a, b, c = (places[triangles[..., i]].astype(np.float64) for i in range(3))
    return np.cross(b - a, c - a)


def _behind(normals: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Which triangles face away from the polygons with the normals ``whole``."""
    return np.asarray((normals * whole).sum(axis=-1) < -_FOLD * np.square(whole).sum(axis=-1))


def _flat(corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(n, 2) ``corners`` (n, 3) as seen against the ``normal``, counterclockwise."""
    axis = int(np.abs(normal).argmax())
    flat = corners[:, [(axis + 1) % 3, (axis + 2) % 3]] - corners[0, [(axis + 1) % 3, (axis + 2) % 3]]
    return flat if normal[axis] > 0 else flat * [-1, 1]


def _ears(flat: np.ndarray, most: int) -> tuple[np.ndarray, int]:
    """(n - 2, 3) the triangles of a polygon (n, 2), counterclockwise: corners whose triangle holds no other
    corner are cut off, one after the other. Where there are none, as it crosses itself, or ``most`` corners
    have been looked at, the rest is a fan. Also how many were."""
    left, triangles, at, steps, in_vain = np.arange(len(flat)), list[np.ndarray](), 0, 0, 0
    while len(left) > 3 and in_vain < len(left) and steps < most:
        steps += 1
        corner = left.take([at - 1, at, at + 1], mode="wrap")
        if _is_ear(flat[corner], flat):
            triangles.append(corner)
            left = np.delete(left, at)
            at, in_vain = (at - 1) % len(left), 0
        else:
            at, in_vain = (at + 1) % len(left), in_vain + 1
    rest = np.stack([np.full(len(left) - 2, left[0]), left[1:-1], left[2:]], axis=1)
    return np.concatenate([*(corner[None] for corner in triangles), rest]), steps


def _is_ear(triangle: np.ndarray, corners: np.ndarray) -> bool:
    """Whether a ``triangle`` (3, 2) is counterclockwise, and holds none of the ``corners`` (m, 2) but its
    own."""
    a, b, c = triangle
    if _turn(a, b, c) <= 0:
        return False
    near = corners[((corners >= triangle.min(axis=0)) & (corners <= triangle.max(axis=0))).all(axis=1)]
    held = near[(_turn(a, b, near) >= 0) & (_turn(b, c, near) >= 0) & (_turn(c, a, near) >= 0)]
    return not (held[:, None] != triangle).any(axis=2).all(axis=1).any()


def _turn(a: np.ndarray, b: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Positive for ``points`` (..., 2) to the left of the line from ``a`` to ``b``."""
    u, v = b - a, points - a
    return np.asarray(u[0] * v[..., 1] - u[1] * v[..., 0])
