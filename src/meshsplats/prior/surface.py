"""A base mesh from splats: depth images from all directions, fused into a closed surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from meshsplats.base_mesh import BaseMesh
from meshsplats.binding import Binding
from meshsplats.camera import Camera
from meshsplats.cameras.framing import guess_up, scene_bounds, weighted_quantile
from meshsplats.cameras.trajectories import dome
from meshsplats.datasets.views import View, ViewImage
from meshsplats.errors import MissingDependencyError
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.prior.color_projection import colors_from_views
from meshsplats.rendering import Rendering, render

MAX_RESOLUTION = 512
"""Maximum number of voxels along the longest side of the grid."""
TRUNCATION = 3.0
"""Truncation of signed distances, in voxels."""
_SOLID = 0.5
"""Minimum alpha of a pixel that shows the surface; below it the whole ray is empty."""
_OUTLIERS = 0.002
"""Share of the opacity that may lie beyond each side of the box, so that floaters do not enlarge it."""
_MARGIN = 0.05
"""Margin around the box, relative to its longest side."""
MIN_PART = 0.01
"""Connected parts with a smaller volume, relative to the largest part, are removed."""


def base_surface(
    scene: GaussianCloud | SplatMesh,
    *,
    resolution: int = 96,
    faces: int = 20_000,
    cameras: Sequence[Camera] | int = 48,
    threads: int | None = None,
    progress: Callable[[], object] | None = None,
) -> BaseMesh:
    """A closed, coloured surface of an object, to serve as the base of a mesh prior.

    The scene is rendered as a mesh from all directions, with depth. The depth images are fused into a
    truncated signed distance function (TSDF; Curless and Levoy 1996) on a voxel grid, in which unobserved
    voxels count as interior. Marching cubes extracts its zero level set, and quadric edge collapses (Garland
    and Heckbert 1997) reduce the number of faces. Small separate parts are removed. Needs the extra ``base``.

    Args:
        scene: splats, which are converted first, or a mesh, for instance a fine-tuned one.
        resolution: voxels along the longest side of the box, 8 to 512. Time and memory grow with its cube.
        faces: approximate maximum number of triangles, at least 4; 0: no maximum.
        cameras: cameras that see the whole object, or a number of cameras to place around it, 4 to 1000.
        threads: maximum number of threads; all processors by default.
        progress: called after each image.

    Returns:
        The base mesh with vertex colours, in scene units.

    Raises:
        ValueError: options out of range, or images that show nothing solid.
        MissingDependencyError: the libraries of the extra ``base`` are missing.
    """
    if not 8 <= resolution <= MAX_RESOLUTION:
        raise ValueError(f"resolution must be 8 to {MAX_RESOLUTION} voxels, got {resolution}")
    if faces < 0 or 0 < faces < 4:
        raise ValueError(f"faces must be 4 or more, or 0 for all, got {faces}")
    if isinstance(cameras, int):
        if not 4 <= cameras <= 1000:
            raise ValueError(f"cameras must be 4 to 1000, got {cameras}")
        side = int(np.clip(3 * resolution, 96, 800))
        placed: Sequence[Camera] = dome(
            scene, cameras, whole=True, up=guess_up(scene), width=side, height=side
        )
    else:
        placed = cameras
    if not placed:
        raise ValueError("cameras must hold at least one camera")
    _libraries()  # fails early
    mesh = scene
    if isinstance(mesh, GaussianCloud):
        from meshsplats.conversion import convert

        # As wide as viewers draw splats: gaps between them would be holes in the surface.
        mesh = convert(mesh, cameras=placed, look="splats")
    grid = grid_around(scene, resolution)
    views = []

    def keep(camera: Camera, drawn: Rendering) -> None:
        views.append(View(camera, ViewImage(np.clip(drawn.color, 0, 1), drawn.alpha)))
        if progress is not None:
            progress()

    vertices, triangles = isosurface(signed_distances(mesh, placed, grid, threads=threads, each=keep), faces)
    low, voxel, _ = grid
    if not len(triangles):
        raise ValueError("the images show nothing solid: this makes bases of objects, not of haze")
    points = (low + voxel * vertices).astype(np.float32)
    colors = np.ones((len(points), 4), np.float32)
    colors[:, :3] = colors_from_views(_vertex_binding(points, triangles), views, threads=threads)
    return BaseMesh(points, triangles, colors, up=guess_up(scene), origin=scene.origin)


class Grid(NamedTuple):
    """A grid of points around a scene, in its frame and units."""

    low: np.ndarray
    """(3,) float64 the lowest corner."""
    voxel: float
    """Distance of neighbouring points."""
    shape: tuple[int, ...]
    """Number of points along each axis."""


def signed_distances(
    mesh: SplatMesh,
    cameras: Sequence[Camera],
    grid: Grid,
    *,
    behind: float = 1.0,
    threads: int | None = None,
    each: Callable[[Camera, Rendering], object] | None = None,
) -> np.ndarray:
    """(x, y, z) float32 truncated signed distances to the surface of ``mesh`` at the points of ``grid``.

    The unit is ``TRUNCATION`` voxels; positive outside. Points that no camera sees count as interior, and
    those on the border of the grid as exterior, so that the surface is closed. ``each`` is called with every
    camera and its image on black.

    ``behind`` is the weight of distances behind a surface. Points near a sheet without thickness are as far
    in front of it for some cameras as behind it for others: with 1 a sheet leaves noise, with less nothing.
    """
    total, weight = np.zeros(grid.shape, np.float32), np.zeros(grid.shape, np.float32)
    for camera in (camera.with_near_plane(mesh.vertices) for camera in cameras):
        drawn = render(mesh, camera, background=(0, 0, 0), depth=True, threads=threads)
        _integrate(total, weight, drawn.mean_depth(min_alpha=_SOLID), camera, grid, behind)
        if each is not None:
            each(camera, drawn)
    field = np.where(weight > 0, total / np.where(weight > 0, weight, 1), -1)
    for axis in range(3):
        sides = np.moveaxis(field, axis, 0)
        sides[0] = sides[-1] = 1
    return field


def isosurface(field: np.ndarray, faces: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The surface where ``field``, an (x, y, z) grid, is 0.

    The triangles face the positive side. Parts of the interior with less than ``MIN_PART`` of the volume of
    the largest part are removed. ``faces`` is the approximate maximum number of triangles; 0: no maximum.

    Returns:
        (n, 3) float64 vertices in grid steps, (m, 3) int32 triangles.
    """
    label, marching_cubes, simplify = _libraries()
    part = label(field < 0, connectivity=1)
    sizes = np.bincount(part.ravel())
    if len(sizes) == 1 or sizes[0] == 0:  # all exterior, or all interior
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    small = sizes < MIN_PART * sizes[1:].max()
    small[0] = False
    vertices, triangles, _, _ = marching_cubes(
        np.where(small[part], -field, field), 0.0, gradient_direction="descent", allow_degenerate=False
    )
    if 0 < faces < len(triangles):
        vertices, triangles = simplify(vertices, triangles, target_count=faces)
    return vertices.astype(np.float64), triangles.astype(np.int32)


