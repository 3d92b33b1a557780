"""Closed surfaces whose edges belong to two triangles each, as slicers and solid modellers want them."""

from __future__ import annotations

import numpy as np

_ROUNDS = 20
"""Most passes over edges that are cut; one is enough where none share a triangle."""


def split_pinches(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A closed mesh, (n, 3) vertices and (m, 3) triangles, as one whose edges belong to two triangles each.

    Edge collapses pinch a surface: four triangles or more meet at an edge. They are paired around it so that
    the inside lies between the triangles of a pair, and every sheet gets vertices of its own. Sheets that
    also meet at both ends of the edge are cut there in its middle. Triangles that lie back to back on the
    same corners are removed. No point of the surface moves.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces = _without_flaps(faces)
    one, other = _pairs(vertices, faces).T  # half edges: 3 * face + corner of the tail
    tails = faces.ravel()
    after = np.roll(np.arange(3 * len(faces)).reshape(-1, 3), -1, axis=1).ravel()
    same = tails[one] == tails[other]  # of one direction: tail with tail
    first = np.concatenate([one, after[one]])
    second = np.concatenate([np.where(same, other, after[other]), np.where(same, after[other], other)])
    links = coo_matrix((np.ones(len(first), bool), (first, second)), (3 * len(faces), 3 * len(faces)))
    sheets = connected_components(links, directed=False)[1]
    _, place, index = np.unique(sheets, return_index=True, return_inverse=True)
    return _cut(vertices[faces.ravel()[place]], index.reshape(-1, 3).astype(faces.dtype))


def _without_flaps(faces: np.ndarray) -> np.ndarray:
    """The triangles without pairs that have the same corners, so nothing between them."""
    _, index, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    return faces[count[index.reshape(-1)] % 2 == 1]


def _cut(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with a vertex of its own for each sheet in the middle of every edge where several meet."""
    whole, points = faces.tolist(), [*vertices]
    most = len(faces)
    for _ in range(_ROUNDS):
        at_start, places = _without_flaps(np.array(whole)), np.array(points)
        whole = at_start.tolist()
        _, groups = _edges(at_start)
        if not 0 < len(groups) < most:  # done, or no longer getting better
            break
        most = len(groups)
        touched: set[int] = set()
        for halves in groups:
            pairs = _paired(places, at_start, halves) // 3
            if touched & set(pairs.ravel().tolist()):
                continue  # in the next round
            touched |= set(pairs.ravel().tolist())
            face, at = divmod(int(halves[0]), 3)
            ends = {whole[face][at], whole[face][(at + 1) % 3]}
            for pair in pairs.tolist():
                points.append(np.mean([points[end] for end in ends], axis=0))
                for index in pair:
                    tail = next(
                        k for k in range(3) if whole[index][k] in ends and whole[index][k - 2] in ends
                    )
                    a, b, c = (whole[index][(tail + k) % 3] for k in range(3))
                    whole[index] = [a, len(points) - 1, c]
                    whole.append([len(points) - 1, b, c])
    used, index = np.unique(np.array(whole), return_inverse=True)
    return np.array(points)[used], index.reshape(-1, 3).astype(faces.dtype)


def _edges(faces: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """(k, 2) pairs of half edges at edges of two triangles, and the half edges of each other edge."""
    tails, heads = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    key = np.minimum(tails, heads) * (int(faces.max(initial=0)) + 1) + np.maximum(tails, heads)
    order = np.argsort(key, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(key[order])) + 1, len(key))
    starts = np.append(0, ends[:-1])
    two = ends - starts == 2
    pairs = np.stack([order[starts[two]], order[starts[two] + 1]], axis=1)
    rest = zip(starts[~two].tolist(), ends[~two].tolist(), strict=True)
    return pairs, [order[start:end] for start, end in rest]


def _pairs(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(k, 2) pairs of half edges at which the surface goes on."""
    pairs, groups = _edges(faces)
    return np.concatenate([pairs, *(_paired(vertices, faces, halves) for halves in groups)])


def _paired(vertices: np.ndarray, faces: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """(k, 2) pairs of the half edges ``halves``, which lie at one edge."""
    if len(halves) % 2 or len(halves) < 2:
        return np.empty((0, 2), np.int64)
    face, at = np.divmod(halves, 3)
    tail, head = faces[face, at], faces[face, (at + 1) % 3]
    a, b = int(min(tail[0], head[0])), int(max(tail[0], head[0]))
    axis = vertices[b] - vertices[a]
    axis = axis / (np.linalg.norm(axis) or 1.0)
    side = vertices[faces[face, (at + 2) % 3]] - vertices[a]
    side = side - np.outer(side @ axis, axis)
    up = np.cross(axis, side[0])
    angle = np.arctan2(side @ up, (side @ side[0]) * (np.linalg.norm(up) / (np.linalg.norm(side[0]) or 1.0)))
    around = np.argsort(angle, kind="stable")
    ahead = tail[around] == a
    # Seen along the edge, the inside lies behind a triangle that runs ahead and before one that runs back.
    result, used = [], np.zeros(len(around), bool)
    for k in np.flatnonzero(ahead).tolist():
        before = [(k - step) % len(around) for step in range(1, len(around))]
        back = next((j for j in before if not ahead[j] and not used[j]), None)
        if back is not None:
            used[back] = True
            result.append((halves[around[k]], halves[around[back]]))
    return np.array(result, np.int64).reshape(-1, 2)
