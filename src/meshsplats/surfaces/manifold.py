"""Closed surfaces whose edges belong to two triangles each, as slicers and solid modellers want them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshsplats._geometry import edge_groups

_ROUNDS = 20
"""Most passes over edges that are cut; one is enough where none share a triangle."""


class Sheets(NamedTuple):
    """A mesh whose edges belong to two triangles each."""

    vertices: np.ndarray
    """(n, 3)."""
    faces: np.ndarray
    """(m, 3)."""
    corners: np.ndarray
    """(m, 3, k) values of the corners of the triangles, such as texture coordinates."""


def split_pinches(vertices: np.ndarray, faces: np.ndarray, corners: np.ndarray | None = None) -> Sheets:
    """A closed mesh, (n, 3) vertices and (m, 3) triangles with values ``corners`` (m, 3, k), as one whose
    edges belong to two triangles each.

    Edge collapses pinch a surface: four triangles or more meet at an edge. They are paired around it so that
    the inside lies between the triangles of a pair, and every sheet gets vertices of its own. Sheets that
    also meet at both ends of the edge are cut there in its middle. Triangles that lie back to back, of a
    sheet without thickness, become a pair of their own. No point of the surface moves.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    values = np.empty((len(faces), 3, 0)) if corners is None else corners
    back_to_back = _back_to_back(faces)
    thin = _apart(vertices, faces, values, back_to_back)
    solid = np.ones(len(faces), bool)
    solid[back_to_back.ravel()] = False
    faces, values = faces[solid], values[solid]
    one, other = _pairs(vertices, faces).T  # half edges: 3 * face + corner of the tail
    tails = faces.ravel()
    after = np.roll(np.arange(3 * len(faces)).reshape(-1, 3), -1, axis=1).ravel()
    same = tails[one] == tails[other]  # of one direction: tail with tail
    first = np.concatenate([one, after[one]])
    second = np.concatenate([np.where(same, other, after[other]), np.where(same, after[other], other)])
    links = coo_matrix((np.ones(len(first), bool), (first, second)), (3 * len(faces), 3 * len(faces)))
    sheets = connected_components(links, directed=False)[1]
    _, place, index = np.unique(sheets, return_index=True, return_inverse=True)
    parts = _cut(vertices[faces.ravel()[place]], index.reshape(-1, 3).astype(faces.dtype), values)
    return _joined([*parts, thin])


def _joined(parts: list[Sheets]) -> Sheets:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return Sheets(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]).astype(
            parts[0].faces.dtype
        ),
        np.concatenate([part.corners for part in parts]),
    )


def _back_to_back(faces: np.ndarray) -> np.ndarray:
    """(k, 2) pairs of triangles that have the same corners and face opposite ways."""
    if not len(faces):
        return np.empty((0, 2), np.int64)
    _, index, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(index.reshape(-1), kind="stable")
    starts = np.cumsum(count) - count
    pairs = np.stack([order[starts[count == 2]], order[starts[count == 2] + 1]], axis=1)
    first = np.argmin(faces[pairs], axis=2)[..., None]  # the turn from the least corner tells the winding
    ahead = np.take_along_axis(faces[pairs], (first + 1) % 3, axis=2)[..., 0]
    return pairs[ahead[:, 0] != ahead[:, 1]]


def _apart(vertices: np.ndarray, faces: np.ndarray, values: np.ndarray, pairs: np.ndarray) -> Sheets:
    """The triangles of ``pairs``, each pair with three vertices of its own."""
    chosen = faces[pairs]
    rank = np.argsort(np.argsort(chosen, axis=2), axis=2)
    return Sheets(
        vertices[np.sort(chosen[:, 0], axis=1).ravel()],
        (rank + 3 * np.arange(len(pairs))[:, None, None]).reshape(-1, 3).astype(faces.dtype),
        values[pairs].reshape(2 * len(pairs), *values.shape[1:]),
    )


def _cut(vertices: np.ndarray, faces: np.ndarray, values: np.ndarray) -> list[Sheets]:
    """The mesh with a vertex of its own for each sheet in the middle of every edge where several meet, and
    the triangles that then lie back to back."""
    whole, points, corners = faces.tolist(), [*vertices], [*values]
    thin, most = [], len(faces)
    for _ in range(_ROUNDS):
        now, places, held = np.array(whole, faces.dtype).reshape(-1, 3), np.array(points), np.array(corners)
        back_to_back = _back_to_back(now)
        if len(back_to_back):
            thin.append(_apart(places, now, held, back_to_back))
            kept = np.ones(len(now), bool)
            kept[back_to_back.ravel()] = False
            now, held = now[kept], held[kept]
            whole, corners = now.tolist(), [*held]
        _, groups = _edges(now)
        if not 0 < len(groups) < most:  # done, or no longer getting better
            break
        most = len(groups)
        touched: set[int] = set()
        for halves in groups:
            pairs = _paired(places, now, halves) // 3
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
                    at_a, at_b, at_c = (corners[index][(tail + k) % 3] for k in range(3))
                    middle = (at_a + at_b) / 2
                    whole[index], corners[index] = [a, len(points) - 1, c], np.stack([at_a, middle, at_c])
                    whole.append([len(points) - 1, b, c])
                    corners.append(np.stack([middle, at_b, at_c]))
    now = np.array(whole, faces.dtype).reshape(-1, 3)
    used, index = np.unique(now, return_inverse=True)
    rest = np.array(corners).reshape(len(now), *values.shape[1:])
    cut = Sheets(np.array(points)[used], index.reshape(-1, 3).astype(faces.dtype), rest)
    return [cut, *thin]


def _edges(faces: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """(k, 2) pairs of half edges at edges of two triangles, and the half edges of each other edge."""
    order, starts = edge_groups(faces)
    two = np.diff(starts) == 2
    pairs = np.stack([order[starts[:-1][two]], order[starts[:-1][two] + 1]], axis=1)
    rest = np.flatnonzero(~two).tolist()
    return pairs, [order[starts[k] : starts[k + 1]] for k in rest]


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
