"""The size of each vertex' splat: the unit in which positions are optimised."""

from __future__ import annotations

import numpy as np

from meshsplats.mesh import SplatMesh, splat_starts


def vertex_sizes(mesh: SplatMesh) -> np.ndarray:
    """(v,) float32 sizes in scene units: the side of a square with twice the area of a vertex' typical
    triangle.

    Triangles count together where they come from one splat (``face_splat``), else each by itself; a vertex
    that several share takes the mean of theirs. Vertices without area take the smallest size that there is,
    so that they hardly move; all sizes are 0 if no triangle has an area.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.sqrt(np.linalg.norm(normals, axis=1))
    if mesh.face_splat is not None and len(size):
        starts = splat_starts(mesh.face_splat)
        counts = np.diff(np.append(starts, len(size)))
        size = np.repeat(np.add.reduceat(size, starts) / counts, counts)
    return means_at_vertices(mesh, size)


def means_at_vertices(mesh: SplatMesh, values: np.ndarray) -> np.ndarray:
    """(v,) float32: for each vertex the mean of its triangles' ``values`` (f,) >= 0. Vertices for which that
    is 0 take the smallest of the others; all are 0 if all values are."""
    v = len(mesh.vertices)
    total = np.bincount(mesh.faces.ravel(), np.repeat(values, 3), v)
    uses = np.bincount(mesh.faces.ravel(), minlength=v)
    result = np.divide(total, uses, out=np.zeros(v), where=uses > 0)
    positive = result > 0
    if positive.any():
        result[~positive] = result[positive].min()
    return result.astype(np.float32)
