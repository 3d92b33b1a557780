"""The visual hull of a masked subject: the cells of a grid that no silhouette rules out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.datasets.silhouettes import OPAQUE, has_alpha
from meshsplats.datasets.views import View
from meshsplats.scene.camera import Camera

FIRST_LEVEL = 32
"""Cells along each side of the first grid. Each further one has twice as many."""
LAST_LEVEL = 1024
"""Cells along each side of the finest grid."""
TOLERANCE = 0.1
"""Share of the views that may rule a cell out without effect, while it is not known which are misplaced."""
MISPLACED = 0.75
"""A view whose silhouette overlaps that of the first hull by less than this share of the median is misplaced
and takes no further part."""
ASTRAY = 0.04
"""Share of the views that may have a point outside of their silhouettes."""
SEEN_SHARES = (0.5, 0.25, 0.1, 0.04)
"""Share of the views that must have a cell in their image: the first for which the hull lacks nothing that it
has for the last, as subjects may be photographed in parts. Where few see a cell, little rules it out..."""
FEWEST_SEEN = 3
"""...so that at least so many must, but for sets of few views."""
LACKING = 0.01
"""Share of a silhouette that the image of a hull lacks, from which on it is too small..."""
COVERED_VIEWS = 48
"""...and maximum number of views, evenly spread, in which that is looked at."""
SILHOUETTE_BYTES = 1 << 30
"""Limit on the silhouettes of all views together. Larger ones are made smaller."""
PIXEL_BYTES = 5
"""Memory of a pixel of a silhouette."""
MOST_CELLS = 1 << 25
"""Limit on the cells of a grid, those inside of the hull included."""
CELL_BYTES = 64
"""Memory of a cell while the next finer grid is carved."""
CELLS_AT_ONCE = 1 << 20
"""Cells that are tested at a time."""


class Surface(NamedTuple):
    """Cells on the surface of a hull."""

    points: np.ndarray
    """(n, 3) float64 their centres."""
    normals: np.ndarray
    """(n, 3) float64 unit normals that point outwards."""
    side: float
    """Side of a cell, scene units."""


class _Silhouette:
    """The silhouette of one view, as sums over all rectangles from the image's corner. ``factor``: size of
    the silhouette relative to the image."""

    def __init__(self, view: View, factor: float = 1.0) -> None:
        image = view.load()
        assert image.alpha is not None
        unit = 255 if image.alpha.dtype == np.uint8 else 1
        inside = image.alpha >= OPAQUE * unit
        if image.mask is not None:
            inside |= ~image.mask  # pixels that do not count rule nothing out
        self.camera: Camera = view.camera
        if factor < 1:
            self.camera = view.camera.scaled(factor)
            inside = _reduced(inside, self.camera.width, self.camera.height)
        self.inside = inside
        self.sums = np.zeros((inside.shape[0] + 1, inside.shape[1] + 1), np.int32)
        self.sums[1:, 1:] = inside.cumsum(axis=0, dtype=np.int32).cumsum(axis=1, dtype=np.int32)

    def test(self, points: np.ndarray, reach: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) bool each: ``points`` (n, 3) that lie in the image; those of them whose square of ``reach``
        scene units, one number or (n,), to each side holds no pixel of the silhouette."""
        positions, depth = self.camera.project(points)
        in_image = self.camera.in_image(positions)
        rows = np.flatnonzero(in_image)
        size = max(self.camera.fx, self.camera.fy) * np.broadcast_to(reach, len(points))[rows] / depth[rows]
        x, y = positions[rows].T
        left = np.maximum(np.floor(x - size), 0).astype(np.int64)
        top = np.maximum(np.floor(y - size), 0).astype(np.int64)
        right = np.minimum(np.floor(x + size) + 1, self.camera.width).astype(np.int64)
        bottom = np.minimum(np.floor(y + size) + 1, self.camera.height).astype(np.int64)
        s = self.sums
        count = s[bottom, right] - s[top, right] - s[bottom, left] + s[top, left]
        empty = np.zeros(len(points), bool)
        empty[rows] = count == 0
        return in_image, empty


