"""Textures as vertex colours, for whatever draws or writes these alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from meshsplats._common.kinds import need
from meshsplats.formats.surfaces.corners import plain_mesh, smooth_normals
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.mesh import SplatMesh

TRIANGLES = 1_000_000
"""Triangles into which those of a texture are divided, at most, unless there are more of them already."""
PARTS = np.unique(np.round(2 ** (np.arange(19) / 2)).astype(np.int64))  # 1 to 512
"""Parts into which the edges of a triangle are divided."""
_AT_ONCE = 1_000_000


def texture_to_vertex_colors(base: BaseMesh, triangles: int = TRIANGLES) -> SplatMesh:
    """``base`` with its textures as vertex colours: triangles with a texture are divided where it has
    more texels than they have corners, up to two for a texel, and into at most ``triangles`` in all. A mesh
    without textures keeps its triangles, and its colours, else it is grey."""
    need(BaseMesh, base=base)
    if not base.textured:
        return plain_mesh(base)
    parts = _parts(base, triangles)
    normals = smooth_normals(base)
    pieces = [_divided(base, normals, faces, n) for faces, n in _groups(parts)]
    vertices, directions, colors = (np.concatenate([piece[k] for piece in pieces]) for k in range(3))
    firsts = np.cumsum([0, *(len(piece[0]) for piece in pieces[:-1])])
    faces = np.concatenate([piece[3] + first for piece, first in zip(pieces, firsts, strict=True)])
    return SplatMesh(vertices, faces, colors, normals=directions, up=base.up, origin=base.origin)


def _parts(base: BaseMesh, triangles: int) -> np.ndarray:
    """(m,) of ``PARTS``: that of the edges of each face."""
    assert base.uv is not None
    assert base.face_texture is not None
    textured = base.textured_faces()
    sizes = np.array([(texture.pixels.shape[1], texture.pixels.shape[0]) for texture in base.textures])
    size = sizes[base.face_texture[textured]][:, None]
    edges = np.diff(base.uv[textured].astype(np.float64), axis=1) * size
    texels = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]) / 2
    left = triangles - (len(base.faces) - len(texels))

    def parts(share: float) -> np.ndarray:
        """For two triangles to so many of the texels."""
        return PARTS[np.searchsorted(PARTS, np.sqrt(2 * share * texels), "right").clip(1) - 1]

    low, high = 0.0, 2.0  # of which the mean is tried, first all texels
    while high - low > 1e-6 and low < 1:
        middle = (low + high) / 2
        low, high = (middle, high) if (parts(middle) ** 2).sum() <= left else (low, middle)
    result = np.ones(len(base.faces), int)
    result[textured] = parts(low)
    return result


def _groups(parts: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    """Indices of faces whose edges have the same number of parts, and that number."""
    for n in np.unique(parts).tolist():
        faces = np.flatnonzero(parts == n)
        step = max(1, _AT_ONCE // (n + 1) ** 2)
        for begin in range(0, len(faces), step):
            yield faces[begin : begin + step], n


def _divided(
    base: BaseMesh, normals: np.ndarray, faces: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3), unit normals (v, 3), colours (v, 4) and triangles (t, 3) of ``faces`` (k,) whose edges
    are divided into ``n`` parts."""
    i, j = (grid.ravel() for grid in np.mgrid[: n + 1, : n + 1])
    inside = i + j <= n
    number = np.cumsum(inside).reshape(n + 1, n + 1) - 1
    i, j = i[inside], j[inside]
    (a, b), (c, d) = ((i[i + j < short], j[i + j < short]) for short in (n, n - 1))
    corners = np.concatenate(
        [
            np.stack([number[a, b], number[a + 1, b], number[a, b + 1]], axis=1),
            np.stack([number[c + 1, d], number[c + 1, d + 1], number[c, d + 1]], axis=1),
        ]
    )
    weights = np.stack([n - i - j, i, j], axis=1) / n
    positions, directions = (
        np.einsum("vc,kcx->kvx", weights, values[base.faces[faces]].astype(np.float64)).reshape(-1, 3)
        for values in (base.vertices, normals)
    )
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-30)
    colors = base.colors_at(np.repeat(faces, len(weights)), np.tile(weights, (len(faces), 1)))
    triangles = corners + len(weights) * np.arange(len(faces))[:, None, None]
    return (
        positions.astype(np.float32),
        directions.astype(np.float32),
        colors,
        triangles.reshape(-1, 3).astype(np.int32),
    )
