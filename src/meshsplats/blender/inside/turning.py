"""Splats that were turned under their object: by *Apply* or *Join*, in edit mode, or by modifiers. Blender
turns their vertices, but not what else is in the frame of the object: view-dependent colours, and
shading normals.

So each vertex knows in which direction from the middle of its splat it lay when these were right.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from meshsplats.blender.inside import meshes, versions
from meshsplats.scene.face_splats import FaceSplats
from meshsplats.scene.spherical_harmonics import turned_harmonics

REST = ".splat_rest"
"""Attribute of vertices: that direction, ``_packed`` (4 bytes); 0 where it is not known. A name with a dot is
none of the artist's."""
_STEPS = 1023
_SEEN = 0.005
"""Root mean square by which the directions of a splat differ where it was turned: five times the rounding."""
_TOGETHER = 0.02
"""By which those of nine in ten splats may differ from one turn of all."""
_TORN = 0.25
"""By which they may differ from the turn of their splat; beyond, it lost vertices or was torn."""
_ROUNDING = 5e-6
"""Distance from the middle of a splat, per distance from the origin, whose direction is but rounding."""
_STIFF = 1e-3
"""Weight of no turn at all: the directions may leave it open."""
_ROWS = 1 << 18


class Turned(NamedTuple):
    """Splats that were turned."""

    which: np.ndarray
    """(s,) bool."""
    rotations: np.ndarray
    """(s, 3, 3) float32: from how they lay; with mirrors, where all were mirrored."""
    now: np.ndarray
    """(v, 3) float32 directions as they are."""


def remember(data: Any) -> None:
    """Stores with the mesh ``data`` how its splats lie, where something depends on it. Splats that follow a
    base have it all from there."""
    splats = _splats(data) if _has_frame(data) else None
    if splats is None:
        if REST in data.attributes:
            data.attributes.remove(data.attributes[REST])
        return
    attribute = data.attributes.get(REST) or data.attributes.new(REST, "INT", "POINT")
    attribute.data.foreach_set("value", _packed(_directions(data, splats)))


def follow(data: Any) -> None:
    """Turns view-dependent colours and shading normals of the mesh ``data`` as its splats were
    turned since the last time."""
    splats = _splats(data) if REST in data.attributes else None
    turned = None if splats is None else _turned(data, splats)
    if splats is None or turned is None:
        return
    harmonics = harmonics_of(data, splats, turned)
    if harmonics is not None:
        meshes.store_harmonics(data, harmonics, splats.of_vertex)
    normal = data.attributes.get(meshes.NORMAL)
    if normal is not None:
        normals = np.empty((len(data.vertices), 3), np.float32)
        normal.data.foreach_get("vector", normals.ravel())
        for start in range(0, len(normals), _ROWS):
            rows = slice(start, start + _ROWS)
            own = turned.rotations[splats.of_vertex[rows]]
            normals[rows] = np.einsum("vij,vj->vi", own, normals[rows])
        normal.data.foreach_set("vector", normals.ravel())
        versions.set_normals(data, normals)
    codes = np.where(turned.which[splats.of_vertex], _packed(turned.now), _codes(data))
    data.attributes[REST].data.foreach_set("value", codes)
    data.update_tag()


def harmonics_of(data: Any, splats: FaceSplats, turned: Turned | None = None) -> np.ndarray | None:
    """(s, k, 3) harmonics of the ``splats`` of the mesh ``data`` as they lie now, which may be ``turned``;
    None where it has none, or splats share vertices."""
    if not len(splats) or splats.share_vertices:
        return None
    found = meshes.read_harmonics(data, splats.faces[splats.starts, 0])
    if found is None:
        return None
    turned = turned or (_turned(data, splats) if REST in data.attributes else None)
    if turned is not None:
        found[turned.which] = turned_harmonics(found[turned.which], turned.rotations[turned.which])
    return found


def _has_frame(data: Any) -> bool:
    named = data.attributes
    return meshes.BASE_FACE not in named and (meshes.NORMAL in named or f"{meshes.HARMONICS[0]}_0" in named)


def _splats(data: Any) -> FaceSplats | None:
    """Those of the mesh ``data``, each with vertices of its own; else None."""
    if meshes.SPLAT not in data.attributes or not len(data.polygons):
        return None
    faces, polygon = meshes.triangles(data)
    numbers = meshes.owners(data)[polygon]
    # Joined meshes count from 0 again: what lies side by side belongs together.
    found = FaceSplats(faces, np.cumsum(np.diff(numbers, prepend=numbers[:1]) != 0), len(data.vertices))
    return None if found.share_vertices else found


