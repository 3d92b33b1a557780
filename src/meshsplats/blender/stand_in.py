"""A clean surface in place of the splats, for light: it casts shadows, occludes and reflects bounced light.

Translucent layers that shade each other receive light arbitrarily. The surface is the one that ``meshsplats
base`` makes, from depth images of the same mesh, with one vertex for each voxel that it crosses (surface
nets; Gibson 1998). Each splat takes the light at its foot, the nearest point of the surface. Splats that the
surface lacks, such as hair, leaves and wires, keep their own places and cast their own shadows; floaters cast
none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from meshsplats._common.cells import Cells
from meshsplats._common.geometry import vertex_normals
from meshsplats._core.cells import VertexGrid, nearest_vertices
from meshsplats._core.surfaces import Grid
from meshsplats.blender.options import CAREFUL
from meshsplats.conversion.cleaning import find
from meshsplats.conversion.normals import DepthImage, depth_image_of, typical_spacing, unit, views_around
from meshsplats.rendering import Rendering
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh
from meshsplats.surfaces.fusion import MIN_PART, grid_around, signed_distances

SIDE = 3
"""Side in pixels of the depth images, in voxels of the longest side."""
_BEHIND = 0.7
"""Weight of distances behind a surface: sheets without thickness count as thin parts."""
_NEAR = 2
"""Distance in voxels, along each axis, within which a splat has its foot on the surface."""
_COARSE, _FAR = 4, 4
"""Inside the object, feet are sought in blocks of this many voxels, up to that many blocks away."""
_LARGE = 2.0
"""Reach of a splat, in voxels, from which each of its vertices has a foot of its own."""
_SOLID = 0.25
"""Opacity from which a splat that the surface lacks casts a shadow."""
_BELOW, _HIDDEN = 0.5, 1e-3
"""Splats that lie deeper below the surface than this, in voxels, have this weight in its colours."""
_FILLS = 4
"""Edges across which colours spread to vertices without splats."""
_SIDES = 1e4
"""Weight of a squared distance to a point of the surface that faces the other way: such a point counts where
no other one is near. A street may be a slab of two voxels."""


@dataclass(frozen=True, eq=False)
class StandIn:
    """The surface, and the points at which the light on the splats is gathered."""

    vertices: np.ndarray
    """(w, 3) float32, frame of the splats."""
    faces: np.ndarray
    """(g, 3) int32, facing out."""
    feet: np.ndarray
    """(v,) int64 for each vertex of the splat mesh the one of ``vertices`` that is nearest to its splat."""
    weights: np.ndarray
    """(v,) float64 what its colour counts there, beside its opacity."""
    fine: np.ndarray
    """(f,) bool: faces of the splat mesh that cast shadows of their own, as the surface lacks them."""
    points: np.ndarray
    """(n, 3) float32 places where light is gathered, a little above the surface."""
    normals: np.ndarray
    """(n, 3) float32 unit normals there."""
    point_of: np.ndarray
    """(v,) int32 index of the point whose light each vertex of the splat mesh takes."""
    size: float
    """Distance of neighbouring points, scene units."""

    def colors(self, colors: np.ndarray) -> np.ndarray:
        """(w, 3) float32 colours of the surface: means of the ``colors`` (v, 4), RGBA in linear light, of
        what has its foot near each of its vertices, by opacity."""
        weight = colors[:, 3].astype(np.float64) * self.weights
        count = len(self.vertices)
        columns = [np.bincount(self.feet, weight * colors[:, k], count) for k in range(3)]
        total = np.stack([*columns, np.bincount(self.feet, weight, count)], axis=1)
        mean = total.sum(axis=0)
        fallback = mean[:3] / mean[3] if mean[3] > 0 else np.full(3, 0.5)
        # A vertex without splats, or with hidden ones only, takes the colour of those beside it.
        typical = float(np.median(total[total[:, 3] > 0, 3])) if mean[3] > 0 else 1.0
        for _ in range(_FILLS):
            beside = np.zeros_like(total)
            for corner in range(3):
                for k in range(4):
                    beside[:, k] += np.bincount(
                        self.faces[:, corner], total[self.faces[:, corner - 1], k], count
                    )
            total += beside * (0.05 * typical / np.maximum(beside[:, 3:] + total[:, 3:], 1e-300))
        held = total[:, 3:]
        return np.where(held > 0, total[:, :3] / np.maximum(held, 1e-300), fallback).astype(np.float32)


class DistanceField(NamedTuple):
    """Distances to the surface that the splats form, and the images that they come from."""

    grid: Grid
    distances: np.ndarray
    """(x, y, z) float32, as of ``signed_distances``."""
    depth_images: list[DepthImage]


def field_around(
    mesh: SplatMesh,
    cameras: Sequence[Camera] = (),
    *,
    resolution: int = CAREFUL.resolution,
    views: int = CAREFUL.views,
    threads: int | None = None,
) -> DistanceField | None:
    """That of ``mesh``; None without extent.

    Args:
        cameras: they see the scene, besides those around it: a room is visible from inside only.
        resolution: voxels along the longest side.
        views: depth images from around the scene.
    """
    try:
        grid = grid_around(mesh, resolution)
    except ValueError:
        return None
    placed = views_around(mesh, views, SIDE * resolution, cameras)
    depth_images: list[DepthImage] = []

    def keep(camera: Camera, image: Rendering) -> None:
        depth_images.append(depth_image_of(camera, image, len(depth_images) < views))

    distances = signed_distances(mesh, placed, grid, behind=_BEHIND, threads=threads, each=keep)
    return DistanceField(grid, distances, depth_images)


def stand_in(
    mesh: SplatMesh, normals: np.ndarray, around: DistanceField, threads: int | None = None
) -> StandIn | None:
    """The stand-in of ``mesh`` with the unit shading ``normals`` (v, 3); None where its images show nothing
    solid."""
    grid, field = around.grid, around.distances
    vertices, faces, cells = surface_net(field)
    if not len(faces):
        return None
    surface = (grid.low + grid.voxel * vertices).astype(np.float32)
    outward = _smooth(vertex_normals(surface, faces), faces)
    feet = _Feet(grid, field, surface, outward, cells, threads)
    splats = _Splats(mesh, normals)
    foot, found = feet.of(splats.centers, splats.normals)
    above = np.einsum("ij,ij->i", splats.centers - surface[foot], outward[foot]) > -_BELOW * grid.voxel
    weights = np.where(found & above, 1.0, _HIDDEN)
    fine = splats.opacity > _SOLID
    fine &= ~found
    if fine.any():
        try:
            fine &= find(mesh).kept
        except ValueError:  # nothing but floaters
            fine[:] = False
    place = np.where(found[:, None], feet.projected(splats.centers, foot), splats.centers)
    normal = np.where(found[:, None], feet.facing(foot, splats.normals), splats.normals)
    place_of, normal_of = place[splats.of_vertex], normal[splats.of_vertex]
    large = np.flatnonzero((splats.reach > _LARGE * grid.voxel)[splats.of_vertex])
    if len(large):
        own, there = feet.of(mesh.vertices[large].astype(np.float64), normals[large])
        there &= found[splats.of_vertex[large]]
        rows = large[there]
        place_of[rows] = feet.projected(mesh.vertices[rows].astype(np.float64), own[there])
        normal_of[rows] = feet.facing(own[there], normals[rows])
    # A point for each cell of half a voxel, or of the splats' own spacing where they are farther apart.
    size = max(grid.voxel / 2, min(grid.voxel, typical_spacing(mesh, splats.centers)))
    points, ways, point_of = _clustered(place_of, normal_of, size)
    return StandIn(
        surface,
        faces,
        foot[splats.of_vertex],
        weights[splats.of_vertex],
        fine[splats.of_face],
        (points + 0.1 * grid.voxel * ways).astype(np.float32),
        ways.astype(np.float32),
        point_of,
        size,
    )


def surface_net(field: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface where ``field``, an (x, y, z) grid with a positive border, is 0: surface nets.

    Parts with less than ``MIN_PART`` of the volume of the largest, and cavities, are removed.

    Returns:
        (n, 3) float64 vertices in grid steps, one for each cell with corners of both signs; (m, 3) int32
        triangles that face the positive side; (n, 3) int64 the cell of each vertex.
    """
    inside = field < 0
    counts = np.zeros(tuple(n - 1 for n in field.shape), np.int8)
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    for x, y, z in corners:
        counts += inside[x : x + counts.shape[0], y : y + counts.shape[1], z : z + counts.shape[2]]
    cells = np.argwhere((counts > 0) & (counts < 8))
    if not len(cells):
        return np.empty((0, 3)), np.empty((0, 3), np.int32), cells
    values = np.stack([field[tuple((cells + corner).T)] for corner in corners], axis=1).astype(np.float64)
    offset, crossings = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a, start in enumerate(corners):
        for b, end in enumerate(corners):
            if b <= a or sum(p != q for p, q in zip(start, end, strict=True)) != 1:
                continue
            crossed = (values[:, a] < 0) != (values[:, b] < 0)
            share = np.where(crossed, values[:, a] / np.where(crossed, values[:, a] - values[:, b], 1), 0)
            step = np.array(start) + share[:, None] * (np.array(end) - np.array(start))
            offset += crossed[:, None] * step
            crossings += crossed
    vertices = cells + offset / crossings[:, None]
    index = np.full(counts.shape, -1, np.int32)
    index[tuple(cells.T)] = np.arange(len(cells), dtype=np.int32)
    quads = []
    for axis in range(3):
        along = np.moveaxis(inside, axis, 0)
        ids = np.moveaxis(index, axis, 0)
        at = np.argwhere(along[1:] != along[:-1])
        i, j, k = at[((at[:, 1:] > 0) & (at[:, 1:] < np.array(along.shape[1:]) - 1)).all(axis=1)].T
        ring = np.stack([ids[i, j - 1, k - 1], ids[i, j, k - 1], ids[i, j, k], ids[i, j - 1, k]], axis=1)
        # moveaxis of the middle axis swaps the handedness of the other two.
        forward = along[i, j, k] != (axis == 1)
        quads.append(np.where(forward[:, None], ring, ring[:, ::-1]))
    quad = np.concatenate(quads)
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]).astype(np.int32)
    return _large_parts(vertices, faces, cells)


