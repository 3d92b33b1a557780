"""cut_mesh: opaque triangles in place of translucent ones, for programs that draw with a depth buffer."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from meshsplats._common.kinds import need
from meshsplats.scene.mesh import SplatMesh, checked_cutoff

CUTOFF = 0.2
"""Least opacity that is drawn as solid: of 0.05 to 0.5 the best compromise over an opaque figure, a furry one
and an outdoor scene in three.js (docs/viewers.md)."""


def cut_mesh(mesh: SplatMesh, cutoff: float = CUTOFF) -> SplatMesh:
    """The part of ``mesh`` whose opacity is at least ``cutoff``, as opaque triangles.

    Opacity is linear on a triangle, so the part is a triangle or a quadrilateral, cut off along a straight
    line. Triangles that share an edge are cut at the same point of it, also where they do not share vertices:
    no gaps appear. Colours, normals and attributes of the new vertices are interpolated. The image is that of
    ``render(mesh, camera, cutoff=cutoff)``, and every program with a depth buffer draws it, in any order of
    triangles, with smooth edges where it multisamples.

    Args:
        mesh: a mesh without a low-pass filter.
        cutoff: opacity in [0, 1].

    Returns:
        A mesh with opacity 1 everywhere: up to two triangles for each of ``mesh``, in its order. It has no
        vertex that no triangle uses, and no binding, as the new vertices lie between those of the base mesh.

    Raises:
        ValueError: ``cutoff`` is out of its range, or the mesh has a filter.
    """
    need(SplatMesh, mesh=mesh)
    level = np.float32(checked_cutoff(cutoff))
    if mesh.filter_px2:
        raise ValueError(
            f"the mesh is to be rendered with a filter of {mesh.filter_px2:g} px^2, which opaque triangles"
            " cannot have: make it part of the triangles first, bake_filter(mesh, cameras) or meshsplats bake"
        )
    opacity = mesh.colors[mesh.faces, 3]
    solid = (opacity >= level).sum(axis=1)
    crossed = np.flatnonzero((solid == 1) | (solid == 2))
    one = solid[crossed] == 1
    # The corner on its own side of the level set comes first; the winding stays.
    apart = (opacity[crossed] >= level) == one[:, None]
    corners = np.take_along_axis(
        mesh.faces[crossed], (apart.argmax(axis=1)[:, None] + np.arange(3)) % 3, axis=1
    )
    low, high, first, second = _crossings(mesh, corners)
    below, above = (mesh.colors[ends, 3].astype(np.float64) for ends in (low, high))
    share = ((level - below) / (above - below))[:, None]

    def extended(values: np.ndarray) -> np.ndarray:
        """One row per vertex of ``mesh`` and then per crossing."""
        table = values if values.ndim == 2 else values[:, None]
        mixed = table[low] + share * (table[high].astype(np.float64) - table[low])
        result = np.concatenate([table, mixed.astype(np.float32)])
        return result if values.ndim == 2 else result[:, 0]

    fields = [f.name for f in mesh.FIELDS if f.per == "vertex" and getattr(mesh, f.name) is not None]
    arrays: dict[str, Any] = {name: extended(getattr(mesh, name)) for name in fields}
    arrays["colors"][:, 3] = 1
    _, b, c = corners.T
    tips = np.stack([corners[:, 0], first, second], axis=1)[one]
    quads = [np.stack(triangle, axis=1)[~one] for triangle in ((first, b, c), (first, c, second))]
    owners = [np.flatnonzero(solid == 3), crossed[one], crossed[~one], crossed[~one]]
    faces = np.concatenate([mesh.faces[owners[0]], tips, *quads])
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    order = order[_has_corners(arrays["vertices"], faces[order]) | (solid[owner[order]] == 3)]
    faces, owner = faces[order].astype(np.int32), owner[order]

    if "normals" in arrays:
        new = arrays["normals"][len(mesh.vertices) :]
        length = np.linalg.norm(new, axis=1, keepdims=True)
        new /= np.where(length > 0, length, 1)
    arrays["attributes"] = {name: extended(values) for name, values in mesh.attributes.items()}
    return replace(mesh, **arrays, binding=None).with_faces(faces, owner)


def _crossings(mesh: SplatMesh, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where the edges from the first of ``corners`` (n, 3) cross the level set.

    Returns:
        The less and the more opaque end (m,) of each distinct edge, in this order so that both triangles at
        an edge compute the same point; and for each triangle the vertex indices (n,) of its crossings on the
        edges to its second and its third corner, which count on from the vertices of ``mesh``.
    """
    count = len(mesh.vertices)
    ends = corners[:, [[0, 1], [0, 2]]].reshape(-1, 2)
    falling = mesh.colors[ends[:, 0], 3] > mesh.colors[ends[:, 1], 3]
    ends = np.where(falling[:, None], ends[:, ::-1], ends).astype(np.int64)
    keys, indices = np.unique(ends[:, 0] * max(count, 1) + ends[:, 1], return_inverse=True)
    first, second = (indices.reshape(-1, 2) + count).T
    return keys // max(count, 1), keys % max(count, 1), first, second


def _has_corners(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(f,) whether the three corners lie at different positions: a cut through a corner leaves none."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return (a != b).any(axis=1) & (b != c).any(axis=1) & (c != a).any(axis=1)
