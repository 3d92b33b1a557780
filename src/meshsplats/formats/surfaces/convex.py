"""A surface as convex parts, as game engines want colliders that are not triangles one by one."""

from __future__ import annotations

import heapq
import itertools
from typing import NamedTuple

import numpy as np

from meshsplats._common.geometry import edge_groups
from meshsplats.errors import MissingDependencyError

PARTS = 32
"""Largest number of parts."""
EXCESS = 0.05
"""By how much the parts of a solid may be larger than it, in its volume, where fewer suffice."""
FEWEST = 8
"""Parts of open surfaces with fewer triangles are not halved."""
THICK = 0.002
"""Thickness of parts that are flat, relative to the diagonal of the surface's box."""
_PLACES = (0.25, 0.5, 0.75)
"""Where along each axis a part of a solid may be cut."""
_FACE = 0.01
"""What a cut costs, as the thickness of a layer over it, relative to the diagonal of the part's box: slices
off the flat sides of a ring gain a little each, and close its hole."""
_TRIED = 2000
"""Points whose hulls tell how good a cut is."""

Hull = tuple[np.ndarray, np.ndarray]
"""Vertices (n, 3) float32 and triangles (m, 3) int32 that face outwards."""


def convex_parts(vertices: np.ndarray, faces: np.ndarray, count: int = PARTS) -> list[Hull]:
    """At most ``count`` convex hulls that together hold all triangles of a mesh, (n, 3) vertices and (m, 3)
    triangles.

    A closed mesh is cut as the solid that it is: its parts fill it, one where it is convex. Of an open one,
    the part whose hull has the largest volume is halved, at the median of its triangles along the longest
    side of its box, until there are enough.

    Raises MissingDependencyError without scipy.
    """
    thick = THICK * float(np.linalg.norm(np.ptp(vertices[faces.ravel()], axis=0)))
    triangles = vertices[faces].astype(np.float64)
    if _is_closed(vertices, faces) and (solid := _Solid(triangles)).volume(*solid.box) > 0:
        return _parts_of_solid(solid, thick, count)
    return _parts_of_shell(vertices, faces, thick, count)


