"""Depth images of a scene fused into truncated signed distances on a grid, and the surface in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from meshsplats._core.surfaces import Grid, fuse_depth
from meshsplats.cameras.framing import scene_bounds, weighted_quantile
from meshsplats.errors import MissingDependencyError
from meshsplats.rendering import Rendering, render
from meshsplats.rendering.core_arguments import camera_struct
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.surfaces.options import MAX_RESOLUTION, USUAL_RESOLUTION

TRUNCATION = 3.0
"""Truncation of signed distances, in voxels."""
_SOLID = 0.5
"""Minimum alpha of a pixel that shows the surface; below it the whole ray is empty."""
_OUTLIERS = 0.002
"""Share of the opacity that may lie beyond each side of the box, so that floaters do not enlarge it."""
_MARGIN = 0.05
"""Margin around the box, relative to its longest side."""
_NEARLY, _ALL = 0.02, 0.001
"""Shares of what cameras see of a place beyond each side of two boxes: nearly all, and all but strays."""
_REACH = 0.25
"""How far the box of a place reaches beyond nearly all, relative to the longest side of that: what is farther
away is a background for whose sake all voxels would be coarse."""
_MOST, _AROUND = 0.95, 1.5
"""The grid of a place is even as far around as most of its cameras are, and this much farther."""
_FAR = 2.0
"""Nearly all of a place must reach so many times farther for that."""
_FINE = 0.02
"""Greatest side of the voxels of a place, as a share of the usual depth of its views..."""
_POINTS = 5e7
"""...but for grids of so many points, which take 1.5 GB."""
_CLOSE = 0.9
"""Distance before a surface, in units of the truncation, from which there must be something behind."""
_GAP = 3
"""Points across which gaps in a surface are closed."""
_FILLED = 0.1
"""Least distance below a surface of points in pockets that are filled, in units of the truncation."""
MIN_PART = 0.01
"""Connected parts with a smaller volume, relative to the largest part, are removed."""


def signed_distances(
    mesh: SplatMesh,
    cameras: Sequence[Camera],
    grid: Grid,
    *,
    behind: float = 1.0,
    unseen: float | None = -1.0,
    median: bool = False,
    threads: int | None = None,
    each: Callable[[Camera, Rendering], object] | None = None,
) -> np.ndarray:
    """(x, y, z) float32 truncated signed distances to the surface of ``mesh`` at the points of ``grid``.

    The unit is ``TRUNCATION`` voxels; positive outside. Points that no camera sees count as interior, with
    the distance ``unseen``, and those on the border of the grid as exterior, so that the surface is closed.
    With None they have no distance (NaN), and the surface ends where no camera saw it. ``each`` is called
    with every camera and its image on black.

    ``behind`` is the weight of distances behind a surface. Points near a sheet without thickness are as far
    in front of it for some cameras as behind it for others: with 1 a sheet leaves noise, with less nothing.

    ``median``: by median depths in place of mean ones. Behind a fence or haze, means lie between the two, for
    each camera elsewhere.
    """
    total, weight = np.zeros(grid.shape, np.float32), np.zeros(grid.shape, np.float32)
    for camera in (camera.with_near_plane(mesh.vertices) for camera in cameras):
        drawn = render(
            mesh, camera, background=(0, 0, 0), depth=not median, median_depth=median, threads=threads
        )
        depth = drawn.median_depth if median else drawn.mean_depth(min_alpha=_SOLID)
        assert depth is not None
        fuse_depth(
            total,
            weight,
            depth,
            camera_struct(camera),
            grid,
            truncation=TRUNCATION * grid.voxel,
            behind=behind,
            threads=threads,
        )
        if each is not None:
            each(camera, drawn)
    seen = weight > 0
    np.divide(total, weight, out=total, where=seen)
    total[~seen] = np.nan if unseen is None else unseen
    if unseen is None:
        close_gaps(total)
    else:
        for axis in range(3):
            sides = np.moveaxis(total, axis, 0)
            sides[0] = sides[-1] = 1
    return total


def close_gaps(field: np.ndarray) -> None:
    """Gives points without a distance (NaN), but near points close before a surface, one behind it, in place:
    cameras that disagree on where a surface is leave none that lies behind it for all of them."""
    close = field < _CLOSE
    near = close.copy()
    for _ in range(_GAP):
        grown = near.copy()
        for axis in range(3):
            for ahead in (slice(1, None), slice(None, -1)):
                back = slice(None, -1) if ahead.start else slice(1, None)
                np.moveaxis(grown, axis, 0)[ahead] |= np.moveaxis(near, axis, 0)[back]
        near = grown
    field[np.isnan(field) & near] = -_CLOSE


def isosurface(field: np.ndarray, *, closed: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """The surface where ``field``, an (x, y, z) grid, is 0, in the cells whose corners all are numbers.

    The triangles face the positive side. Parts of the interior with less than ``MIN_PART`` of the volume of
    the largest part are removed, and of an open surface those with less than that of its triangles. Hollows
    of a closed one are filled.

    Returns:
        (n, 3) float64 vertices in grid steps, (m, 3) int32 triangles.
    """
    label, marching_cubes, _ = libraries()
    known = np.isfinite(field)
    if closed:
        field = _without_pockets(field, label)
    part = label(field < 0, connectivity=1)
    sizes = np.bincount(part.ravel())
    if len(sizes) == 1 or sizes[0] == 0:  # all exterior, or all interior
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    small = sizes < MIN_PART * sizes[1:].max()
    small[0] = False
    try:
        vertices, triangles, _, _ = marching_cubes(
            np.where(known, np.where(small[part], -field, field), 1),
            0.0,
            gradient_direction="descent",
            allow_degenerate=False,
            mask=None if known.all() else _whole_cells(known),
        )
    except RuntimeError:  # no cell that is whole has a surface
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    if not closed:
        vertices, triangles = large_parts(vertices, triangles)
    return vertices.astype(np.float64), triangles.astype(np.int32)


def _whole_cells(known: np.ndarray) -> np.ndarray:
    """(x, y, z) bool: at the highest corner of each cell, by which marching cubes are chosen, whether all
    eight are ``known``."""
    whole = known.copy()
    for axis in range(3):
        along = np.moveaxis(whole, axis, 0)
        along[1:] &= along[:-1]
    return whole


def _without_pockets(field: np.ndarray, label: Callable[..., Any]) -> np.ndarray:
    """``field`` with an interior where exterior does not reach the border of the grid: nobody sees it, and a
    print would be hollow there."""
    outside = label(field >= 0, connectivity=1)
    reached = np.zeros(int(outside.max()) + 1, bool)
    for axis in range(3):
        reached[np.take(outside, [0, -1], axis=axis)] = True
    reached[0] = True
    return np.where(reached[outside], field, -np.maximum(np.abs(field), _FILLED))


def collapsed(vertices: np.ndarray, triangles: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """A mesh with about ``count`` triangles: (n, 3) float64 vertices, (m, 3) int32 triangles."""
    simplify = libraries()[2]
    points, kept = simplify(vertices.astype(np.float32), triangles.astype(np.int32), target_count=count)
    return points.astype(np.float64), kept.astype(np.int32)


def large_parts(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The connected parts of a mesh, (n, 3) vertices and (m, 3) triangles, with at least ``MIN_PART`` of the
    triangles of the largest."""
    if not len(triangles):
        return vertices, triangles
    part = parts_of(triangles, len(vertices))
    counts = np.bincount(part)
    kept = triangles[counts[part] >= MIN_PART * counts.max()]
    used, index = np.unique(kept, return_inverse=True)
    return vertices[used], index.reshape(-1, 3).astype(triangles.dtype)