def _large_parts(
    vertices: np.ndarray, faces: np.ndarray, cells: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    part = Cells(vertices, 1.0).parts()
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volumes = np.bincount(part[faces[:, 0]], np.einsum("ij,ij->i", a, np.cross(b, c)), part.max() + 1)
    kept = (volumes > MIN_PART * volumes.max())[part]
    number = np.cumsum(kept) - 1
    faces = number[faces[kept[faces].all(axis=1)]].astype(np.int32)
    return vertices[kept], faces, cells[kept]


def _smooth(values: np.ndarray, faces: np.ndarray, times: int = 4) -> np.ndarray:
    """Unit vectors (n, 3) averaged with those of the vertices beside them, ``times`` over."""
    for _ in range(times):
        total = values.astype(np.float64)
        for corner in range(3):
            for axis in range(3):
                total[:, axis] += 0.5 * np.bincount(
                    faces[:, corner], values[faces[:, corner - 1], axis], len(values)
                )
        values = unit(total, values)
    return values


class _Splats:
    """The splats of a mesh; without ``face_splat``, each triangle counts as one."""

    def __init__(self, mesh: SplatMesh, normals: np.ndarray) -> None:
        splats = mesh.splats
        count = len(splats)
        self.of_face = splats.of_face
        self.of_vertex = np.maximum(splats.of_vertex, 0)  # vertices of no triangle are not drawn
        corner, owner, first = mesh.faces.ravel(), np.repeat(self.of_face, 3), 3 * splats.starts
        opacity = mesh.colors[corner, 3].astype(np.float64)
        self.centers = splats.centers(mesh.vertices, mesh.colors[:, 3])
        self.normals = np.empty((count, 3))
        for axis in range(3):
            self.normals[:, axis] = np.add.reduceat((opacity + 1e-6) * normals[corner, axis], first)
        self.normals /= np.maximum(np.linalg.norm(self.normals, axis=1, keepdims=True), 1e-12)
        self.opacity = np.maximum.reduceat(opacity, first)
        away = np.zeros(len(corner))
        for axis in range(3):  # columns are gathered and summed far faster than rows
            away += (mesh.vertices[:, axis][corner] - self.centers[:, axis][owner]) ** 2
        self.reach = np.sqrt(np.maximum.reduceat(away, first))


class _Feet:
    """Finds the vertex of a surface net that is nearest to a place."""

    def __init__(
        self,
        grid: Grid,
        field: np.ndarray,
        vertices: np.ndarray,
        normals: np.ndarray,
        cells: np.ndarray,
        threads: int | None = None,
    ) -> None:
        self.grid, self.field, self._threads = grid, field, threads
        self.vertices, self.normals = vertices, normals

        def sorted_into(block: int) -> VertexGrid:
            ids = np.full([-(-n // block) for n in field.shape], -1, np.int32)
            ids[tuple((cells // block).T)] = np.arange(len(cells), dtype=np.int32)
            return VertexGrid(ids, grid.low, block * grid.voxel, vertices, normals)

        self._fine, self._coarse = sorted_into(1), sorted_into(_COARSE)

    def of(self, places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(k,) indices of vertices for ``places`` (k, 3), and (k,) bool where there is one: near the surface,
        and inside it wherever that is."""
        index, found = self._nearest(places, normals, self._fine, _NEAR)
        steps = np.rint((places - self.grid.low) / self.grid.voxel).astype(np.int64)
        steps = np.clip(steps, 0, np.array(self.field.shape) - 1)
        deep = np.flatnonzero(~found & (self.field[tuple(steps.T)] < 0))
        index[deep], found[deep] = self._nearest(places[deep], normals[deep], self._coarse, _FAR)
        return index, found

    def _nearest(
        self, places: np.ndarray, normals: np.ndarray, grid: VertexGrid, reach: int
    ) -> tuple[np.ndarray, np.ndarray]:
        return nearest_vertices(places, normals, grid, reach=reach, facing_away=_SIDES, threads=self._threads)

    def facing(self, index: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(k, 3) unit normals of the surface at the vertices ``index`` (k,) for splats with ``normals``
        (k, 3). A sheet thinner than a voxel has both its sides in one vertex: there, those of the splats."""
        own = self.normals[index]
        behind = (self.vertices[index] - self.grid.voxel * own - self.grid.low) / self.grid.voxel
        steps = np.clip(np.rint(behind).astype(np.int64), 0, np.array(self.field.shape) - 1)
        sheet = self.field[tuple(steps.T)] > 0
        return np.where(sheet[:, None], unit(normals, own), own)

    def projected(self, places: np.ndarray, index: np.ndarray) -> np.ndarray:
        """``places`` (k, 3) moved along the normals of the vertices ``index`` onto their tangent planes, and
        no farther than a voxel from the vertex."""
        offset = places - self.vertices[index]
        normal = self.normals[index]
        offset = offset - np.einsum("ij,ij->i", offset, normal)[:, None] * normal
        length = np.linalg.norm(offset, axis=1, keepdims=True)
        offset *= np.minimum(1, self.grid.voxel / np.maximum(length, 1e-300))
        return self.vertices[index] + offset


def _clustered(
    places: np.ndarray, normals: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means (n, 3) of the ``places`` (v, 3) and unit ``normals`` (v, 3) that share a cell of ``size`` and an
    octant of directions, and the index (v,) int32 of each row's mean."""
    steps = np.clip((places - places.min(axis=0)) / size, 0, 2**19).astype(np.int64)
    octant = ((normals > 0) * np.array([1, 2, 4])).sum(axis=1)
    keys = (((steps[:, 0] << 20 | steps[:, 1]) << 20 | steps[:, 2]) << 3) | octant
    _, index = np.unique(keys, return_inverse=True)
    index = index.reshape(-1)
    count = int(index.max()) + 1
    held = np.bincount(index, minlength=count)[:, None]
    mean, way = (
        np.stack([np.bincount(index, values[:, k], count) for k in range(3)], axis=1) / held
        for values in (places, normals)
    )
    return mean, unit(way, np.array([0.0, 0, 1])), index.astype(np.int32)
