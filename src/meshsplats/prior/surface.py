"""A base mesh from splats: the surface that depth pictures from all round agree on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

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
from meshsplats.rendering import render

MAX_RESOLUTION = 512
TRUNCATION = 3.0
"""Voxels before and behind a depth within which it says how far away the surface is."""
_SOLID = 0.5
"""Opacity above which a pixel shows the surface; less is empty space to the end of the ray."""
_COVERED = 0.002
"""Share of the opacity that may lie beyond each side of the box: strays must not make it large."""
_MARGIN = 0.05
_LEAST_PART = 0.01
"""Separate parts with a smaller share of the largest part's volume than this are left out."""


def base_surface(
    scene: GaussianCloud | SplatMesh,
    *,
    resolution: int = 96,
    faces: int = 20_000,
    cameras: Sequence[Camera] | int = 48,
    threads: int | None = None,
    progress: Callable[[], object] | None = None,
) -> BaseMesh:
    """A closed, coloured surface of ``scene``, an object: the base for a mesh prior where there is none.

    The scene is drawn from all round as a mesh, with depths. Each picture tells the voxels of a grid how far
    before or behind the surface they lie, up to ``TRUNCATION`` voxels, and the means make a signed distance
    (TSDF; Curless and Levoy 1996). What no picture sees is inside. The surface where it is 0 is found by
    marching cubes, and edges are collapsed where that changes its shape least (Garland and Heckbert 1997).
    Small separate parts are left out. Needs the extra ``base``.

    Args:
        scene: splats, which are converted for the purpose, or a mesh, fine-tuned say.
        resolution: voxels along the longest side of the box, 8 to 512: time and memory grow with its cube.
        faces: about so many triangles, at least 4, where the grid gives more; 0: all of them.
        cameras: to look from, with the whole object in their pictures; or a number to be placed all round.
        threads: at most this many; all processors by default.
        progress: called after each picture.

    Raises ValueError for options out of range, and where the pictures show nothing solid.
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
        raise ValueError("there are no cameras to look from")
    _libraries()  # before the work
    mesh = scene
    if isinstance(mesh, GaussianCloud):
        from meshsplats.conversion import convert

        # As wide as a viewer draws them: gaps between splats would be holes in the surface.
        mesh = convert(mesh, cameras=placed, look="splats")
    low, voxel, shape = _grid(scene, resolution)
    total, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    views = []
    for camera in placed:
        drawn = render(mesh, camera, background=(0, 0, 0), depth=True, threads=threads)
        _add(total, weight, drawn.mean_depth(min_alpha=_SOLID), camera, low, voxel)
        views.append(View(camera, ViewImage(np.clip(drawn.color, 0, 1), drawn.alpha)))
        if progress is not None:
            progress()
    field = np.where(weight > 0, total / np.where(weight > 0, weight, 1), -1)
    for axis in range(3):  # closed at the border
        sides = np.moveaxis(field, axis, 0)
        sides[0] = sides[-1] = 1
    vertices, triangles = isosurface(field, faces)
    if not len(triangles):
        raise ValueError("nothing solid is seen from all round: this makes bases of objects, not of haze")
    points = (low + voxel * vertices).astype(np.float32)
    colors = np.ones((len(points), 4), np.float32)
    colors[:, :3] = colors_from_views(_at_vertices(points, triangles), views, threads=threads)
    return BaseMesh(points, triangles, colors, up=guess_up(scene))


def isosurface(field: np.ndarray, faces: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) float64 vertices, in steps of the grid, and (m, 3) int32 triangles of the surface where
    ``field`` (x, y, z) passes 0, wound so that they face where it is positive; about ``faces`` of them where
    there would be more, unless that is 0.

    Parts of the inside with less than ``_LEAST_PART`` of the volume of the largest are left out.
    """
    label, marching_cubes, simplify = _libraries()
    part = label(field < 0, connectivity=1)
    sizes = np.bincount(part.ravel())
    if len(sizes) == 1 or sizes[0] == 0:  # all outside, or all inside
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    small = sizes < _LEAST_PART * sizes[1:].max()
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


def _grid(scene: GaussianCloud | SplatMesh, resolution: int) -> tuple[np.ndarray, float, tuple[int, ...]]:
    """Lowest corner, side of a voxel and number of grid points of the box round ``scene``."""
    bounds = scene_bounds(scene)
    if not len(bounds.points):
        raise ValueError("the scene is empty")
    weights = bounds.weights if bounds.weights.sum() > 0 else np.ones(len(bounds.points))
    sides = [
        [weighted_quantile(bounds.points[:, k], weights, share) for share in (_COVERED, 1 - _COVERED)]
        for k in range(3)
    ]
    low, high = np.array(sides, np.float64).T
    longest = float((high - low).max())
    if not longest > 0:
        raise ValueError("the scene has no extent")
    low, high = low - _MARGIN * longest, high + _MARGIN * longest
    voxel = float((high - low).max()) / resolution
    return low, voxel, tuple(int(n) for n in np.ceil((high - low) / voxel) + 1)


def _add(
    total: np.ndarray, weight: np.ndarray, depth: np.ndarray, camera: Camera, low: np.ndarray, voxel: float
) -> None:
    """Adds what the (h, w) ``depth`` of one picture says, slab by slab."""
    matrix = camera.world_to_camera
    y, z = np.meshgrid(*(low[k] + voxel * np.arange(total.shape[k]) for k in (1, 2)), indexing="ij")
    for i in range(total.shape[0]):
        x = low[0] + voxel * i
        place = [(matrix[k, 0] * x + matrix[k, 3]) + matrix[k, 1] * y + matrix[k, 2] * z for k in range(3)]
        front = place[2] > camera.near
        away = np.where(front, place[2], 1)
        column = np.floor(camera.fx * place[0] / away + camera.cx)
        row = np.floor(camera.fy * place[1] / away + camera.cy)
        seen = front & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        at = np.where(seen, row, 0).astype(np.intp), np.where(seen, column, 0).astype(np.intp)
        distance = (depth[at] - place[2]) / (TRUNCATION * voxel)
        told = seen & (distance >= -1)
        total[i] += np.where(told, np.minimum(distance, 1), 0)
        weight[i] += told


def _at_vertices(points: np.ndarray, faces: np.ndarray) -> Binding:
    """Every vertex of a mesh bound to itself, in a face that has it."""
    face = np.zeros(len(points), np.int32)
    corner = np.zeros(len(points), np.intp)
    for k in range(3):
        face[faces[:, k]], corner[faces[:, k]] = np.arange(len(faces)), k
    # A vertex' last entry may mix corners of two faces: look again which corner it is in its face.
    corner = (faces[face] == np.arange(len(points))[:, None]).argmax(axis=1)
    weights = np.eye(3, dtype=np.float32)[corner]
    return Binding(points, faces, face, weights, np.zeros(len(points), np.int32))
