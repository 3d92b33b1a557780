"""Patterns of triangles, fans, that represent one splat; meshes of one pattern for each splat."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from meshsplats._common.chunks import chunks, thin_product
from meshsplats._common.geometry import rotation_rows

CHUNK = 1 << 13
"""Splats per chunk: its arrays stay in the processor's cache."""

PLANES = {"flat": [(0, 1)], "crossed": [(0, 1), (0, 2)], "3d": [(0, 1), (1, 2), (0, 2)]}
"""Axes that span the ellipses of each mode, in the order of their triangles."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """Vertices of one splat in terms of its semi-axes, and its triangles.

    Concretely, vertex i of a splat with centre m and one-sigma semi-axes ``A`` (a, 3) is at
    ``m + radius[level[i]] * directions[i] @ A`` and has the opacity of ``level[i]``.
    """

    directions: np.ndarray
    """(m, a) float64 points of the unit circles; 0 for the centre. a is 2 for one ellipse, else 3."""
    level: np.ndarray
    """(m,) int: 0 for the centre, j for ring j; the last ring is the rim."""
    faces: np.ndarray
    """(t, 3) int32, all with the same winding in each ellipse; those at the centre list the centre first."""
    ellipses: int


class LevelProfile(Protocol):
    """Radii and opacities of the centre and the rings of a pattern."""

    @property
    def level_radii(self) -> tuple[float, ...]:
        """In standard deviations."""

    def level_opacities(self, opacity: np.ndarray) -> np.ndarray:
        """(levels, n) float32 in [0, 1], for splats of ``opacity`` (n,)."""


@dataclass(frozen=True, eq=False)
class Shape:
    """A pattern and the profile of its levels."""

    pattern: Pattern
    profile: LevelProfile
    fits_projection: bool = False
    """Whether the profile is that of the splat's projection in all directions, not in that of an ellipse."""


@lru_cache(maxsize=64)
def pattern(sides: int, rings: int = 1, mode: str = "flat") -> Pattern:
    """Ellipses of ``sides`` triangles around the centre, with ``rings`` concentric rings of vertices (the
    last is the rim).

    ``mode='flat'``: one ellipse, ``1 + rings * sides`` vertices and ``(2 * rings - 1) * sides`` triangles;
    rim vertex i is at the angle ``-pi + 2 pi i / sides`` from the first axis towards the second.
    ``mode='crossed'``: a second one of the first and third axis; ``mode='3d'``: three, in the planes of axes
    1-2, 2-3 and 1-3. They share the centre and the vertices that meet on an axis: '3d' has, with one ring,
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
    index: dict[tuple[float, ...], int] = {}
    directions = [np.zeros(axes)]
    level = [0]

    def vertex(ring: int, plane: tuple[int, int], i: int) -> int:
        direction = np.zeros(axes)
        direction[plane[0]], direction[plane[1]] = cos[i], sin[i]
        key = (ring, *(np.round(direction, 9) + 0.0))
        if key not in index:
            index[key] = len(directions)
            directions.append(direction)
            level.append(ring)
        return index[key]

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
    """(k, 3, n) float32 one-sigma semi-axes in the world frame.

    Item i holds x, y and z of the axes ``order[:, i]`` of ``quaternions`` (n, 4), times ``sigma[:, i]``;
    ``order`` and ``sigma`` are (n, k).
    """
    n = len(quaternions)
    columns = np.empty((3, 3, n), np.float32)  # by axis, then coordinate
    for coordinate, row in enumerate(rotation_rows(*np.ascontiguousarray(quaternions.T))):
        for axis, entry in enumerate(row):
            columns[axis, coordinate] = entry
    result = np.empty((order.shape[1], 3, n), np.float32)
    for k in range(order.shape[1]):
        # int64 before the product: NumPy 1 keeps the small type of an array times a scalar, and overflows.
        indices = order[:, k].astype(np.int64) * (3 * n) + np.arange(n)
        for coordinate in range(3):
            np.take(columns, indices, out=result[k, coordinate], mode="clip")
            indices += n
        result[k] *= sigma[:, k]
    return result


def build(
    shapes: list[Shape],
    choice: np.ndarray,
    centers: np.ndarray,
    quaternions: np.ndarray,
    order: np.ndarray,
    sigma: np.ndarray,
    rgb: np.ndarray,
    opacity: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3), faces (f, 3) and colours (v, 4), splat after splat.

    Args:
        shapes: the shapes in use.
        choice: (n,) index of each splat's shape.
        centers, quaternions: (n, 3) and (n, 4) of the splats.
        order, sigma: (n, 3) axes and their standard deviations, as in ``semi_axes``.
        rgb: (n, 3) display colours.
        opacity: (n,) of the splats, may be above 1.

    Raises ValueError for more vertices or triangles than int32 can index.
    """
    n = len(centers)
    corners = [shape.pattern.faces.ravel() for shape in shapes]
    first, v = _firsts(np.array([len(shape.pattern.level) for shape in shapes])[choice])
    first_face, f = _firsts(np.array([len(shape.pattern.faces) for shape in shapes])[choice])
    if max(v, f) > np.iinfo(np.int32).max:
        raise ValueError(f"the mesh would have {v} vertices and {f} triangles, too many: use max_triangles")
    vertices = np.empty((v, 3), np.float32)
    colors = np.empty((v, 4), np.float32)
    faces = np.empty((f, 3), np.int32)
    recipes = [_recipe(shape) for shape in shapes]

    for part in chunks(n, CHUNK):
        for index, (shape, (place, tint)) in enumerate(zip(shapes, recipes, strict=True)):
            rows = np.flatnonzero(choice[part] == index)
            if not len(rows):
                continue
            own_first, own_first_face = first[part][rows], first_face[part][rows]
            own_centers, own_quaternions, own_order, own_sigma, own_rgb, own_opacity = (
                np.take(array[part], rows, axis=0)
                for array in (centers, quaternions, order, sigma, rgb, opacity)
            )
            used = shape.pattern.directions.shape[1]
            axes = semi_axes(own_quaternions, own_order[:, :used], own_sigma[:, :used])
            parts = np.concatenate([own_centers.T, axes.reshape(3 * used, -1)])
            paint = np.concatenate([own_rgb.T, shape.profile.level_opacities(own_opacity)])
            _put(vertices, own_first, thin_product(parts.T, place))
            _put(colors, own_first, thin_product(paint.T, tint))
            _put(faces, own_first_face, own_first.astype(np.int32)[:, None] + corners[index])
    return vertices, faces, colors


