"""Patterns of triangles that stand for one splat, and meshes built from a pattern per splat."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from meshsplats.conversion.products import thin_product
from meshsplats.conversion.profiles import Profile

CHUNK = 1 << 13
"""Splats built at a time: the blocks of a chunk stay in the processor's cache."""

PLANES = {"flat": [(0, 1)], "crossed": [(0, 1), (0, 2)], "3d": [(0, 1), (1, 2), (0, 2)]}
"""Axes that span the ellipses of each mode, in the order of their triangles."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """How the vertices of one splat hang on its semi-axes.

    Concretely, vertex i of a splat with centre m and one-sigma semi-axes ``A`` (a, 3) is at
    ``m + radius[level[i]] * directions[i] @ A`` and takes the opacity of ``level[i]``.
    """

    directions: np.ndarray
    """(m, a) float64 points of the unit circles; 0 for the centre. a is 2 for one ellipse, else 3."""
    level: np.ndarray
    """(m,) int: 0 for the centre, j for ring j; the last ring is the rim."""
    faces: np.ndarray
    """(t, 3) int32, all with the same winding in each ellipse; those round the centre list the centre
    first."""
    ellipses: int


@dataclass(frozen=True, eq=False)
class Shape:
    """A pattern and the profile of its rings."""

    pattern: Pattern
    profile: Profile


@lru_cache(maxsize=64)
def pattern(sides: int, rings: int = 1, mode: str = "flat") -> Pattern:
    """Ellipses of ``sides`` triangles round the centre, with ``rings`` concentric rings of vertices (the last
    is the rim).

    ``mode='flat'``: one ellipse, ``1 + rings * sides`` vertices and ``(2 * rings - 1) * sides`` triangles;
    rim vertex i is at the angle ``-pi + 2 pi i / sides`` from the first axis towards the second.
    ``mode='crossed'``: a second one of the first and third axis; ``mode='3d'``: three, in the planes of axes
    1-2, 2-3 and 1-3. Their centre and the vertices that meet on an axis are one: '3d' has, with one ring,
    ``3 * sides - 5`` vertices and ``3 * sides`` triangles where ``sides`` is a multiple of 4; 'crossed' has
    ``2 * sides - 1`` and ``2 * sides`` where it is even.
    """
    planes = PLANES[mode]
    axes = max(map(max, planes)) + 1
    turns = np.arange(sides) / sides - 0.5
    cos, sin = np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)
    # Exact zeros on the axes: there the ellipses meet.
    cos[np.abs(cos) < 1e-12] = 0
    sin[np.abs(sin) < 1e-12] = 0
    number: dict[tuple, int] = {}
    directions = [np.zeros(axes)]
    level = [0]

    def vertex(ring: int, plane: tuple[int, int], i: int) -> int:
        direction = np.zeros(axes)
        direction[plane[0]], direction[plane[1]] = cos[i], sin[i]
        key = (ring, *(np.round(direction, 9) + 0.0))
        if key not in number:
            number[key] = len(directions)
            directions.append(direction)
            level.append(ring)
        return number[key]

    ids = [
        [[vertex(ring, plane, i) for i in range(sides)] for plane in planes] for ring in range(1, rings + 1)
    ]
    faces = []
    for ellipse in range(len(planes)):
        for i in range(sides):
            j = (i + 1) % sides
            faces.append((0, ids[0][ellipse][i], ids[0][ellipse][j]))
        for inner, outer in pairwise(ids):
            for i in range(sides):
                j = (i + 1) % sides
                faces.append((inner[ellipse][i], outer[ellipse][i], outer[ellipse][j]))
                faces.append((inner[ellipse][i], outer[ellipse][j], inner[ellipse][j]))
    return Pattern(np.array(directions), np.array(level), np.array(faces, np.int32), len(planes))


def semi_axes(quaternions: np.ndarray, order: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(n, 3, 3) float32 one-sigma semi-axes in the world frame; row k is ``sigma[:, k]`` along axis
    ``order[:, k]``."""
    w, x, y, z = np.ascontiguousarray(quaternions.T)
    two = np.float32(2)
    columns = np.empty((3, 3, len(w)), np.float32)
    columns[0] = 1 - two * (y * y + z * z), two * (x * y + w * z), two * (x * z - w * y)
    columns[1] = two * (x * y - w * z), 1 - two * (x * x + z * z), two * (y * z + w * x)
    columns[2] = two * (x * z + w * y), two * (y * z - w * x), 1 - two * (x * x + y * y)
    own = np.ascontiguousarray(columns.transpose(2, 0, 1))
    own = own[np.arange(len(w))[:, None], order]
    own *= sigma[:, :, None]
    return own