def _reduced(inside: np.ndarray, width: int, height: int) -> np.ndarray:
    """``inside`` (h, w) bool at a smaller size: a pixel is inside if any that it covers is."""
    for axis, count in enumerate((height, width)):
        size = inside.shape[axis]
        edges = np.arange(count + 1) * size
        first, last = edges[:-1] // count, -(-edges[1:] // count)
        sums = np.zeros((size + 1, inside.shape[1 - axis]), np.int32)
        np.cumsum(np.moveaxis(inside, axis, 0), axis=0, dtype=np.int32, out=sums[1:])
        inside = np.moveaxis(sums[last] > sums[first], 0, axis)
    return np.ascontiguousarray(inside)


def silhouette_factor(views: Sequence[View]) -> float:
    """Size of silhouettes relative to the images of ``views``, at most 1, for ``SILHOUETTE_BYTES``."""
    pixels = sum(view.camera.width * view.camera.height for view in views)
    return min(1.0, float(np.sqrt(SILHOUETTE_BYTES / (PIXEL_BYTES * max(pixels, 1)))))


def carving_bytes(views: Sequence[View], cells: int) -> int:
    """Estimated memory of ``carve`` in bytes; 0 where no image can have alpha."""
    if not any(map(has_alpha, views)):
        return 0
    pixels = sum(view.camera.width * view.camera.height for view in views)
    # The inside of a ball: a compact subject has most cells inside for those on its surface.
    return min(PIXEL_BYTES * pixels, SILHOUETTE_BYTES) + CELL_BYTES * min(int(cells**1.5), MOST_CELLS)


def in_silhouettes(views: Sequence[View], points: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """(n,) bool: ``points`` (n, 3) that lie within the silhouettes, give or take ``reach`` (n,) scene units,
    of all views that have them in the image but ``ASTRAY`` of them."""
    seen, against = np.zeros(len(points)), np.zeros(len(points))
    for view in filter(has_alpha, views):
        in_image, empty = _Silhouette(view).test(points, reach)
        seen += in_image
        against += empty
    return against <= ASTRAY * seen


def carve(
    views: Sequence[View], cells: int, solid: Callable[[np.ndarray], np.ndarray] | None = None
) -> Surface | None:
    """The surface of the visual hull of ``views`` with alpha, of at least ``cells`` cells where the finest
    grid has as many. Grids have ``LAST_LEVEL`` cells to a side, or ``MOST_CELLS`` in the hull, at most.

    A cell is empty where views see it outside of their silhouettes. Views with wrong poses are found by their
    silhouettes and left out. ``solid`` gives (n,) bool for points (n, 3): cells that it rules out are empty,
    too. None if nothing is left, as for alpha that is not of one subject.
    """
    views = [view for view in views if has_alpha(view)]
    factor = silhouette_factor(views)
    outlines = [_Silhouette(view, factor) for view in views]
    low, side = _root(outlines)
    count = FIRST_LEVEL
    index, rule = _first_hull(outlines, low, side / count)
    if not len(index):
        return None
    # The root cube is a guess: the grid is laid anew around what the first carving left.
    first, last = index.min(axis=0), index.max(axis=0) + 1
    low, side = low + (first - 1) * side / count, float((last - first + 2).max()) * side / count
    index = _kept(outlines, _grid(count), low, side / count, rule)
    if rule.tolerance and len(index):
        outlines = _placed(outlines, low + (index + 0.5) * side / count, side / count)
        rule = rule._replace(tolerance=0)
        index = _kept(outlines, index, low, side / count, rule)
    while len(index):
        surface = _surface(index, count, low, side / count)
        if len(surface.points) >= cells or count >= LAST_LEVEL or 8 * len(index) > MOST_CELLS:
            return surface
        count *= 2
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.int32)
        index = (2 * index[:, None] + corners).reshape(-1, 3)
        index = _kept(outlines, index, low, side / count, rule)
        if solid is not None and len(index):
            parts = [part[solid(low + (part + 0.5) * side / count)] for part in _parts(index)]
            index = np.concatenate(parts)
    return None