def _directions(data: Any, splats: FaceSplats) -> np.ndarray:
    """(v, 3) float32 unit directions to the vertices from the middle of those of their splat; 0 where that is
    rounding, as for a vertex in the middle."""
    places, owner, count = versions.positions(data), splats.of_vertex, len(splats)
    used = np.flatnonzero(owner >= 0)
    sizes, squares = np.bincount(owner[used], minlength=count), np.zeros(count)
    for axis in range(3):
        squares += np.bincount(owner[used], np.square(places[used, axis]), count) / sizes
        middles = np.bincount(owner[used], places[used, axis], count) / sizes
        places[:, axis] -= middles[owner]
    lengths = np.linalg.norm(places, axis=1)
    known = (lengths > _ROUNDING * np.sqrt(squares)[owner])[:, None]
    return np.divide(places, lengths[:, None], out=np.zeros_like(places), where=known)


def _packed(directions: np.ndarray) -> np.ndarray:
    """(v,) int32 of ``directions`` (v, 3): ten bits for each axis; 0 for none."""
    x, y, z = np.rint((directions.T + 1) * (_STEPS / 2)).astype(np.int32)
    codes: np.ndarray = x | y << 10 | z << 20
    codes[~directions.any(axis=1)] = 0
    return codes


def _codes(data: Any) -> np.ndarray:
    """(v,) int32 values of ``REST``."""
    codes = np.empty(len(data.vertices), np.int32)
    data.attributes[REST].data.foreach_get("value", codes)
    return codes


def _turned(data: Any, splats: FaceSplats) -> Turned | None:
    """The ``splats`` of the mesh ``data`` that were turned since ``REST`` was stored; None if none was."""
    codes, now, count = _codes(data), _directions(data, splats), len(splats)
    known = np.flatnonzero((codes != 0) & now.any(axis=1) & (splats.of_vertex >= 0))
    codes, new, owner = codes[known], now[known], splats.of_vertex[known]
    old = np.stack([codes & _STEPS, codes >> 10 & _STEPS, codes >> 20], axis=1) * np.float32(2 / _STEPS) - 1
    which = _differences(old, new, owner, count) > _SEEN
    if not which.any():
        return None
    rows = which[owner]
    rotations = np.tile(np.eye(3, dtype=np.float32), (count, 1, 1))
    rotations[which] = _rotations(old[rows], new[rows], (np.cumsum(which) - 1)[owner[rows]])
    return Turned(which, rotations, now)


def _rotations(old: np.ndarray, new: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """(s, 3, 3) float32 that take the directions ``old`` (v, 3) of each splat nearest to ``new`` (v, 3): one
    for all where that will do, which may mirror; the splat of each is its ``owner`` (v,), counted from 0."""
    count = int(owner.max()) + 1
    products = (old[:, i] * new[:, j] for i in range(3) for j in range(3))
    sums = np.stack([np.bincount(owner, product, count) for product in products], axis=1).reshape(-1, 3, 3)
    for mirrors in (False, True):
        one = _nearest(sums.sum(axis=0), mirrors)
        if np.quantile(_differences(old @ one.T, new, owner, count), 0.9) < _TOGETHER:
            return np.broadcast_to(one, sums.shape)
    sums += _STIFF * np.linalg.norm(sums, axis=(1, 2))[:, None, None] * np.eye(3)
    own, turned = _nearest(sums), np.empty_like(old)
    for start in range(0, len(old), _ROWS):
        rows = slice(start, start + _ROWS)
        turned[rows] = np.einsum("vij,vj->vi", own[owner[rows]], old[rows])
    own[_differences(turned, new, owner, count) > _TORN] = np.eye(3)
    return own


def _differences(a: np.ndarray, b: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    """(s,) root mean square distance of ``a`` (v, 3) from ``b`` (v, 3) for each ``owner`` (v,); there are
    ``count``."""
    squares = np.bincount(owner, np.square(a - b).sum(axis=1), count)
    found: np.ndarray = np.sqrt(squares / np.maximum(np.bincount(owner, minlength=count), 1))
    return found


def _nearest(both: np.ndarray, mirrors: bool = False) -> np.ndarray:
    """(..., 3, 3) rotations that take directions nearest to others, of the sums ``both`` (..., 3, 3) of the
    products of their parts; with ``mirrors``, also with one."""
    left, _, right = np.linalg.svd(both)
    if not mirrors:
        left[..., 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    found: np.ndarray = (left @ right).swapaxes(-1, -2).astype(np.float32)
    return found
