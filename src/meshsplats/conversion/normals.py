"""Shading normals of splat meshes: smooth, and pointing outwards.

The layers of a splat mesh are tilted at random, and crossed ones stand upright on the surface; lit by their
own normals they look mottled. Here each splat takes the normal of the surface that it and its neighbours
form: their centres lie in it, and the largest of their discs lie along it. The outer side is the one from
which cameras around the scene see the splat; of a sheet that is seen from both sides, such as a street, the
upper one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from meshsplats._arrays import subsample
from meshsplats._geometry import spacing
from meshsplats.camera import Camera
from meshsplats.cameras.framing import guess_up, scene_bounds
from meshsplats.cameras.trajectories import dome
from meshsplats.mesh import SplatMesh
from meshsplats.rendering import render

CELL = 2.5
"""Side of the cells in which neighbours are sought, in spacings: measured on splats of a known surface,
clean and noisy, where 2 to 3 give the least error (see docs/blender.md)."""
VIEWS = 24
_SIDE = 160
"""Side in pixels of the images that decide visibility."""
_BOTH = 0.15
"""A splat is part of a sheet if its side that is seen less is seen this often, against the other one. Cameras
below the scene then do not count: they see a street as a whole, those above it between houses only."""
_SOLID = 0.3
"""Opacity from which a pixel counts as covered."""
_CHUNK = 1 << 16


def shading_normals(
    mesh: SplatMesh, cameras: Sequence[Camera] = (), *, views: int = VIEWS, threads: int | None = None
) -> np.ndarray:
    """(v, 3) float32 unit normals of the surface that the splats of ``mesh`` form, pointing outwards.

    All vertices of a splat share one. A mesh with normals keeps them. Without ``face_splat``, each triangle
    counts as a splat, and a vertex takes the mean of its triangles. ``cameras`` see the scene, besides
    ``views`` around it: a room is visible from inside only.
    """
    if mesh.normals is not None:
        return mesh.normals
    if len(mesh.faces) == 0:
        return np.zeros_like(mesh.vertices)
    centers, weights, spread = _splats(mesh)
    cell = CELL * typical_spacing(mesh, centers)
    around = _Neighbours(centers, cell)
    tensors = np.stack([spread[:, i, j] for i, j in _PAIRS], axis=1)
    normals = np.empty((len(centers), 3))
    moments = np.column_stack(
        [weights, weights[:, None] * centers, weights[:, None] * _products(centers), tensors]
    )
    for part, total in around.sums(moments, 1.0):
        weight = np.maximum(total[:, :1], 1e-300)
        mean = total[:, 1:4] / weight
        scatter = _symmetric(total[:, 4:10] / weight - _products(mean))
        size = np.trace(scatter, axis1=1, axis2=2)[:, None, None]
        discs = _symmetric(total[:, 10:16] / weight)
        # Both have trace 1: along the normal the discs' tensor is large, the scatter of the centres small.
        both = discs - np.divide(scatter, size, out=np.zeros_like(scatter), where=size > 0)
        normals[part] = np.linalg.eigh(both)[1][:, :, 2]
    side = _seen_side(mesh, centers, normals, cell, cameras, views, threads)
    normals *= np.where(side < 0, -1.0, 1.0)[:, None]
    # Splats that no camera sees have no weight here and take the side of their neighbours.
    trust = np.where(side == 0, 1e-3, 1.0) * weights
    smooth = np.empty_like(normals)
    for part, total in around.sums(trust[:, None] * normals, 0.7):
        smooth[part] = total
    flipped = np.einsum("ij,ij->i", normals, smooth) < 0
    smooth[flipped & (side != 0)] *= -1
    return _to_vertices(mesh, mesh.splats.of_face, unit(smooth, normals))


def typical_spacing(mesh: SplatMesh, centers: np.ndarray | None = None) -> float:
    """Median spacing of the splats of ``mesh``, scene units, > 0."""
    if centers is None:
        centers = _splats(mesh)[0]
    median = float(np.median(spacing(centers.astype(np.float32)))) if len(centers) else 0.0
    return median if median > 0 else max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-6) / 100


_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _products(vectors: np.ndarray) -> np.ndarray:
    """(n, 6) products of the components of (n, 3) vectors."""
    return np.stack([vectors[:, i] * vectors[:, j] for i, j in _PAIRS], axis=1)


def _symmetric(six: np.ndarray) -> np.ndarray:
    """(n, 3, 3) symmetric matrices from their six components."""
    full = np.empty((len(six), 3, 3))
    for k, (i, j) in enumerate(_PAIRS):
        full[:, i, j] = full[:, j, i] = six[:, k]
    return full


def unit(vectors: np.ndarray, instead: np.ndarray) -> np.ndarray:
    """(..., 3) ``vectors`` with length 1; ``instead``, which broadcasts, for those without length."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), instead)