def _firsts(counts: np.ndarray) -> tuple[np.ndarray, int]:
    """(n,) indices of the first item of each group, for groups of ``counts`` (n,) items; count of all."""
    ends = np.cumsum(counts, dtype=np.int64)
    return ends - counts, int(ends[-1]) if len(ends) else 0


def _put(out: np.ndarray, first: np.ndarray, blocks: np.ndarray) -> None:
    """Writes each row of ``blocks`` (k, m * c) as m rows of ``out`` (v, c), from row ``first`` on, (k,)
    ascending."""
    width = out.shape[1]
    rows = blocks.size // width
    if first[-1] - first[0] == rows - blocks.shape[1] // width:  # contiguous
        out[first[0] : first[0] + rows] = blocks.reshape(-1, width)
        return
    # Each run of m rows is written as one item: much faster than row by row.
    runs = sliding_window_view(out.reshape(-1), blocks.shape[1], writeable=True)
    runs[first * width] = blocks


def _recipe(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Two matrices, each of which gives values of a splat's m vertices in one product.

    (3 + 3 a, 3 m), from centre and semi-axes to positions; (3 + levels, 4 m), of ones and zeros, from r, g, b
    and the opacities of the levels to RGBA.
    """
    directions, level = shape.pattern.directions, shape.pattern.level
    m, a = directions.shape
    radius = np.array(shape.profile.level_radii)[level]
    place = np.zeros((1 + a, 3, m, 3))
    for axis in range(3):
        place[0, axis, :, axis] = 1
        place[1:, axis, :, axis] = (radius[:, None] * directions).T
    tint = np.zeros((3 + len(shape.profile.level_radii), m, 4), np.float32)
    tint[[0, 1, 2], :, [0, 1, 2]] = 1
    tint[3 + level, np.arange(m), 3] = 1
    return place.reshape(-1, 3 * m).astype(np.float32), tint.reshape(-1, 4 * m)
