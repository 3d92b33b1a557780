"""The initial state of a fine-tuning: the mesh, the unit of each vertex, and the mesh's boundary."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from meshsplats.camera import Camera
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh, splat_starts
from meshsplats.rendering.looks import Look


def starting_mesh(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    *,
    preset: str = "default",
    look: Look = "area",
    **options: Any,
) -> SplatMesh:
    """``cloud`` converted for the fine-tuning of that ``preset``, to be seen from ``cameras``.

    For 'paper' and 'published' that is the paper's conversion. For 'default' it is ours, where ``options``,
    those of ``convert``, do not say otherwise, with one ellipse a splat (``mode='flat'``) of 8 triangles in
    the mean, more where much shows (``detail='cameras'``): two crossed ellipses look better as they are
    converted, but cost more time in a step and end lower. For the ``look`` 'splats' it is to be
    drawn with a filter (``footprint='filter'``), where the splats' kernel has one: that of 3DGS.
    """
    from meshsplats.conversion import convert

    if preset != "default":
        return convert(cloud, preset="paper", cameras=cameras, **options)
    if options.get("mode") is None and options.get("flat_below") is None:
        options["mode"] = "flat"
    given = options.get("footprint") is not None or options.get("footprint_px2") is not None
    if look == "splats" and cloud.kernel == "3dgs" and not given:
        options["footprint"] = "filter"
    one_ring = options.get("mode") == "flat" and options.get("rings") in (None, 1)
    if options.get("detail") is None and one_ring:
        options["detail"] = "cameras"
    return convert(cloud, preset="default", cameras=cameras, look=look, **options)


def vertex_sizes(mesh: SplatMesh) -> np.ndarray:
    """(v,) float32 size of each vertex in scene units: the square root of twice its triangles' area.

    The triangles of one splat (``face_splat``) share the mean of their sizes. A vertex of several triangles
    takes the mean of theirs. Vertices without area take the smallest size in the mesh, so that they hardly
    move; all sizes are 0 if no triangle has an area.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.sqrt(np.linalg.norm(normals, axis=1))
    if mesh.face_splat is not None and len(size):
        starts = splat_starts(mesh.face_splat)
        counts = np.diff(np.append(starts, len(size)))
        size = np.repeat(np.add.reduceat(size, starts) / counts, counts)
    return vertex_means(mesh, size)


def vertex_means(mesh: SplatMesh, values: np.ndarray) -> np.ndarray:
    """(v,) float32: for each vertex the mean of its triangles' ``values``, (f,) >= 0.

    Vertices whose mean is 0 take the smallest positive one; all are 0 if all values are.
    """
    v = len(mesh.vertices)
    total = np.bincount(mesh.faces.ravel(), np.repeat(values, 3), v)
    uses = np.bincount(mesh.faces.ravel(), minlength=v)
    result = np.divide(total, uses, out=np.zeros(v), where=uses > 0)
    positive = result > 0
    if positive.any():
        result[~positive] = result[positive].min()
    return result.astype(np.float32)


def boundary_vertices(faces: np.ndarray, count: int) -> np.ndarray:
    """(count,) bool: the vertices on the boundary, on edges of exactly one of the triangles (f, 3)."""
    low = np.minimum(faces, np.roll(faces, -1, axis=1)).astype(np.int64)
    high = np.maximum(faces, np.roll(faces, -1, axis=1))
    edges = np.sort((low * count + high).ravel())
    differs = np.concatenate([[True], edges[1:] != edges[:-1], [True]])
    boundary = edges[differs[:-1] & differs[1:]] if len(edges) else edges
    result = np.zeros(count, bool)
    result[boundary // max(count, 1)] = True
    result[boundary % max(count, 1)] = True
    return result
