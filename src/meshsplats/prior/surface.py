"""A base mesh from splats: the surface that depth pictures from all round agree on."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from meshsplats.base_mesh import BaseMesh
from meshsplats.binding import Binding
from meshsplats.camera import Camera, dome
from meshsplats.dataset import Picture, View
from meshsplats.framing import guess_up, scene_bounds, weighted_quantile
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.prior.photographs import colors_from_views
from meshsplats.rendering import render

MAX_RESOLUTION = 512
TRUNCATION = 3.0
"""Voxels before and behind a depth within which it says how far away the surface is."""
_SOLID = 0.5
"""Opacity from which a pixel shows the surface; less is empty space to the end of the ray."""
_COVERED = 0.002
"""Share of the opacity that may lie beyond each side of the box: strays must not make it large."""
_MARGIN = 0.05
_LEAST_PART = 0.01
"""Separate parts with a smaller share of the largest part's triangles than this are left out."""


def base_surface(
    scene: GaussianCloud | SplatMesh,
    *,
    resolution: int = 96,
    cameras: Sequence[Camera] | int = 48,
    threads: int | None = None,
    progress: Callable[[], object] | None = None,
) -> BaseMesh:
    """A closed, coloured surface of ``scene``, an object: the base for a mesh prior where there is none.

    The scene is drawn from all round as a mesh, with depths. Each picture tells the voxels of a grid how far
    before or behind the surface they lie, up to ``TRUNCATION`` voxels, and the means make a signed distance
    (TSDF; Curless and Levoy 1996). What no picture sees is inside. The surface where it is 0 is found by
    surface nets (Gibson 1998): a vertex in each voxel that it passes, at the mean of its crossings with the
    voxel's edges. Small separate parts are left out.

    Args:
        scene: splats, which are converted for the purpose, or a mesh, fine-tuned say.
        resolution: voxels along the longest side of the box, 8 to 512: time and memory grow with its cube,
            triangles with its square.
        cameras: to look from, with the whole object in their pictures; or a number to be placed all round.
        threads: at most this many; all processors by default.
        progress: called after each picture.

    Raises ValueError for options out of range, and where the pictures show nothing solid.
    """
    if not 8 <= resolution <= MAX_RESOLUTION:
        raise ValueError(f"resolution must be 8 to {MAX_RESOLUTION} voxels, got {resolution}")
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
    mesh = scene
    if isinstance(mesh, GaussianCloud):
        from meshsplats.conversion import convert

        mesh = convert(mesh, cameras=placed)
    low, voxel, shape = _grid(scene, resolution)
    total, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    views = []
    for camera in placed:
        drawn = render(mesh, camera, background=(0, 0, 0), depth=True, threads=threads)
        assert drawn.depth is not None
        solid = drawn.alpha >= _SOLID
        depth = np.where(solid, drawn.depth / np.where(solid, drawn.alpha, 1), np.inf)
        _add(total, weight, depth, camera, low, voxel)
        views.append(View(camera, Picture(np.clip(drawn.color, 0, 1), drawn.alpha)))
        if progress is not None:
            progress()
    field = np.where(weight > 0, total / np.where(weight > 0, weight, 1), -1)
    for axis in range(3):  # closed at the border
        sides = np.moveaxis(field, axis, 0)
        sides[0] = sides[-1] = 1
    vertices, faces = surface_net(field)
    vertices, faces = _large_parts(vertices, faces)
    if not len(faces):
        raise ValueError("nothing solid is seen from all round: this makes bases of objects, not of haze")
    points = (low + voxel * vertices).astype(np.float32)
    colors = np.ones((len(points), 4), np.float32)
    colors[:, :3] = colors_from_views(_at_vertices(points, faces), views, threads=threads)
    return BaseMesh(points, faces, colors, up=guess_up(scene))


def surface_net(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) float64 vertices, in steps of the grid, and (m, 3) int32 triangles of the surface where
    ``field`` (x, y, z) passes 0, wound so that they face where it is positive."""
    inside = field < 0
    bits = [(i >> 2 & 1, i >> 1 & 1, i & 1) for i in range(8)]
    counts = np.zeros(tuple(s - 1 for s in field.shape), np.int8)
    for bit in bits:
        counts += _corner(inside, bit)
    active = (counts > 0) & (counts < 8)
    cells = np.argwhere(active)
    number = np.full(active.shape, -1, np.int32)
    number[active] = np.arange(len(cells), dtype=np.int32)
    values = np.stack([_corner(field, bit)[active] for bit in bits], axis=1).astype(np.float64)
    sums, crossings = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for i in range(8):
        for axis in range(3):
            j = i | (4 >> axis)
            if i == j:
                continue
            a, b = values[:, i], values[:, j]
            crossed = (a < 0) != (b < 0)
            share = np.where(crossed, a / np.where(crossed, a - b, 1), 0)
            place = np.tile(np.array(bits[i], np.float64), (len(cells), 1))
            place[:, axis] = share
            sums += np.where(crossed[:, None], place, 0)
            crossings += crossed
    vertices = cells + sums / np.maximum(crossings, 1)[:, None]
    faces = [np.empty((0, 3), np.int32)]
    for axis in range(3):
        before = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        after = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        edges = np.argwhere(inside[before] != inside[after])
        others = [(axis + 1) % 3, (axis + 2) % 3]
        # An edge on the border of the grid has no four voxels round it.
        deep = [(edges[:, k] > 0) & (edges[:, k] < field.shape[k] - 1) for k in others]
        edges = edges[deep[0] & deep[1]]
        quad = []
        for first, second in ((1, 1), (0, 1), (0, 0), (1, 0)):
            cell = edges.copy()
            cell[:, others[0]] -= first
            cell[:, others[1]] -= second
            quad.append(number[tuple(cell.T)])
        leaving = inside[tuple(edges.T)]
        a, b, c, d = (np.where(leaving, quad[i], quad[j]) for i, j in ((0, 0), (1, 3), (2, 2), (3, 1)))
        faces += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    return vertices, np.concatenate(faces)


def _corner(grid: np.ndarray, bit: tuple[int, int, int]) -> np.ndarray:
    """The values at one corner of every voxel."""
    return grid[tuple(slice(1, None) if b else slice(None, -1) for b in bit)]


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


def _large_parts(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Without separate parts that are small beside the largest, and without vertices of no triangle."""
    if not len(faces):
        return vertices, faces
    part = np.arange(len(vertices))
    while True:  # each vertex takes the smallest number round it, until nothing changes
        least = part[faces].min(axis=1)
        found = part.copy()
        for k in range(3):
            np.minimum.at(found, faces[:, k], least)
        found = found[found]
        if (found == part).all():
            break
        part = found
    sizes = np.bincount(part[faces[:, 0]], minlength=len(vertices))
    faces = faces[sizes[part[faces[:, 0]]] >= max(_LEAST_PART * sizes.max(), 1)]
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True
    renumber = np.cumsum(used, dtype=np.int32) - 1
    return vertices[used], renumber[faces]


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