def _grid(count: int) -> np.ndarray:
    """(count^3, 3) int32 indices of the cells of a cube."""
    return np.stack(np.meshgrid(*[np.arange(count, dtype=np.int32)] * 3, indexing="ij"), -1).reshape(-1, 3)


def _parts(index: np.ndarray) -> list[np.ndarray]:
    """``index`` in pieces of ``CELLS_AT_ONCE``."""
    return np.split(index, list(range(CELLS_AT_ONCE, len(index), CELLS_AT_ONCE)))


def _root(outlines: Sequence[_Silhouette]) -> tuple[np.ndarray, float]:
    """(3,) least corner and side of a cube around the subject: where the rays through the middles of the
    silhouettes meet."""
    rays, centers = [], []
    for outline in outlines:
        rows, columns = np.nonzero(outline.inside)
        camera = outline.camera
        x, y = (columns.mean(), rows.mean()) if len(rows) else (camera.cx, camera.cy)
        ray = np.array([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1.0])
        ray = ray @ camera.world_to_camera[:3, :3]
        rays.append(ray / np.linalg.norm(ray))
        centers.append(camera.center)
    directions, origins = np.array(rays), np.array(centers)
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    weights = np.ones(len(directions))
    middle = origins.mean(axis=0)
    for _ in range(10):  # reweighted least squares: a few misplaced views do not matter
        left = np.einsum("n,nij->ij", weights, across) + 1e-9 * np.eye(3)
        middle = np.linalg.solve(left, np.einsum("n,nij,nj->i", weights, across, origins))
        error = np.linalg.norm(np.einsum("nij,nj->ni", across, middle - origins), axis=1)
        if not error.max():
            break
        weights = 1 / np.maximum(error / error.max(), 1e-6)
    half = float(np.median(np.linalg.norm(origins - middle, axis=1)))
    return middle - half, 2 * half


class _Rule(NamedTuple):
    """Which cells are kept."""

    tolerance: int
    """Views that may rule a cell out without effect where all have it in their image."""
    share: float
    """Of ``SEEN_SHARES``."""

    def keeps(self, seen: np.ndarray, against: np.ndarray, views: int) -> np.ndarray:
        """(n,) bool for cells that of so many ``views`` some have ``seen`` (n,), and some are ``against``."""
        half = 0.5 * views
        enough = seen >= max(self.share * views, min(FEWEST_SEEN, half), 1)
        return np.asarray(enough & (against <= self.tolerance * np.minimum(seen / half, 1)))


def _kept(
    outlines: Sequence[_Silhouette], index: np.ndarray, low: np.ndarray, side: float, rule: _Rule
) -> np.ndarray:
    """The cells ``index`` (n, 3) of the given ``side`` that ``rule`` keeps."""
    kept = [
        part[rule.keeps(*_counts(outlines, low + (part + 0.5) * side, side, rule.tolerance), len(outlines))]
        for part in _parts(index)
    ]
    return np.concatenate(kept)