def _libraries() -> tuple[Callable[..., Any], ...]:
    """scikit-image's label and marching_cubes, and simplify. MissingDependencyError names the extra."""
    try:
        from fast_simplification import simplify
        from skimage.measure import label, marching_cubes
    except ImportError as error:
        raise MissingDependencyError(
            "a base from splats needs the extra 'base': pip install scikit-image fast-simplification"
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


def _integrate(
    total: np.ndarray, weight: np.ndarray, depth: np.ndarray, camera: Camera, grid: Grid, behind: float
) -> None:
    """Adds the truncated distances of one (h, w) ``depth`` image to the grid, slab by slab."""
    low, voxel, _ = grid
    matrix = camera.world_to_camera
    y, z = np.meshgrid(*(low[k] + voxel * np.arange(total.shape[k]) for k in (1, 2)), indexing="ij")
    for i in range(total.shape[0]):
        x = low[0] + voxel * i
        place = [(matrix[k, 0] * x + matrix[k, 3]) + matrix[k, 1] * y + matrix[k, 2] * z for k in range(3)]
        front = place[2] > (camera.near or 0)
        away = np.where(front, place[2], 1)
        column = np.floor(camera.fx * place[0] / away + camera.cx)
        row = np.floor(camera.fy * place[1] / away + camera.cy)
        seen = front & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        at = np.where(seen, row, 0).astype(np.intp), np.where(seen, column, 0).astype(np.intp)
        distance = (depth[at] - place[2]) / (TRUNCATION * voxel)
        observed = seen & (distance >= -1)
        share = np.where(distance < 0, behind, 1)
        total[i] += np.where(observed, share * np.minimum(distance, 1), 0)
        weight[i] += observed * share


def _vertex_binding(points: np.ndarray, faces: np.ndarray) -> Binding:
    """Every vertex of a mesh bound to itself, in one of its faces."""
    face = np.zeros(len(points), np.int32)
    corner = np.zeros(len(points), np.intp)
    for k in range(3):
        face[faces[:, k]], corner[faces[:, k]] = np.arange(len(faces)), k
    # Duplicate assignments may mix entries of two faces: find the corner again in the final face.
    corner = (faces[face] == np.arange(len(points))[:, None]).argmax(axis=1)
    weights = np.eye(3, dtype=np.float32)[corner]
    return Binding(points, faces, face, weights, np.zeros(len(points), np.int32))