def _is_closed(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether every edge has as many triangles in one direction as in the other; vertices at one place are
    one."""
    index = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)[faces]
    index = index[(index != np.roll(index, 1, axis=1)).all(axis=1)]
    if not len(index):
        return False
    order, starts = edge_groups(index)
    ahead = np.where(index < np.roll(index, -1, axis=1), 1, -1).ravel()[order]
    return not np.add.reduceat(ahead, starts[:-1]).any()


def _parts_of_shell(vertices: np.ndarray, faces: np.ndarray, thick: float, count: int) -> list[Hull]:
    middles, numbers = vertices[faces].mean(axis=1), itertools.count()

    def entry(rows: np.ndarray) -> tuple[float, int, np.ndarray, Hull]:
        points = _thickened(vertices[np.unique(faces[rows])], thick)
        hull, volume = _hull(points, thick)
        return -volume if len(rows) >= FEWEST else 0.0, next(numbers), rows, hull

    parts = [entry(np.arange(len(faces)))]
    while len(parts) < count and parts[0][0] < 0:
        _, _, rows, _ = heapq.heappop(parts)
        axis = np.ptp(middles[rows], axis=0).argmax()
        sorted_rows = rows[np.argsort(middles[rows, axis], kind="stable")]
        for half in np.array_split(sorted_rows, 2):
            heapq.heappush(parts, entry(half))
    return [hull for *_, hull in sorted(parts, key=lambda part: int(part[2][0]))]


class _Solid:
    """What closed triangles (m, 3, 3) that face outwards enclose, or a column of it along x."""

    def __init__(self, triangles: np.ndarray) -> None:
        self.triangles = triangles
        self.low, self.high = triangles.min(axis=1), triangles.max(axis=1)

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        return self.low.min(axis=0), self.high.max(axis=0)

    def column(self, low: np.ndarray, high: np.ndarray) -> _Solid:
        """That of all triangles which decide what is inside a box."""
        near = (self.high[:, 1:] >= low[1:]) & (self.low[:, 1:] <= high[1:])
        return _Solid(self.triangles[near.all(axis=1) & (self.high[:, 0] >= low[0])])

    def volume(self, low: np.ndarray, high: np.ndarray) -> float:
        """That of the solid within a box, by the divergence theorem along x: what lies behind the box counts
        as if it lay in its side."""
        part = self.triangles
        for axis in (1, 2):
            part = _cut(_cut(part, axis, low[axis])[1], axis, high[axis])[0]
        inside, behind = _cut(_cut(part, 0, low[0])[1], 0, high[0])
        depth = inside[:, :, 0].mean(axis=1) - low[0]
        return float((_areas(inside) * depth).sum() + (high[0] - low[0]) * _areas(behind).sum())

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(k,) bool: which points (k, 3) are inside."""
        return np.array([self._crossings(point) > 0 for point in points], bool)

    def _crossings(self, point: np.ndarray) -> int:
        """How many more triangles a ray along x leaves through than it enters by."""
        near = (self.low[:, 1:] <= point[1:]) & (self.high[:, 1:] >= point[1:])
        part = self.triangles[near.all(axis=1) & (self.high[:, 0] > point[0])]
        flat = part[:, :, 1:] - point[1:]
        ahead = np.roll(flat, -1, axis=1)
        sides = flat[..., 0] * ahead[..., 1] - flat[..., 1] * ahead[..., 0]  # of the edge after each corner
        hit = (sides > 0).all(axis=1) | (sides < 0).all(axis=1)
        sides, part = sides[hit], part[hit]
        weights = np.roll(sides, -1, axis=1) / sides.sum(axis=1, keepdims=True)
        behind = (weights * part[:, :, 0]).sum(axis=1) > point[0]
        return int(np.sign(sides[behind, 0]).sum())


class _Part(NamedTuple):
    """The part of a solid in a box."""

    surface: np.ndarray
    """(k, 3, 3) triangles of the solid, cut off at the box."""
    corners: np.ndarray
    """(c, 3) corners of the box that are inside the solid."""

    @property
    def points(self) -> np.ndarray:
        """(p, 3) points whose hull is that of the part."""
        return np.concatenate([self.corners, self.surface.reshape(-1, 3)])


def _parts_of_solid(solid: _Solid, thick: float, count: int) -> list[Hull]:
    """The part whose hull is too large by most is cut where the hulls of both sides and the cut are smallest,
    until all together are hardly larger than the solid."""
    allowed, numbers = EXCESS * solid.volume(*solid.box), itertools.count()
    # Planes and rays a little aside hit no edges of models that lie on a grid.
    aside = np.array([0.73205, 0.61803, 0.41421]) * 1e-7 * np.ptp(solid.box, axis=0).max()

    def entry(part: _Part) -> tuple[float, int, _Part, Hull]:
        hull, volume = _hull(part.points, thick)
        low, high = part.points.min(axis=0), part.points.max(axis=0)
        return min(solid.column(low, high).volume(low, high) - volume, 0.0), next(numbers), part, hull

    parts = [entry(_Part(solid.triangles, np.empty((0, 3))))]
    while len(parts) < count and -sum(part[0] for part in parts) > allowed:
        *_, part, hull = heapq.heappop(parts)
        cuts = _cuts(solid, part, aside, thick)
        if not cuts:
            heapq.heappush(parts, (0.0, next(numbers), part, hull))
            continue
        for half in min(cuts, key=lambda cut: cut[0])[1]:
            heapq.heappush(parts, entry(half))
    return [hull for *_, hull in sorted(parts, key=lambda part: part[1])]


def _cuts(solid: _Solid, part: _Part, aside: np.ndarray, thick: float) -> list[tuple[float, list[_Part]]]:
    """Cuts of a part along planes across the axes: about the volume of the hulls of both sides, with what the
    cut costs, and these."""
    low, high = part.points.min(axis=0) + aside, part.points.max(axis=0) + aside
    layer = _FACE * float(np.linalg.norm(high - low))
    ends, column = np.stack([low, high]), solid.column(low, high)
    box = np.array(list(itertools.product(*ends.T)))
    held = column.holds(box)
    found = []
    for axis, share in itertools.product(range(3), _PLACES):
        value = low[axis] + share * (high[axis] - low[axis])
        middle = box[box[:, axis] == low[axis]]
        middle[:, axis] = value
        shared = middle[column.holds(middle)]
        halves = [
            _Part(surface, np.concatenate([shared, box[held & (box[:, axis] == end)]]))
            for surface, end in zip(_cut(part.surface, axis, value), ends[:, axis], strict=True)
        ]
        if all(len(half.points) for half in halves):
            face = layer * float(np.prod(np.delete(high - low, axis)))
            found.append((face + sum(_roughly(half, thick) for half in halves), halves))
    return found


def _roughly(part: _Part, thick: float) -> float:
    """The volume of the hull of a part, or of some of its points."""
    points = part.points
    if len(points) > _TRIED:
        chosen = np.random.default_rng(0).integers(len(points), size=_TRIED)
        points = np.concatenate([part.corners, points[chosen]])
    return _hull(points, thick)[1]


def _cut(triangles: np.ndarray, axis: int, value: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (k, 3, 3) below and above ``value`` along an axis, of those that reach across it both
    parts."""
    offset = triangles[:, :, axis] - value
    up = offset > 0
    number = up.sum(axis=1)
    cut = (number == 1) | (number == 2)
    rows, single = np.flatnonzero(cut), number[cut] == 1
    # From the corner that is alone on its side on: p, and the crossings of its edges to q and r.
    alone = np.where(single, up[rows].argmax(axis=1), up[rows].argmin(axis=1))
    order = (alone[:, None] + np.arange(3)) % 3
    p, q, r = triangles[rows[:, None], order].transpose(1, 0, 2)
    over = offset[rows[:, None], order]
    crossings = []
    for k, other in ((1, q), (2, r)):
        crossing = p + (over[:, 0] / (over[:, 0] - over[:, k]))[:, None] * (other - p)
        crossing[:, axis] = value
        crossings.append(crossing)
    a, b = crossings
    tips = np.stack([p, a, b], axis=1)
    rests = np.stack([np.stack([a, q, r], axis=1), np.stack([a, r, b], axis=1)])
    below = [triangles[number == 0], tips[~single], *rests[:, single]]
    above = [triangles[number == 3], tips[single], *rests[:, ~single]]
    return np.concatenate(below), np.concatenate(above)


def _areas(triangles: np.ndarray) -> np.ndarray:
    """(k,) areas of triangles (k, 3, 3) seen along x, below 0 for those that face against it."""
    edges = triangles[:, 1:, 1:] - triangles[:, :1, 1:]
    return np.asarray(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]) / 2


def _hull(points: np.ndarray, thick: float) -> tuple[Hull, float]:
    """The convex hull of ``points`` (n, 3), where they are flat that of ``_thickened``, and its volume."""
    try:
        from scipy.spatial import ConvexHull, QhullError
    except ModuleNotFoundError as error:
        raise MissingDependencyError("convex parts need the extra 'base': pip install scipy") from error
    points = np.unique(points.astype(np.float32), axis=0).astype(np.float64)
    try:
        hull = ConvexHull(points)
    except QhullError:
        hull = ConvexHull(_thickened(points, thick))
    hull = ConvexHull(hull.points[hull.vertices])  # once more, for triangles without slivers
    triangles = hull.simplices
    a, b, c = hull.points[triangles].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
    triangles = np.where(inward[:, None], triangles[:, ::-1], triangles)
    used, index = np.unique(triangles, return_inverse=True)
    return (
        hull.points[used].astype(np.float32),
        index.reshape(-1, 3).astype(np.int32),
    ), float(hull.volume)


def _thickened(points: np.ndarray, thick: float) -> np.ndarray:
    """``points`` (n, 3) on both sides of the plane next to them, ``thick`` apart."""
    points = points.astype(np.float64)
    middle = points.mean(axis=0)
    across = np.linalg.svd(points - middle, full_matrices=False)[2][-1] if len(points) > 2 else np.eye(3)[0]
    offset = thick / 2 * across
    return np.concatenate([points - offset, points + offset])
