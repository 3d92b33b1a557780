"""Normal maps: the relief of a fine surface, on a light one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from meshsplats._common.geometry import vertex_normals
from meshsplats.conversion.normals import unit
from meshsplats.formats.surfaces.tangents import Frames, corner_frames
from meshsplats.rendering.backward import TapedRendering, TapeOptions
from meshsplats.rendering.edges import index_digits, indices_of
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import Triangles
from meshsplats.surfaces.atlas import filled

_NEIGHBOURS = 4
"""Points of the fine surface that a texel takes its normal from, weighted by their distances."""
_SAME_SIDE = 0.0
"""Cosine between the normals of a texel and a point from which both belong to one side of a thin part."""
_ROWS = 1 << 18
"""Texels at a time."""
_BESIDE = 1.5
"""Distance from the texels of a chart, up to which texels beside it continue it: bilinear interpolation at
its border reads those, and other charts have other tangents."""
_FLAT = np.array([0.0, 0.0, 1.0])
"""The smooth normal in tangent space."""


class Relief(NamedTuple):
    """A surface with all its triangles, as points."""

    points: np.ndarray
    """(p, 3) float64."""
    normals: np.ndarray
    """(p, 3) float64 unit."""


def relief_of(vertices: np.ndarray, faces: np.ndarray) -> Relief:
    """The vertices (v, 3) of a fine surface, with the normals of its triangles (f, 3)."""
    points = vertices.astype(np.float64)
    return Relief(points, vertex_normals(points, faces))


def normal_map(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, side: int, relief: Relief
) -> np.ndarray:
    """(side, side, 3) uint8 normals of ``relief`` in the tangent space of a light surface: x along u, y
    against v, so up in the image, z along its smooth normal. -1 to 1 is 0 to 255, as in glTF and USD.

    Args:
        vertices: (v, 3) of the light surface, where the fine one is.
        faces: (f, 3) its triangles.
        uv: (f, 3, 2) float32 texture coordinates of their corners, v down, in charts that do not overlap.
        side: of the map, texels.
        relief: the fine surface.
    """
    from scipy.spatial import cKDTree

    face, weights = _continued(*_texels(uv, side), uv)
    shown = face >= 0
    frames = corner_frames(vertices, faces, uv)
    result = np.zeros((side, side, 3), np.float32)
    result[...] = _FLAT
    tree = cKDTree(relief.points)
    rows, columns = np.nonzero(shown)
    for first in range(0, len(rows), _ROWS):
        at = rows[first : first + _ROWS], columns[first : first + _ROWS]
        texel, each = face[at], weights[at].astype(np.float64)
        frame = Frames(*(np.einsum("kc,kc...->k...", each, a[texel]) for a in frames))
        place = np.einsum("kc,kcj->kj", each, vertices[faces[texel]])
        result[at] = _in_tangent_space(frame, _normals_at(tree, relief, place, frame.normals))
    return np.rint(127.5 + 127.5 * unit(filled(result, shown), _FLAT)).astype(np.uint8)


def _texels(uv: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Of a texture of this ``side``: the triangle (side, side) int32 that each centre of a texel lies in, -1
    for none, and its barycentric coordinates (side, side, 3) there."""
    count = len(uv)
    flat = np.concatenate([uv.reshape(-1, 2), np.ones((3 * count, 1))], axis=1).astype(np.float32)
    corner = np.tile(np.eye(3)[:, :2], (count, 1))
    triangles = Triangles(
        flat,
        np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        np.tile(np.array([0, 0, 0, 1], np.float32), (3 * count, 1)),
        values=np.concatenate([index_digits(count), corner], axis=1, dtype=np.float32),
    )
    camera = Camera(np.eye(4), side, side, 0, 0, side, side, near=0.5)
    image = TapedRendering(triangles, camera, TapeOptions(background=(0, 0, 0)), tape_bytes=None)
    face = indices_of(image.attributes[..., :2], image.alpha > 0.5)
    first, second = image.attributes[..., 2], image.attributes[..., 3]
    return face, np.stack([first, second, 1 - first - second], axis=2)


def _continued(face: np.ndarray, weights: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``_texels`` with those beside a chart, too: in the triangle of the nearest texel in it, near the place
    on its border."""
    from scipy.ndimage import distance_transform_edt

    away, nearest = distance_transform_edt(face < 0, return_indices=True)
    rows, columns = np.nonzero((away > 0) & (away < _BESIDE))
    own = face[tuple(nearest[:, rows, columns])]
    a, b, c = np.moveaxis(uv[own].astype(np.float64) * len(face), 1, 0)
    b, c, place = b - a, c - a, np.stack([columns, rows], axis=1) + 0.5 - a
    area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    area[area == 0] = 1
    second = (place[:, 0] * c[:, 1] - place[:, 1] * c[:, 0]) / area
    third = (b[:, 0] * place[:, 1] - b[:, 1] * place[:, 0]) / area
    clamped = np.clip(np.stack([1 - second - third, second, third], axis=1), 0, 1)
    face, weights = face.copy(), weights.copy()
    face[rows, columns] = own
    weights[rows, columns] = clamped / clamped.sum(axis=1, keepdims=True)
    return face, weights


def _normals_at(tree: Any, relief: Relief, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(k, 3) normals of ``relief`` at places (k, 3) of a surface with these normals (k, 3). ``tree``: a k-d
    tree of its points."""
    distance, index = tree.query(places, k=min(_NEIGHBOURS, len(relief.points)))
    distance, index = distance.reshape(len(places), -1), index.reshape(len(places), -1)
    found = relief.normals[index]
    weight = 1 / np.maximum(distance, 1e-3 * distance.mean() + 1e-30)
    weight *= np.einsum("knj,kj->kn", found, normals) > _SAME_SIDE
    mean = np.einsum("kn,knj->kj", weight, found)
    return np.where(weight.any(axis=1)[:, None], mean, normals)


def _in_tangent_space(frame: Frames, normals: np.ndarray) -> np.ndarray:
    """(k, 3) float32 unit: ``normals`` (k, 3) by interpolated frames, which are not orthonormal: shaders
    use them so, and what they compute is to be these normals."""
    bitangents = frame.signs[:, None] * np.cross(frame.normals, frame.tangents)
    matrix = np.stack([frame.tangents, bitangents, frame.normals], axis=2)
    fine = np.abs(np.linalg.det(matrix)) > 1e-6
    matrix[~fine] = np.eye(3)
    solved = np.linalg.solve(matrix, normals[..., None])[..., 0]
    solved[~fine] = _FLAT
    return unit(solved, _FLAT).astype(np.float32)
