"""Closed surfaces as slicers and solid modellers want them: edges of two triangles, wherever they look."""

from __future__ import annotations

import numpy as np

from meshsplats._common.geometry import edge_groups, vertex_normals
from meshsplats.surfaces.fusion import collapsed, parts_of

_ROUNDS = 20
"""Most passes over edges that are cut, over vertices that are moved apart, and of collapses."""
_APART = 0.005
"""How far vertices at one place move apart, relative to the edges there: much less than a voxel..."""
_STEPS = 8
"""...but at least so many steps of float32, which files have, so that no turn or scale joins them again."""
_FLAT = 1e-6
"""Mean of the directions of the edges around a vertex below which they point nowhere."""
_CRUMB = 1e-3
"""Parts with a smaller volume, relative to the largest, were pinched off, and are removed."""
_KEPT = 0.7
"""Share of the volume that is left of a surface that is collapsed again for having too many triangles: below
that it would lose whole parts."""


def simplified(
    vertices: np.ndarray, faces: np.ndarray, count: int, *, closed: bool
) -> tuple[np.ndarray, np.ndarray]:
    """A mesh, (n, 3) vertices and (m, 3) triangles, with about ``count`` triangles; 0: with all of them. A
    closed one is ``solid``, which may take a few more triangles, so fewer are aimed at."""
    fewer = 0 < count < len(faces)
    if not closed:
        return collapsed(vertices, faces, count) if fewer else (vertices, faces)
    if not fewer:
        return solid(vertices, faces)
    aim, least = count, 0.0
    for _ in range(_ROUNDS):
        made = solid(*collapsed(vertices, faces, aim))
        if not (len(made[1]) or least) and 2 * aim < len(faces):  # nothing is left of it
            aim *= 2
            continue
        if not 0 < len(made[1]) < len(faces) or _volume(*made) < least:  # no fewer, or not this shape
            break
        vertices, faces = made
        least = least or _KEPT * _volume(vertices, faces)
        if len(faces) <= count:
            break
        aim = max(4, count - min(len(faces) - count, count // 20))
    return (vertices, faces) if least else solid(vertices, faces)


def solid(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A closed mesh, (n, 3) vertices and (m, 3) triangles, as one whose edges belong to two triangles each,
    once in each direction, and whose vertices are at different places.

    Edge collapses pinch a surface: four triangles or more meet at an edge. They are paired around it so that
    the inside lies between the triangles of a pair, and every sheet gets vertices of its own. Sheets that
    also meet at both ends of the edge are cut there in its middle. Triangles back to back enclose nothing and
    are left out; so are parts that face inwards, and crumbs that were pinched off.
    """
    for _ in range(_ROUNDS):
        faces = _without_flakes(faces)
        if not len(faces):
            return vertices[:0], faces
        vertices, faces = _fans(vertices, faces)
        crowded = _edges(faces)[1]
        if not crowded:
            break
        vertices, faces = _cut(vertices, faces, crowded)
    vertices, faces = _large_solids(vertices, faces)
    return apart(vertices, faces), faces


def apart(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(n, 3) float64 vertices of a solid, of which none are at one place as float32.

    Those that were have moved a little towards their neighbours, into the solid or, where hollows touch, into
    these: away from each other. The one whose triangles reach around most stays.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    places, count = vertices.astype(np.float64), len(vertices)
    least = _STEPS * 2.0**-24 * float(np.abs(places).max(initial=0))
    tails, heads = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    for attempt in range(_ROUNDS):
        near = cKDTree(places).query_pairs(least, output_type="ndarray")
        if not len(near):
            break
        links = coo_matrix((np.ones(len(near), bool), (near[:, 0], near[:, 1])), (count, count))
        found = np.unique(near)
        place = connected_components(links, directed=False)[1][found]
        leaving = np.isin(tails, found)
        at, edges = tails[leaving], places[heads[leaving]] - places[tails[leaving]]
        lengths = np.linalg.norm(edges, axis=1)
        shortest = np.full(count, np.inf)
        np.minimum.at(shortest, at, lengths)
        edges /= np.maximum(lengths, least)[:, None]
        mean = np.stack([np.bincount(at, edges[:, k], count)[found] for k in range(3)], axis=1)
        mean /= np.bincount(at, minlength=count)[found][:, None]
        size = np.linalg.norm(mean, axis=1)
        flat = size < _FLAT
        mean[flat] = -vertex_normals(places, faces)[found[flat]]
        order = np.lexsort((size, place))
        rank = np.empty(len(found))
        rank[order] = np.arange(len(found)) - np.searchsorted(place[order], place[order])
        step = rank * np.maximum(_APART * shortest[found], 2 * least * (attempt + 1))
        places[found] += mean * (step / np.where(flat, 1, size))[:, None]
    return places


def _without_flakes(faces: np.ndarray) -> np.ndarray:
    """The triangles without those that have a vertex twice, and without pairs back to back."""
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _, index, counts = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    first, row = np.argmin(faces, axis=1), np.arange(len(faces))  # the turn from there tells the winding
    ahead = faces[row, (first + 1) % 3] < faces[row, (first + 2) % 3]
    order, kept = np.lexsort((ahead, index)), np.ones(len(faces), bool)
    starts = np.cumsum(counts) - counts
    for k in np.flatnonzero(counts > 1).tolist():
        group = order[starts[k] : starts[k] + counts[k]]
        pairs = min(int(ahead[group].sum()), int((~ahead[group]).sum()))
        kept[group[:pairs]] = kept[group[len(group) - pairs :]] = False
    return faces[kept]


def _fans(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with a vertex for each fan of triangles that go on at their edges."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    one, other = _pairs(vertices, faces).T  # half edges: 3 * face + corner of the tail
    tails = faces.ravel()
    after = np.roll(np.arange(3 * len(faces)).reshape(-1, 3), -1, axis=1).ravel()
    same = tails[one] == tails[other]  # of one direction: tail with tail
    first = np.concatenate([one, after[one]])
    second = np.concatenate([np.where(same, other, after[other]), np.where(same, after[other], other)])
    links = coo_matrix((np.ones(len(first), bool), (first, second)), (3 * len(faces), 3 * len(faces)))
    fans = connected_components(links, directed=False)[1]
    _, place, index = np.unique(fans, return_index=True, return_inverse=True)
    return vertices[tails[place]], index.reshape(-1, 3).astype(faces.dtype)


def _cut(vertices: np.ndarray, faces: np.ndarray, crowded: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with a vertex of its own for each sheet in the middle of the edges where several meet, given
    by their half edges; of those that share a triangle, of one."""
    whole, points = faces.tolist(), [*vertices]
    touched: set[int] = set()
    for halves in crowded:
        pairs = _paired(vertices, faces, halves) // 3
        if touched & set(pairs.ravel().tolist()):
            continue  # in the next round
        touched |= set(pairs.ravel().tolist())
        face, at = divmod(int(halves[0]), 3)
        ends = {whole[face][at], whole[face][(at + 1) % 3]}
        for pair in pairs.tolist():
            points.append(np.mean([points[end] for end in ends], axis=0))
            for index in pair:
                tail = next(k for k in range(3) if whole[index][k] in ends and whole[index][k - 2] in ends)
                a, b, c = (whole[index][(tail + k) % 3] for k in range(3))
                whole[index] = [a, len(points) - 1, c]
                whole.append([len(points) - 1, b, c])
    return np.array(points), np.array(whole, faces.dtype).reshape(-1, 3)


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    return float(_cones(vertices, faces).sum())


def _cones(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(m,) signed volumes between triangles and the middle of their vertices."""
    return np.linalg.det(vertices[faces] - vertices.mean(axis=0)) / 6


def _large_solids(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The parts of a closed mesh that enclose something, and not much less than the largest."""
    part = parts_of(faces, len(vertices))
    volumes = np.bincount(part, _cones(vertices, faces))
    kept = faces[volumes[part] > _CRUMB * max(volumes.max(), 0)]
    used, index = np.unique(kept, return_inverse=True)
    return vertices[used], index.reshape(-1, 3).astype(faces.dtype)


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
