"""Which vertices lie on a mesh's open edges: the rims of fans."""

from __future__ import annotations

import numpy as np


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
