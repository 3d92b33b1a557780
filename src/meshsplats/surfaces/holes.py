"""Holes of open surfaces."""

from __future__ import annotations

import numpy as np

LARGEST = 0.15
"""Longest border of a hole that is closed, relative to the diagonal of the surface's box: longer ones are the
rim of what was seen."""


def close_holes(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A mesh, (n, 3) vertices and (m, 3) triangles, with its small holes closed by fans around their middles.

    Borders that touch themselves are left open.
    """
    tails, heads = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    key, back = tails * len(vertices) + heads, heads * len(vertices) + tails
    rim = ~np.isin(key, back)
    # Along a hole its border runs against the triangles around it.
    first, last = heads[rim], tails[rim]
    single = np.bincount(first, minlength=len(vertices)) == 1
    following = np.full(len(vertices), -1, np.int64)
    following[first] = last
    most = LARGEST * float(np.linalg.norm(np.ptp(vertices, axis=0))) if len(vertices) else 0.0
    points, fans = [vertices], [faces]
    count, seen = len(vertices), np.zeros(len(vertices), bool)
    for start in first.tolist():
        loop = []
        at = start
        while at >= 0 and single[at] and not seen[at]:
            seen[at] = True
            loop.append(at)
            at = int(following[at])
        if at != start or len(loop) < 3:
            continue
        border = vertices[loop]
        if np.linalg.norm(border - np.roll(border, 1, axis=0), axis=1).sum() > most:
            continue
        if len(loop) == 3:
            fans.append(np.array([loop], faces.dtype))
            continue
        points.append(border.mean(axis=0, keepdims=True))
        ahead = np.roll(loop, -1)
        fans.append(np.stack([loop, ahead, np.full(len(loop), count)], axis=1).astype(faces.dtype))
        count += 1
    return np.concatenate(points), np.concatenate(fans)
