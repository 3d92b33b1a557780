"""Edited bases as programs export them: which vertex is which, and whether axes were exchanged."""

from __future__ import annotations

from collections import Counter
from itertools import permutations, product

import numpy as np

from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.binding import Binding

_CLOSE = 0.1
"""Largest distance of the vertices from those of a base with other axes, relative to its size, and to the
distance from the base itself: less than most poses, more than rounding."""
_UNITS = 10.0 ** np.array([-3, -2, 0, 2, 3])
"""Factors between the units of programs."""

_MOST_TRIANGLES = 1000
"""Of a polygon that is recognised by its outline."""

_SIGNS = np.array(list(product((1, -1), repeat=3)))


def matched_vertices(binding: Binding, base: BaseMesh) -> np.ndarray:
    """(n, 3) float32 positions in the edited ``base`` of the n vertices that the ``binding`` has.

    Its vertices are in the same order, with the same triangles in any order and from any corner, or with the
    same polygons in the same order, which readers may cut otherwise in another pose; or its triangles are in
    the same order, whatever an exporter has made of its vertices, which are split at seams.

    Raises ValueError where neither is so.
    """
    expected, found = binding.base_faces, base.faces
    n, count = len(binding.base_vertices), len(base.vertices)
    advice = "move its vertices only, and export them in their order: .obj, or .ply without UVs"
    if len(expected) != len(found):
        raise ValueError(
            f"the edited base has {count:,} vertices and {len(found):,} triangles, the splats"
            f" are bound to one of {n:,} and {len(expected):,}: {advice}"
        )
    if count == n and ((_sorted(found) == _sorted(expected)).all() or _cut_otherwise(expected, found)):
        return base.vertices
    place = binding.places[expected].ravel()
    corners = base.vertices[found].reshape(-1, 3)
    first = np.zeros(place.max(initial=0) + 1, np.int64)
    first[place[::-1]] = np.arange(len(place))[::-1]
    if (corners == corners[first[place]]).all():
        result = binding.base_vertices.copy()
        result[expected.ravel()] = corners
        return result
    if count != n:
        raise ValueError(
            f"the edited base has {count:,} vertices, the splats are bound to one of {n:,}, and its triangles"
            f" are in another order: {advice}"
        )
    differ = (expected != found).any(axis=1)
    number = int(differ.argmax())
    raise ValueError(
        f"the edited base has other triangles ({int(differ.sum()):,} of {len(found):,}; the first is"
        f" number {number}, {found[number].tolist()} instead of {expected[number].tolist()}): {advice}"
    )


def _sorted(faces: np.ndarray) -> np.ndarray:
    """(m, 3) the triangles, each from its first vertex on, in ascending order."""
    turned = _turned(faces)
    return turned[np.lexsort(turned.T)]


def _turned(faces: np.ndarray) -> np.ndarray:
    """(m, 3) the triangles, each from its first vertex on."""
    start = faces.argmin(axis=1)[:, None]
    return np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1)


def _cut_otherwise(expected: np.ndarray, found: np.ndarray) -> bool:
    """Whether triangles (m, 3) and (m, 3) are of the same polygons in the same order, cut along some other
    diagonals."""
    first, after = None, 0
    open_edges: Counter[tuple[int, int]] = Counter()
    for row in np.flatnonzero((_turned(expected) != _turned(found)).any(axis=1)).tolist():
        # Triangles that both cuts of a polygon have change nothing, wherever they stand.
        first = row if first is None else first
        for triangle, sign in ((expected[row].tolist(), 1), (found[row].tolist(), -1)):
            for a, b in zip(triangle, triangle[1:] + triangle[:1], strict=True):
                edge = (min(a, b), max(a, b))
                open_edges[edge] += sign if a < b else -sign
                if not open_edges[edge]:
                    del open_edges[edge]
        after = row + 1
        if after - first > _MOST_TRIANGLES:
            return False
        if not open_edges:  # all of a polygon, whose k triangles have k + 2 corners
            one, other = set(expected[first:after].ravel().tolist()), set(found[first:after].ravel().tolist())
            if one != other or len(one) != after - first + 2:
                return False
            first = None
    return first is None


def exchanged_axes(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, float]:
    """The exchange of axes, a (3, 3) rotation, and the factor between units by which another program put
    vertices ``before`` (n, 3) to about ``after`` (n, 3); the identity and 1 where it did not."""
    old, new = before.astype(np.float64), after.astype(np.float64)
    size = np.square(old).sum()
    mixed = new.T @ old
    same = np.eye(3), 1.0
    if not size or not mixed.any():
        return same

    def distance(turn: np.ndarray, scale: float) -> float:
        return float(np.sqrt(np.square(new - scale * old @ turn.T).sum() / size) / scale)

    turns = [same[0][list(axes)] * signs for axes in permutations(range(3)) for signs in _SIGNS]
    turn = max((t for t in turns if np.linalg.det(t) > 0), key=lambda t: float((t * mixed).sum()))
    scale = float(_UNITS[np.abs(np.log(_UNITS * size / max(float((turn * mixed).sum()), 1e-300))).argmin()])
    if distance(turn, scale) > _CLOSE * min(1, distance(*same)):
        return same
    return turn, scale


def in_words(turn: np.ndarray, scale: float) -> str:
    """``exchanged_axes`` in a message; "" for the identity and 1."""
    said = []
    if (turn != np.eye(3)).any():
        axes = ", ".join(("-" if row.min() < 0 else "") + "xyz"[np.abs(row).argmax()] for row in turn)
        said.append(f"its x, y, z are {axes} of the base that the splats are bound to")
    if scale != 1:
        said.append(f"it is {scale:g} times as large")
    return " and ".join(said)