def parts_of(triangles: np.ndarray, count: int) -> np.ndarray:
    """(m,) number of the connected part that each of the triangles (m, 3) of ``count`` vertices belongs to,
    from 0."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    tails, heads = triangles.ravel(), np.roll(triangles, 1, axis=1).ravel()
    links = coo_matrix((np.ones(len(tails), bool), (tails, heads)), (count, count))
    part = connected_components(links, directed=False)[1][triangles[:, 0]]
    return np.unique(part, return_inverse=True)[1].reshape(-1)


def libraries() -> tuple[Callable[..., Any], ...]:
    """scikit-image's label and marching_cubes, and simplify. MissingDependencyError names the extra."""
    try:
        from fast_simplification import simplify
        from skimage.measure import label, marching_cubes
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "a surface needs the extra 'base': pip install scikit-image fast-simplification uvunwrap scipy"
        ) from error
    return label, marching_cubes, simplify


def grid_around(scene: GaussianCloud | SplatMesh, resolution: int) -> Grid:
    """The grid around ``scene`` without its floaters, ``resolution`` voxels along the longest side.

    Raises ValueError for a scene that is empty or has no extent.
    """
    bounds = scene_bounds(scene)
    if not len(bounds.points):
        raise ValueError("the scene is empty")
    weights = bounds.weights if bounds.weights.sum() > 0 else np.ones(len(bounds.points))
    sides = [
        [weighted_quantile(bounds.points[:, k], weights, share) for share in (_OUTLIERS, 1 - _OUTLIERS)]
        for k in range(3)
    ]
    low, high = np.array(sides, np.float64).T
    longest = float((high - low).max())
    if not longest > 0:
        raise ValueError("the scene has no extent")
    low, high = low - _MARGIN * longest, high + _MARGIN * longest
    voxel = float((high - low).max()) / resolution
    return Grid(low, voxel, tuple(int(n) for n in np.ceil((high - low) / voxel) + 1))