def _splats(mesh: SplatMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the n splats: centres (n, 3), weights (n,), area times opacity, and (n, 3, 3) sums of weight times
    normal times normal over their triangles."""
    splats = mesh.splats
    weights = np.empty(len(splats))
    centers = np.empty((len(splats), 3))
    spread = np.empty((len(splats), 3, 3))
    for begin in range(0, len(splats), _CHUNK):
        some = slice(begin, begin + _CHUNK)
        part = splats.part(some)
        corners = mesh.vertices[part.faces].astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double = np.linalg.norm(cross, axis=1)
        weight = 0.5 * double * mesh.colors[part.faces, 3].mean(axis=1) + 1e-300  # nothing divides by zero
        normal = cross / np.maximum(double, 1e-300)[:, None]
        weights[some] = part.sums(weight)
        centroids = part.sums(weight[:, None] * corners.mean(axis=1))
        centers[some] = centroids / weights[some, None]
        products = normal[:, :, None] * normal[:, None, :]
        spread[some] = part.sums(weight[:, None, None] * products)
    return centers, weights / weights.max(), spread / weights.max()


class _Neighbours:
    """Points (n, 3) sorted into cubic cells; sums over the 27 cells around each of them."""

    def __init__(self, points: np.ndarray, side: float) -> None:
        self.points, self.side = points, side
        low = points.min(axis=0)
        # Distant strays must not overflow the cell indices.
        steps = np.minimum((points - low) / side, 2**20 - 4).astype(np.int64) + 1
        self.keys = (steps[:, 0] << 42) | (steps[:, 1] << 21) | steps[:, 2]
        self.cells, self.cell_of = np.unique(self.keys, return_inverse=True)
        self.cell_of = self.cell_of.reshape(-1)

    def sums(self, values: np.ndarray, width: float) -> Iterator[tuple[slice, np.ndarray]]:
        """Yields slices of points and (c, k) sums of ``values`` (n, k), weighted by a Gaussian of the
        distance to each cell's centre with standard deviation ``width`` cells."""
        count = len(self.cells)
        totals = [np.bincount(self.cell_of, values[:, k], count) for k in range(values.shape[1])]
        cell_values = np.stack(totals, axis=1)
        sizes = np.bincount(self.cell_of, minlength=count)
        middles = [np.bincount(self.cell_of, self.points[:, k], count) / sizes for k in range(3)]
        middle = np.stack(middles, axis=1)
        steps = [(x << 42) + (y << 21) + z for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
        for begin in range(0, len(self.points), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            points, keys = self.points[part], self.keys[part]
            total = np.zeros((len(points), values.shape[1]))
            for step in steps:
                found = np.minimum(np.searchsorted(self.cells, keys + step), count - 1)
                there = self.cells[found] == keys + step
                near, row = found[there], np.flatnonzero(there)
                square = np.square(middle[near] - points[row]).sum(axis=1)
                share = np.exp(-square / (2 * (width * self.side) ** 2))
                total[row] += share[:, None] * cell_values[near]
            yield part, total


def views_around(
    mesh: SplatMesh, count: int, side: int, cameras: Sequence[Camera] = (), most: int = 1
) -> list[Camera]:
    """``count`` square cameras all around ``mesh``, and ``most`` of ``cameras`` at most, evenly chosen; their
    images have at most ``side`` pixels a side."""
    views = dome(mesh, count, whole=True, up=guess_up(mesh), width=side, height=side)
    return views + [camera.within(side) for camera in subsample(cameras or (), most)]


def _seen_side(
    mesh: SplatMesh,
    centers: np.ndarray,
    normals: np.ndarray,
    tolerance: float,
    cameras: Sequence[Camera],
    views: int,
    threads: int | None,
) -> np.ndarray:
    """(n,) positive where the cameras that see a centre are on the side of its normal, negative on the other
    one; 0 where none sees it."""
    front, back, upper = np.zeros((3, len(centers)))
    up, middle = guess_up(mesh), scene_bounds(mesh).center
    for i, camera in enumerate(views_around(mesh, views, _SIDE, cameras, 16)):
        surface = render(mesh, camera, depth=True, threads=threads).mean_depth(min_alpha=_SOLID)
        shown, column, row, z = camera.pixels_of(centers)
        visible = shown[z < surface[row, column] + tolerance]
        away = camera.center - centers[visible]
        side = np.einsum("ij,ij->i", normals[visible], away) / np.linalg.norm(away, axis=1)
        front[visible] += np.maximum(side, 0)
        back[visible] += np.maximum(-side, 0)
        if i >= views or (camera.center - middle) @ up > 0:
            upper[visible] += side
    sheet = (np.minimum(front, back) > _BOTH * np.maximum(front, back)) & (upper != 0)
    return np.where(sheet, upper, front - back)


def _to_vertices(mesh: SplatMesh, owner: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(v, 3) float32 means of the normals of the splats that use each vertex; vertices without one: up."""
    sums = np.zeros((len(mesh.vertices), 3))
    for corner in range(3):
        for axis in range(3):
            sums[:, axis] += np.bincount(mesh.faces[:, corner], normals[owner, axis], len(sums))
    return unit(sums, np.broadcast_to(mesh.up.astype(np.float64), sums.shape)).astype(np.float32)