def build(
    shapes: list[Shape],
    choice: np.ndarray,
    centers: np.ndarray,
    quaternions: np.ndarray,
    order: np.ndarray,
    sigma: np.ndarray,
    rgb: np.ndarray,
    opacity: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3), faces (f, 3), colours (v, 4) and (n,) how many of the faces each splat has, in order.

    ``choice`` (n,) numbers each splat's shape; ``order`` (n, 3) and ``sigma`` (n, 3) give its axes as in
    ``semi_axes``; ``opacity`` (n,) multiplies the profile, and the product is clamped to 1.
    """
    n = len(centers)
    vertex_count = np.array([len(s.pattern.level) for s in shapes], np.int64)[choice]
    face_count = np.array([len(s.pattern.faces) for s in shapes], np.int64)[choice]
    v, f = int(vertex_count.sum()), int(face_count.sum())
    if max(v, f) > np.iinfo(np.int32).max:
        raise ValueError(f"the mesh would have {v} vertices and {f} triangles, too many: use max_triangles")
    vertices = np.empty((v, 3), np.float32)
    colors = np.empty((v, 4), np.float32)
    faces = np.empty((f, 3), np.int32)
    recipes = [_recipe(shape) for shape in shapes]
    first_vertex = first_face = 0
    for begin in range(0, n, CHUNK):
        part = slice(begin, min(begin + CHUNK, n))
        own_vertices, own_faces, own_choice = vertex_count[part], face_count[part], choice[part]
        start = first_vertex + np.cumsum(own_vertices) - own_vertices
        blocks: list[tuple[np.ndarray, ...]] = []
        sequence = []
        for number, (shape, (place, tint)) in enumerate(zip(shapes, recipes, strict=True)):
            rows = np.flatnonzero(own_choice == number)
            if not len(rows):
                continue
            sequence.append(rows)
            own = rows + begin
            profile = shape.profile
            axes = semi_axes(quaternions[own], order[own], sigma[own])
            used = shape.pattern.directions.shape[1]
            parts = np.concatenate([centers[own], axes[:, :used].reshape(len(own), -1)], axis=1)
            levels = np.minimum(
                opacity[own][:, None] * np.array(profile.opacities, np.float32), np.float32(1)
            )
            paint = thin_product(np.concatenate([rgb[own], levels], axis=1), tint)
            corners = start[rows].astype(np.int32)[:, None] + shape.pattern.faces.reshape(1, -1)
            blocks.append(
                (thin_product(parts, place).reshape(-1, 3), corners.reshape(-1, 3), paint.reshape(-1, 4))
            )
        end_vertex, end_face = first_vertex + int(own_vertices.sum()), first_face + int(own_faces.sum())
        points, corners, paint = zip(*blocks, strict=True)
        _weave(points, sequence, own_vertices, vertices[first_vertex:end_vertex])
        _weave(paint, sequence, own_vertices, colors[first_vertex:end_vertex])
        _weave(corners, sequence, own_faces, faces[first_face:end_face])
        first_vertex, first_face = end_vertex, end_face
    return vertices, faces, colors, face_count


def _weave(
    blocks: tuple[np.ndarray, ...], sequence: list[np.ndarray], count: np.ndarray, out: np.ndarray
) -> None:
    """Writes the rows of ``blocks`` to ``out``, splat after splat.

    Block i holds the splats ``sequence[i]``, each with its ``count`` rows.
    """
    if len(blocks) == 1:
        out[:] = blocks[0]
        return
    splats = np.concatenate(sequence)
    length = count[splats]
    source = np.empty(len(count), np.int64)
    source[splats] = np.cumsum(length) - length
    shift = source - (np.cumsum(count) - count)
    rows = np.repeat(shift, count)
    rows += np.arange(len(rows))
    # Much quicker than to assign to scattered rows.
    np.take(np.concatenate(blocks), rows, axis=0, out=out, mode="clip")


def _recipe(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Two matrices that do a splat's vertices in one product each.

    (3 + 3 a, 3 m) from centre and semi-axes to positions; (3 + rings + 1, 4 m), of ones and zeros, from r, g,
    b and the opacities of centre and rings to RGBA.
    """
    directions, level = shape.pattern.directions, shape.pattern.level
    m, a = directions.shape
    radius = np.array((0.0, *shape.profile.radii))[level]
    place = np.zeros((1 + a, 3, m, 3))
    for axis in range(3):
        place[0, axis, :, axis] = 1
        place[1:, axis, :, axis] = (radius[:, None] * directions).T
    tint = np.zeros((3 + len(shape.profile.opacities), m, 4), np.float32)
    tint[[0, 1, 2], :, [0, 1, 2]] = 1
    tint[3 + level, np.arange(m), 3] = 1
    return place.reshape(-1, 3 * m).astype(np.float32), tint.reshape(-1, 4 * m)
