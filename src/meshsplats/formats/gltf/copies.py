"""Triangles in an order of blending: each is in the file twice, once with each winding, of which viewers that
cull back faces show one. The reader drops the second copy.

Little more than flags is stored for that. The two windings of a triangle are (a, b, c) and (a, c, b), so that
they are found by their corners and sorted by them: bits in this order tell which is the triangle's own, and
most meshes have their triangles in this order already.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh


class Part(NamedTuple):
    """What one node of the file holds."""

    vertices: np.ndarray
    """(n,) int32 those of the mesh that are in it."""
    faces: np.ndarray
    """(k, 3) int32 indices of these vertices, in the order of blending."""


def parts(mesh: SplatMesh, order: DrawOrder) -> Iterator[Part]:
    """The nodes of a file that lists the triangles of ``mesh`` in ``order``."""
    faces = order.listed(mesh.faces)
    if order.node_count == 1:
        yield Part(np.arange(len(mesh.vertices), dtype=np.int32), faces)
        return
    unused = np.ones(len(mesh.vertices), bool)
    unused[mesh.faces] = False
    local = np.empty(len(mesh.vertices), np.int32)
    for first, end in zip(order.starts[:-1], order.starts[1:], strict=True):
        used = np.unique(faces[first:end])
        local[used] = np.arange(len(used), dtype=np.int32)
        listed = local[faces[first:end]]
        if end == len(faces):
            used = np.concatenate([used, np.flatnonzero(unused)])
        yield Part(used.astype(np.int32), listed)


class Own(NamedTuple):
    """How the triangles of the mesh itself are found among all copies."""

    turned: np.ndarray
    """Bits, those of a byte from the lowest, padded with 0: of the triangles sorted by their corners, whether
    the winding is the one with the greater index before the lesser."""
    offset: np.ndarray
    """(f,) from the number of each triangle to its place among the sorted ones: int8 where that suffices, as
    it does for fans, else int32."""


def own_triangles(faces: np.ndarray) -> Own:
    """What a reader needs to tell ``faces`` (f, 3), those of the mesh, from their copies."""
    order = _sorted(faces)
    turned = np.packbits(faces[order, 1] > faces[order, 2], bitorder="little")
    offset = np.empty(len(faces), np.int32)
    offset[order] = np.arange(len(faces), dtype=np.int32)
    offset -= np.arange(len(faces), dtype=np.int32)
    near = np.abs(offset).max(initial=0) < 128
    return Own(turned, offset.astype(np.int8) if near else offset)


def without_copies(faces: np.ndarray, own: Own) -> np.ndarray | None:
    """(f, 3) triangles of the mesh among ``faces`` (2 f, 3), which hold each of them with both windings; None
    if they do not."""
    turned = faces[:, 1] > faces[:, 2]
    flat = np.flatnonzero(faces[:, 1] == faces[:, 2])  # without area, both windings are one
    turned[flat[_sorted(faces[flat])][1::2]] = True
    half = len(faces) // 2
    if 2 * half != len(faces) or int(turned.sum()) != half:
        return None
    sides = []
    for side in (~turned, turned):
        listed = faces[side]
        sides.append(listed[_sorted(listed)])
    kept, mirrored = sides
    if not (kept == mirrored[:, [0, 2, 1]]).all():
        return None
    flags = np.unpackbits(own.turned, bitorder="little", count=half).astype(bool)
    result = np.where(flags[:, None], mirrored, kept)
    place = np.arange(half) + own.offset
    return result[place] if (np.sort(place) == np.arange(half)).all() else None


def order_of(faces: np.ndarray, listed: np.ndarray, starts: np.ndarray) -> DrawOrder | None:
    """The order that gives ``listed`` (2 f, 3), with nodes from ``starts`` on, of ``faces`` (f, 3), those of
    the mesh; None if there is none."""
    both = np.concatenate([faces, faces[:, [0, 2, 1]]])
    ours, theirs = (np.lexsort(rows.T[::-1]) for rows in (both, listed))
    if len(both) != len(listed) or (both[ours] != listed[theirs]).any():
        return None
    copies = np.empty(len(both), np.int32)
    copies[theirs] = ours
    try:
        return DrawOrder(copies, starts)
    except ValueError:
        return None  # a triangle that is in several nodes


def _sorted(faces: np.ndarray) -> np.ndarray:
    """The order of ``faces`` by their corners, whatever their winding: that of a fan around its first vertex,
    (0, 1, 2), (0, 2, 3), ..., (0, 8, 1)."""
    low, high = np.minimum(faces[:, 1], faces[:, 2]), np.maximum(faces[:, 1], faces[:, 2])
    return np.lexsort((-low, high, faces[:, 0]))


def joined_vertices(vertex: np.ndarray) -> np.ndarray | None:
    """For vertices of the mesh (n,) that the nodes list one after another, (v,) a place of each of them in
    the list; None unless each is listed."""
    if not len(vertex) or vertex.min() < 0 or vertex.max() >= len(vertex):
        return None
    place = np.full(int(vertex.max()) + 1, -1, np.int64)
    place[vertex] = np.arange(len(vertex))
    return None if (place < 0).any() else place


def counts(note: Any) -> int:
    """The number of nodes that a note tells of; 0 if it tells of no copies, or wrongly."""
    nodes = note.get("nodes") if isinstance(note, dict) else 0
    return nodes if isinstance(nodes, int) and not isinstance(nodes, bool) and nodes > 0 else 0
