"""Shading normals of splat meshes: smooth, and pointing outwards.

The layers of a splat mesh are tilted at random, and crossed ones stand upright on the surface; lit by their
own normals they look mottled. Here each splat takes the normal of the surface that it and its neighbours
form: their centres lie in it, and the largest of their discs lie along it. The outer side is the one from
which cameras around the scene see the splat; of a sheet that is seen from both sides, such as a street, the
upper one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.geometry import spacing
from meshsplats._core.cells import sums_around
from meshsplats.cameras.framing import guess_up, scene_bounds
from meshsplats.cameras.trajectories import dome
from meshsplats.rendering import Rendering, render
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh

CELL = 2.5
"""Side of the cells in which neighbours are sought, in spacings: measured on splats of a known surface,
clean and noisy, where 2 to 3 give the least error (see docs/blender.md)."""
VIEWS, GIVEN = 24, 16
"""Views around a scene by which is decided what is outside, and of given cameras at most."""
_SIDE = 160
"""Side in pixels of their images."""
_BOTH = 0.15
"""A splat is part of a sheet if its side that is seen less is seen this often, against the other one. Cameras
below the scene then do not count: they see a street as a whole, those above it between houses only."""
_SOLID = 0.3
"""Opacity from which a pixel counts as covered."""
_CHUNK = 1 << 16


class Surfels(NamedTuple):
    """The splats of a mesh as pieces of a surface, n of them; each triangle is one without ``face_splat``."""

    centers: np.ndarray
    """(n, 3) float64"""
    weights: np.ndarray
    """(n,) float64 area times opacity, relative to the largest."""
    spread: np.ndarray
    """(n, 6) float64 sums of weight times normal times normal over their triangles: the components ``_PAIRS``
    of symmetric matrices."""


def shading_normals(
    mesh: SplatMesh,
    cameras: Sequence[Camera] = (),
    *,
    views: int = VIEWS,
    surfels: Surfels | None = None,
    depth_images: Iterable[DepthImage] | None = None,
    threads: int | None = None,
) -> np.ndarray:
    """(v, 3) float32 unit normals of the surface that the splats of ``mesh`` form, pointing outwards.

    All vertices of a splat share one. A mesh with normals keeps them. Without ``face_splat``, each triangle
    counts as a splat, and a vertex takes the mean of its triangles. ``cameras`` see the scene, besides
    ``views`` around it: a room is visible from inside only. ``surfels`` and
    ``depth_images``: those of the mesh, where they are known.
    """
    if mesh.normals is not None:
        return mesh.normals
    if len(mesh.faces) == 0:
        return np.zeros_like(mesh.vertices)
    centers, weights, spread = surfels_of(mesh) if surfels is None else surfels
    cell = CELL * typical_spacing(mesh, centers)
    around = _Neighbours(centers, cell, threads)
    normals = np.empty((len(centers), 3))
    moments = np.column_stack(
        [weights, weights[:, None] * centers, weights[:, None] * _products(centers), spread]
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
    if depth_images is None:
        depth_images = _depth_images(mesh, views, cameras, threads)
    side = _seen_side(mesh, centers, normals, cell, depth_images)
    normals *= np.where(side < 0, -1.0, 1.0)[:, None]
    # Splats that no camera sees have no weight here and take the side of their neighbours.
    trust = np.where(side == 0, 1e-3, 1.0) * weights
    smooth = np.empty_like(normals)
    for part, total in around.sums(trust[:, None] * normals, 0.7):
        smooth[part] = total
    flipped = np.einsum("ij,ij->i", normals, smooth) < 0
    smooth[flipped & (side != 0)] *= -1
    return _to_vertices(mesh, mesh.splats.of_face, unit(smooth, normals))


def typical_spacing(mesh: SplatMesh, centers: np.ndarray) -> float:
    """Median spacing of the splats of ``mesh`` with these ``centers`` (n, 3), scene units, > 0."""
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


def surfels_of(mesh: SplatMesh) -> Surfels:
    """Those of a ``mesh`` with triangles."""
    splats = mesh.splats
    count = len(splats)
    weights, centers, spread = np.empty(count), np.empty((count, 3)), np.empty((count, 6))
    columns = mesh.vertices.T.astype(np.float64)  # gathered and summed far faster than rows
    for begin in range(0, count, _CHUNK):
        some = slice(begin, begin + _CHUNK)
        part = splats.part(some)
        a, b, c = columns[:, part.faces.T].transpose(1, 0, 2)
        cross = np.cross(b - a, c - a, axis=0)
        double = np.linalg.norm(cross, axis=0)
        weight = 0.5 * double * mesh.colors[part.faces, 3].mean(axis=1) + 1e-300  # nothing divides by zero
        normal = cross / np.maximum(double, 1e-300)
        weights[some] = part.sums(weight)
        for axis, middle in enumerate((a + b + c) / 3):
            centers[some, axis] = part.sums(weight * middle) / weights[some]
        for k, (i, j) in enumerate(_PAIRS):
            spread[some, k] = part.sums(weight * normal[i] * normal[j])
    return Surfels(centers, weights / weights.max(), spread / weights.max())


class _Neighbours:
    """Points (n, 3) sorted into cubic cells; sums over the 27 cells around each of them."""

    def __init__(self, points: np.ndarray, side: float, threads: int | None = None) -> None:
        self._points, self._side, self._threads = points, side, threads
        # Distant strays, which would overflow the cell indices, are in the outermost cells.
        low = np.maximum(points.min(axis=0), np.median(points, axis=0) - 2**19 * side)
        x, y, z = np.clip((points - low) / side, 0, 2**20 - 4).astype(np.int64).T + 1
        keys, cell_of = np.unique((x << 42) | (y << 21) | z, return_inverse=True)
        self._cell_of = cell_of.reshape(-1).astype(np.int32)
        self._count = len(keys)
        span = (-1, 0, 1)
        steps = [(x << 42) + (y << 21) + z for x in span for y in span for z in span]
        self._beside = np.empty((len(keys), len(steps)), np.int32)
        for k, step in enumerate(steps):
            found = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
            self._beside[:, k] = np.where(keys[found] == keys + step, found, -1)
        sizes = np.bincount(self._cell_of, minlength=len(keys))
        self._middles = self._cell_sums(points) / sizes[:, None]

    def _cell_sums(self, values: np.ndarray) -> np.ndarray:
        sums = np.empty((self._count, values.shape[1]))
        for k, column in enumerate(values.T):
            sums[:, k] = np.bincount(self._cell_of, column, self._count)
        return sums

    def sums(self, values: np.ndarray, width: float) -> Iterator[tuple[slice, np.ndarray]]:
        """Yields slices of points and (c, k) sums of ``values`` (n, k), weighted by a Gaussian of the
        distance to each cell's centre with standard deviation ``width`` cells."""
        totals = self._cell_sums(values)
        for begin in range(0, len(self._points), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            yield (
                part,
                sums_around(
                    self._points[part],
                    self._cell_of[part],
                    self._beside,
                    self._middles,
                    totals,
                    deviation=width * self._side,
                    threads=self._threads,
                ),
            )


class DepthImage(NamedTuple):
    """What a camera sees of a mesh."""

    camera: Camera
    depth: np.ndarray
    """(h, w) float32, infinite where nothing is solid."""
    is_around: bool
    """Whether it is one of the cameras around the scene, which may look at it from below."""


def depth_image_of(camera: Camera, image: Rendering, is_around: bool) -> DepthImage:
    """By an ``image`` with depth."""
    return DepthImage(camera, image.mean_depth(min_alpha=_SOLID), is_around)


def views_around(mesh: SplatMesh, count: int, side: int, cameras: Sequence[Camera] = ()) -> list[Camera]:
    """``count`` square cameras all around ``mesh``, and ``GIVEN`` of ``cameras`` at most, evenly chosen;
    their images have at most ``side`` pixels a side."""
    views = dome(mesh, count, whole=True, up=guess_up(mesh), width=side, height=side)
    return views + [camera.within(side) for camera in subsample(cameras or (), GIVEN)]


def _depth_images(
    mesh: SplatMesh, views: int, cameras: Sequence[Camera], threads: int | None
) -> Iterator[DepthImage]:
    for i, camera in enumerate(views_around(mesh, views, _SIDE, cameras)):
        yield depth_image_of(camera, render(mesh, camera, depth=True, threads=threads), i < views)


def _seen_side(
    mesh: SplatMesh,
    centers: np.ndarray,
    normals: np.ndarray,
    tolerance: float,
    depth_images: Iterable[DepthImage],
) -> np.ndarray:
    """(n,) positive where the cameras that see a centre are on the side of its normal, negative on the other
    one; 0 where none sees it."""
    front, back, upper = np.zeros((3, len(centers)))
    up, middle = guess_up(mesh), scene_bounds(mesh).center
    for camera, depth, is_around in depth_images:
        shown, column, row, z = camera.pixels_of(centers)
        visible = shown[z < depth[row, column] + tolerance]
        away = camera.center - centers[visible]
        side = np.einsum("ij,ij->i", normals[visible], away) / np.linalg.norm(away, axis=1)
        front[visible] += np.maximum(side, 0)
        back[visible] += np.maximum(-side, 0)
        if not is_around or (camera.center - middle) @ up > 0:
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
