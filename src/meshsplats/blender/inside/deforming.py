"""Lit splats that modifiers or shape keys deform: their stand-in takes the same shape when light is gathered.

It has other vertices than the splats. Each moves and turns with the splats that are nearest to it at rest.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from meshsplats.blender.inside import far_to_near, meshes, versions
from meshsplats.blender.inside.host import bpy

_REST = "meshsplats_rest"
"""Attribute of a stand-in that was deformed: where its vertices are at rest."""
_NEAREST = 8
"""Splats that a vertex moves with."""
_STIFF = 1e-3
"""Weight of no turn at all, in squares of their distances: their directions may leave the turn open."""


def deformers(obj: Any) -> list[Any]:
    """The modifiers of the mesh ``obj`` that may move its vertices."""
    order = far_to_near.modifier_of(obj)
    return [modifier for modifier in obj.modifiers if modifier != order]


def follow(obj: Any) -> None:
    """Gives the stand-in of ``obj`` and the points of its light the shape that modifiers and shape keys give
    its splats now. Where these make other vertices, it has that at rest; where the splats are hidden, it
    stays as it is."""
    if obj.type != "MESH":
        return
    depsgraph = bpy.context.evaluated_depsgraph_get()
    data = obj.evaluated_get(depsgraph).data
    moves = bool(deformers(obj)) or obj.data.shape_keys is not None
    if moves and data.is_evaluated and not versions.shows(depsgraph, {obj}):
        return  # it is a mere copy of the one at rest
    whole = moves and len(data.vertices) == len(obj.data.vertices)
    for child in [child for child in obj.children if child.get(meshes.STAND_IN)]:
        if whole or _REST in child.data.attributes:
            rest = _rest(child.data)
            places = _moved(obj, versions.positions(data), child, rest) if whole else rest
            versions.set_positions(child.data, places)
            child.data.update()


def _rest(data: Any) -> np.ndarray:
    """(v, 3) float32 vertices of the stand-in ``data`` at rest, which it remembers from here on."""
    found = data.attributes.get(_REST)
    if found is None:
        places = versions.positions(data)
        data.attributes.new(_REST, "FLOAT_VECTOR", "POINT").data.foreach_set("vector", places.ravel())
        return places
    places = np.empty(3 * len(data.vertices), np.float32)
    found.data.foreach_get("vector", places)
    return places.reshape(-1, 3)


def _moved(obj: Any, deformed: np.ndarray, child: Any, rest: np.ndarray) -> np.ndarray:
    """(v, 3) places of the vertices ``rest`` (v, 3) of ``child``. Points of light are triangles, which stay
    as they are."""
    before, after = (_centers(obj.data, places) for places in (versions.positions(obj.data), deformed))
    parts = rest.reshape(-1, 3 if obj.get(meshes.POINTS) == child else 1, 3).astype(np.float64)
    near = _nearest(before, parts.mean(axis=1))
    old, new = before[near], after[near]
    middle, to = old.mean(axis=1, keepdims=True), new.mean(axis=1, keepdims=True)
    old, new = old - middle, new - to
    both = np.einsum("nki,nkj->nij", old, new)
    both += (_STIFF * np.einsum("nki,nki->n", old, old)[:, None, None] + 1e-30) * np.eye(3)
    left, _, right = np.linalg.svd(both)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]  # turns, no reflections
    return (to + (parts - middle) @ (left @ right)).reshape(-1, 3)


def _centers(data: Any, places: np.ndarray) -> np.ndarray:
    """(s, 3) float64 centres of the splats of the mesh ``data`` with its vertices at ``places`` (v, 3)."""
    faces, polygon = meshes.triangles(data)
    middles = places[faces].mean(axis=1, dtype=np.float64)
    owner = meshes.owners(data)[polygon] if meshes.SPLAT in data.attributes else polygon
    starts = np.flatnonzero(np.diff(owner, prepend=owner[:1] - 1))
    return np.add.reduceat(middles, starts) / np.diff(starts, append=len(owner))[:, None]


def _nearest(centers: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(n, k) int64 the ``centers`` (s, 3) that are nearest to each of ``places`` (n, 3)."""
    from mathutils.kdtree import KDTree

    tree = KDTree(len(centers))
    for i, center in enumerate(centers.tolist()):
        tree.insert(center, i)
    tree.balance()
    count = min(_NEAREST, len(centers))
    return np.array([[i for _, i, _ in tree.find_n(place, count)] for place in places.tolist()], np.int64)
