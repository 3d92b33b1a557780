"""Where a fine-tuning begins: the mesh it starts from, the unit of each vertex, and its open edges."""

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


def on_open_edges(faces: np.ndarray, vertices: int) -> np.ndarray:
    """(vertices,) bool: the vertices of edges that only one of the triangles ``faces`` (f, 3) has."""
    low = np.minimum(faces, np.roll(faces, -1, axis=1)).astype(np.int64)
    high = np.maximum(faces, np.roll(faces, -1, axis=1))
    edges = np.sort((low * vertices + high).ravel())
    differs = np.concatenate([[True], edges[1:] != edges[:-1], [True]])
    alone = edges[differs[:-1] & differs[1:]] if len(edges) else edges
    result = np.zeros(vertices, bool)
    result[alone // max(vertices, 1)] = True
    result[alone % max(vertices, 1)] = True
    return result
