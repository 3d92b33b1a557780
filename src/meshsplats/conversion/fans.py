"""Patterns of triangles that stand for one splat, and meshes built from a pattern per splat."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

CHUNK = 1 << 14
"""Splats built at a time: the blocks of a chunk stay in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """How the vertices of one splat hang on its semi-axes.

    Concretely, vertex i of a splat with centre m and semi-axes ``A`` (a rows, one for every ring and axis) is at
    ``m + coefficients[i] @ A`` and takes the opacity of ``level[i]``: 0 the centre, 1 the innermost ring, and so on.
    """

    coefficients: np.ndarray
    """(m, rings * axes) float64; columns are ordered ring by ring, within a ring by axis."""
    level: np.ndarray
    """(m,) int: 0 for the centre, j for ring j; the last ring is the rim."""
    faces: np.ndarray
    """(t, 3) int32, all with the same winding in each ellipse; those round the centre list the centre first."""
    rings: int
    axes: int
    """2 for a flat fan, 3 for three crossed ellipses."""


@lru_cache(maxsize=64)
def pattern(sides: int, rings: int = 1, mode: str = "flat") -> Pattern:
    """The fan of ``sides`` triangles, with ``rings`` concentric rings of vertices (the last one is the rim).

    ``mode='flat'``: one ellipse, ``1 + rings * sides`` vertices and ``(2 * rings - 1) * sides`` triangles; rim vertex i
    is at the angle ``-pi + 2 pi i / sides`` from the first axis towards the second. ``mode='3d'``: ellipses in the
    planes of axes 1-2, 2-3 and 1-3 whose common points on the axes are one vertex; with one ring
    ``3 * sides - 5`` vertices and ``3 * sides`` triangles. ``sides`` must be a multiple of 4 there.
    """
    planes = [(0, 1)] if mode == "flat" else [(0, 1), (1, 2), (0, 2)]
    axes = 2 if mode == "flat" else 3
    turns = np.arange(sides) / sides - 0.5
    cos, sin = np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)
    # Exact zeros and ones on the axes: there the ellipses meet.
    cos[np.abs(cos) < 1e-12] = 0
    sin[np.abs(sin) < 1e-12] = 0
    number: dict[tuple, int] = {}
    coefficients = [np.zeros(rings * axes)]
    level = [0]

    def vertex(ring: int, plane: tuple[int, int], i: int) -> int:
        direction = [0.0] * axes
        direction[plane[0]], direction[plane[1]] = cos[i], sin[i]
        key = (ring, *np.round(direction, 9) + 0.0)
        if key not in number:
            number[key] = len(coefficients)
            row = np.zeros(rings * axes)
            row[(ring - 1) * axes : ring * axes] = direction
            coefficients.append(row)
            level.append(ring)
        return number[key]

    faces = []
    for plane in planes:
        ids = [[vertex(ring, plane, i) for i in range(sides)] for ring in range(1, rings + 1)]
        following = [[row[(i + 1) % sides] for i in range(sides)] for row in ids]
        faces += [(0, ids[0][i], following[0][i]) for i in range(sides)]
        for inner in range(rings - 1):
            outer = inner + 1
            for i in range(sides):
                faces.append((ids[inner][i], ids[outer][i], following[outer][i]))
                faces.append((ids[inner][i], following[outer][i], following[inner][i]))
    return Pattern(np.array(coefficients), np.array(level), np.array(faces, np.int32), rings, axes)


def build(
    patterns: list[Pattern],
    choice: np.ndarray,
    centers: np.ndarray,
    axes: np.ndarray,
    radii: np.ndarray,
    rgb: np.ndarray,
    alpha: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3), faces (f, 3), colours (v, 4) and the owner (f,) of each face, splat after splat.

    ``choice`` (n,) numbers each splat's pattern; ``axes`` (n, a, 3) are one-sigma semi-axes; ``radii`` (n, rings) the
    radius of each ring in sigma and ``alpha`` (n, rings + 1) the opacity of the centre and of each ring, both padded
    to the longest pattern; ``rgb`` is (n, 3).
    """
    n = len(centers)
    vertex_count = np.array([len(p.level) for p in patterns], np.int64)[choice]
    face_count = np.array([len(p.faces) for p in patterns], np.int64)[choice]
    vertex_end, face_end = np.cumsum(vertex_count), np.cumsum(face_count)
    v, f = (int(vertex_end[-1]), int(face_end[-1])) if n else (0, 0)
    if max(v, f) > np.iinfo(np.int32).max:
        raise ValueError(f"the mesh would have {v} vertices and {f} triangles, more than 2^31: use max_triangles")
    vertices = np.empty((v, 3), np.float32)
    colors = np.empty((v, 4), np.float32)
    faces = np.empty((f, 3), np.int32)
    owner = np.repeat(np.arange(n, dtype=np.int32), face_count)
    for begin in range(0, n, CHUNK):
        chunk = slice(begin, min(begin + CHUNK, n))
        for number, shape in enumerate(patterns):
            rows = np.flatnonzero(choice[chunk] == number) + begin
            if not len(rows):
                continue
            m, t, k = len(shape.level), len(shape.faces), len(rows)
            # One matrix product places all vertices: columns are the centre and the scaled semi-axes of every ring.
            place = np.zeros((1 + shape.rings * shape.axes, m, 3, 3))
            place[0] = np.eye(3)
            place[1:] = np.einsum("mq,xy->qmxy", shape.coefficients, np.eye(3))
            parts = np.empty((k, 1 + shape.rings * shape.axes, 3), np.float32)
            parts[:, 0] = centers[rows]
            own = axes[rows]
            for ring in range(shape.rings):
                span = slice(1 + ring * shape.axes, 1 + (ring + 1) * shape.axes)
                np.multiply(own, radii[rows, ring, None, None], out=parts[:, span])
            matrix = np.ascontiguousarray(place.transpose(0, 2, 1, 3), np.float32).reshape(-1, 3 * m)
            block = parts.reshape(k, -1) @ matrix
            # The same for colours: each output number is one of r, g, b or one of the opacity levels.
            source = np.zeros((3 + shape.rings + 1, m, 4), np.float32)
            source[[0, 1, 2], :, [0, 1, 2]] = 1
            source[3 + shape.level, np.arange(m), 3] = 1
            tint = np.concatenate([rgb[rows], alpha[rows, : shape.rings + 1]], axis=1) @ source.reshape(-1, 4 * m)
            first_vertex = vertex_end[rows] - vertex_count[rows]
            first_face = face_end[rows] - face_count[rows]
            corners = (first_vertex.astype(np.int32)[:, None] + shape.faces.reshape(1, -1)).reshape(-1, 3)
            if k == chunk.stop - chunk.start:  # one pattern: the chunk's rows lie together
                vertices[first_vertex[0] : first_vertex[0] + k * m] = block.reshape(-1, 3)
                colors[first_vertex[0] : first_vertex[0] + k * m] = tint.reshape(-1, 4)
                faces[first_face[0] : first_face[0] + k * t] = corners
            else:
                into = (first_vertex[:, None] + np.arange(m)).ravel()
                vertices[into] = block.reshape(-1, 3)
                colors[into] = tint.reshape(-1, 4)
                faces[(first_face[:, None] + np.arange(t)).ravel()] = corners
    return vertices, faces, colors, owner