def _counts(
    outlines: Sequence[_Silhouette], points: np.ndarray, side: float, tolerance: int
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) each: views that have the cells of ``side`` at ``points`` (n, 3) in their image, and that rule
    them out. Nothing more is counted where more than ``tolerance`` do."""
    seen, against = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    rows = np.arange(len(points))
    for outline in outlines:
        in_image, empty = outline.test(points[rows], side / 2)
        seen[rows] += in_image
        against[rows] += empty
        rows = rows[against[rows] <= tolerance]
    return seen, against


def _first_hull(outlines: Sequence[_Silhouette], low: np.ndarray, side: float) -> tuple[np.ndarray, _Rule]:
    """The cells (n, 3) of ``side`` that are kept of the first grid, from ``low`` on, and the rule by which
    they and all later ones are."""
    tolerance, grid = int(TOLERANCE * len(outlines)), _grid(FIRST_LEVEL)
    some = subsample(outlines, COVERED_VIEWS)
    seen, against = _counts(outlines, low + (grid + 0.5) * side, side, tolerance)
    rules = [_Rule(tolerance, share) for share in SEEN_SHARES]
    hulls = [grid[rule.keeps(seen, against, len(outlines))] for rule in rules]

    def covered(hull: np.ndarray) -> np.ndarray:
        return _coverage(some, low + (hull + 0.5) * side, side)

    def enough(found: np.ndarray, most: np.ndarray | float) -> bool:
        return bool(np.count_nonzero(found < most - LACKING) <= TOLERANCE * len(some))

    found, chosen = covered(hulls[0]), 0
    most = 1.0 if enough(found, 1.0) else covered(hulls[-1])
    while not enough(found, most):
        chosen += 1
        found = covered(hulls[chosen])
    return hulls[chosen], rules[chosen]


def _placed(outlines: Sequence[_Silhouette], points: np.ndarray, side: float) -> list[_Silhouette]:
    """The views whose silhouettes agree with the cells of ``side`` at ``points`` (n, 3)."""
    overlap = np.array([_overlap(outline, points, side) for outline in outlines])
    return [o for o, share in zip(outlines, overlap, strict=True) if share >= MISPLACED * np.median(overlap)]


def _coverage(outlines: Sequence[_Silhouette], points: np.ndarray, side: float) -> np.ndarray:
    """(views,) share of each silhouette that the image of the cells of ``side`` at ``points`` (n, 3)
    covers."""
    shares = []
    for outline in outlines:
        inside = np.count_nonzero(outline.inside)
        both = np.count_nonzero(_image(outline, points, side) & outline.inside) if len(points) else 0
        shares.append(both / inside if inside else 1.0)
    return np.array(shares)


def _overlap(outline: _Silhouette, points: np.ndarray, side: float) -> float:
    """Pixels in both the silhouette and the image of the cells, as a share of those in either."""
    covered = _image(outline, points, side)
    either = np.count_nonzero(covered | outline.inside)
    return np.count_nonzero(covered & outline.inside) / either if either else 0.0


def _image(outline: _Silhouette, points: np.ndarray, side: float) -> np.ndarray:
    """(h, w) bool: pixels of the cells of ``side`` at ``points`` (n, 3)."""
    camera = outline.camera
    positions, depth = camera.project(points)
    rows = depth > max(side, camera.near or 0)  # also those beside the image, into which they reach
    drawn = np.zeros((camera.height + 1, camera.width + 1), np.int32)
    size = max(camera.fx, camera.fy) * side / 2 / depth[rows]
    x, y = positions[rows].T
    left, right = (np.clip(np.floor(v), 0, camera.width).astype(np.int64) for v in (x - size, x + size + 1))
    top, bottom = (np.clip(np.floor(v), 0, camera.height).astype(np.int64) for v in (y - size, y + size + 1))
    for row, column, sign in ((top, left, 1), (top, right, -1), (bottom, left, -1), (bottom, right, 1)):
        np.add.at(drawn, (row, column), sign)
    return np.asarray(drawn.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0)


def _surface(index: np.ndarray, count: int, low: np.ndarray, side: float) -> Surface:
    """The cells of ``index`` (n, 3), of ``count`` along each side, with an empty one beside them."""
    first = index.min(axis=0) - 3
    shape = tuple(index.max(axis=0) - first + 4)
    filled = np.zeros(shape, bool)
    x, y, z = (index - first).T
    filled[x, y, z] = True
    inner = np.ones(len(index), bool)
    for axis in range(3):
        for step in (-1, 1):
            i, j, k = (step if other == axis else 0 for other in range(3))
            inner &= filled[x + i, y + j, z + k]
    outer = ~inner
    x, y, z = (index[outer] - first).T
    slope = np.zeros((len(x), 3))
    for i in (-2, -1, 0, 1, 2):
        for j in (-2, -1, 0, 1, 2):
            for k in (-2, -1, 0, 1, 2):
                length = np.sqrt(i * i + j * j + k * k)
                if length:
                    slope -= filled[x + i, y + j, z + k][:, None] * (np.array([i, j, k]) / length**2)
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    normals = np.where(length > 1e-9, slope / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
    return Surface(low + (index[outer] + 0.5) * side, normals, side)