def grid_of(
    points: np.ndarray, cameras: Sequence[Camera], resolution: int | None, usual_depth: float = 0.0
) -> Grid:
    """The grid around what ``cameras`` see of a place, ``points`` (n, 3), about ``resolution`` voxels along
    its longest side: around all of it but strays, unless these lie far beyond nearly all. Where some of it is
    far away, it is contracted beyond half of the distances that they see. Without a resolution, voxels have a
    share of the ``usual_depth`` of what is seen, as far as memory allows.

    Raises ValueError for points without extent.
    """
    centers = np.array([camera.center for camera in cameras])
    middle = np.median(centers, axis=0)
    apart = float(np.quantile(np.linalg.norm(centers - middle, axis=1), _MOST))
    depth, far = np.quantile(np.linalg.norm(points - middle, axis=1), [0.5, 1 - _NEARLY])
    radius = max(float(depth), _AROUND * apart)
    even = Grid(middle, 1.0, ())
    ball = even if far < _FAR * radius else even._replace(center=tuple(middle.tolist()), radius=radius)
    points = ball.contracted(points)
    lowest, low, high, highest = np.quantile(points, [_ALL, _NEARLY, 1 - _NEARLY, 1 - _ALL], axis=0)
    reach = _REACH * float((high - low).max())
    low, high = np.maximum(lowest, low - reach), np.minimum(highest, high + reach)
    longest = float((high - low).max())
    if not longest > 0:
        raise ValueError("the scene has no extent")
    if resolution is None:
        most = (_POINTS * longest**3 / float(np.prod(np.maximum(high - low, 1e-3 * longest)))) ** (1 / 3)
        wanted = min(longest / (_FINE * usual_depth), most) if usual_depth > 0 else 0.0
        resolution = int(np.clip(wanted, USUAL_RESOLUTION, MAX_RESOLUTION))
    voxel = longest / (resolution - 4)
    low = low - 2 * voxel
    shape = tuple(int(n) for n in np.ceil((high - low) / voxel) + 3)
    return ball._replace(low=low, voxel=voxel, shape=shape)
