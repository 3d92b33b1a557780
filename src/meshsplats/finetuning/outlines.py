"""Opaque fans as polygons of few triangles, for a budget (``opaque_share``).

A blended fan needs its centre, where it is most opaque. An opaque one needs only its outline: n corners are
n - 2 triangles, and most splats look much the same with three or four.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshsplats.scene.face_splats import FaceSplats
from meshsplats.scene.mesh import SplatMesh

BEHIND = 0.1
"""Estimated squared difference, summed over RGB, between a splat and what shows where it no longer is."""
MAX_CORNERS = 128
"""Greatest number of corners of an outline; those of fans have up to 64."""
MAX_GROWTH = 2.0
"""Greatest factor by which a polygon grows to keep its area when it loses corners."""


def fewer_triangles(mesh: SplatMesh, hits: np.ndarray, most: int, fewest: int = 0) -> SplatMesh:
    """``mesh`` with at most ``most`` triangles, so that its images change little.

    In steps, a fan, the connected triangles of a splat, becomes the polygon of its outline, polygons of the
    same area with fewer and fewer corners, a triangle, and nothing. The cost of a step is estimated by the
    number of samples that it changes, times their squared difference in colour. Those with the least cost per
    triangle are taken. Of a fan whose outline is not a single loop, or that shares vertices with other
    splats, each triangle counts as a fan.

    Args:
        mesh: opaque triangles. Without ``face_splat``, each counts as a splat.
        hits: (f,) number of samples at which each triangle is in front.
        most: number of triangles.
        fewest: fans that are in front at fewer samples go in any case.
    """
    fan, loops = _fans(mesh.splats)
    samples = np.bincount(fan, hits, len(loops))
    hidden = samples < fewest
    seen = ~hidden[fan]
    if seen.sum() <= most:
        return mesh.take(seen)
    polygons = _polygons(mesh, fan, loops)
    _, starts, counts = np.unique(fan, return_index=True, return_counts=True)

    # All steps, as columns: fan, saved triangles, cost.
    fans, saved, costs = [], [], []
    for polygon in polygons:
        fans.append(np.repeat(polygon.fans, polygon.shares.shape[1] + 1))
        outline = counts[polygon.fans] - polygon.drawn.sum(axis=1)
        saved.append(np.column_stack([outline, polygon.drawn]).ravel())
        changed = np.column_stack([polygon.colors, BEHIND * polygon.shares])
        costs.append((samples[polygon.fans, None] * changed).ravel())
    owner, saving = np.concatenate(fans), np.concatenate(saved)
    # What is hidden goes before all that costs nothing.
    price = np.where(hidden[owner], -1, np.concatenate(costs) / np.maximum(saving, 1))
    order = np.argsort(owner, kind="stable")  # the steps of a fan stay in their order
    owner, saving, price = owner[order], saving[order], price[order]
    price = _running_maxima(price, owner)
    order = np.argsort(price, kind="stable")
    left = len(mesh.faces) - np.cumsum(saving[order])
    taken = np.bincount(owner[order[: 1 + np.argmax(left <= most)]], minlength=len(starts))
    return _assembled(mesh, fan, starts, polygons, taken)


def _fans(splats: FaceSplats) -> tuple[np.ndarray, np.ndarray]:
    """(f,) index of the fan of each triangle, in the order of their first triangles; and (fans, n) the vertex
    indices around each fan, then -1."""
    faces = splats.faces
    connected = _connected(faces, splats.of_face)
    _, fan = np.unique(connected, return_inverse=True)
    loops = _loops(splats, fan)
    single = loops[fan, 0] < 0
    present, result = np.unique(np.where(single, np.arange(len(faces)), connected), return_inverse=True)
    around = np.full((len(present), loops.shape[1]), -1)
    around[result[~single]] = loops[fan[~single]]
    around[result[single], :3] = faces[single]
    return result, around


def _connected(faces: np.ndarray, splat: np.ndarray) -> np.ndarray:
    """(f,) index of the first of the triangles that each one is connected with by vertices of its splat."""
    keys = (splat[:, None].astype(np.int64) * (int(faces.max(initial=0)) + 1) + faces).ravel()
    _, corner = np.unique(keys, return_inverse=True)
    order = np.argsort(corner, kind="stable")
    starts = np.flatnonzero(np.diff(corner[order], prepend=-1))
    corner = corner.reshape(-1, 3)
    fan = np.arange(len(faces))
    while len(fan):
        lowest = np.minimum.reduceat(fan[order // 3], starts)
        found = lowest[corner].min(axis=1)
        found = found[found]
        if np.array_equal(found, fan):
            break
        fan = found
    return fan


@dataclass(frozen=True, eq=False)
class _Polygons:
    """The outlines of m fans, of n corners each."""

    fans: np.ndarray
    """(m,) their places among all fans."""
    corners: np.ndarray
    """(m, n) vertex indices, around each."""
    lasts: np.ndarray
    """(m, n) int: in which step each corner goes; the last three go together."""
    ears: np.ndarray
    """(m, n - 2, 3) vertex indices of the triangles that are cut off, one in each step."""
    drawn: np.ndarray
    """(m, n - 2) bool: not the triangles of reflex corners, which lie outside of the polygon."""
    areas: np.ndarray
    """(m, n - 2) area of the polygon before each step, in square scene units."""
    shares: np.ndarray
    """(m, n - 2) share of that area which is cut off, 0 to 1."""
    colors: np.ndarray
    """(m,) mean squared difference in colour without the vertices inside."""


def _polygons(mesh: SplatMesh, fan: np.ndarray, loops: np.ndarray) -> list[_Polygons]:
    """The outlines of all fans, by their number of corners."""
    inside = _inner_difference(mesh, fan, loops)
    lengths = (loops >= 0).sum(axis=1)
    result = []
    for n in np.unique(lengths):
        fans = np.flatnonzero(lengths == n)
        result.append(_with_ears(mesh.vertices, fans, loops[fans, :n], inside[fans]))
    return result


def _loops(splats: FaceSplats, fan: np.ndarray) -> np.ndarray:
    """(fans, 3 or more) vertex indices around each fan, then -1; only -1 where there is no single loop or a
    vertex belongs to several splats."""
    faces, vertices = splats.faces, splats.vertex_count
    count = int(fan.max(initial=-1)) + 1
    regular = np.ones(count, bool)
    regular[fan[splats.shared[faces].any(axis=1)]] = False

    tails, heads = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel()
    keys = tails * vertices + heads
    edges = np.flatnonzero(~np.isin(keys, heads.astype(np.int64) * vertices + tails))
    edge_fan = fan[edges // 3]
    following = np.full(vertices, -1)
    following[tails[edges]] = heads[edges]
    several = np.bincount(tails[edges], minlength=vertices) > 1
    regular[edge_fan[several[tails[edges]]]] = False
    lengths = np.bincount(edge_fan, minlength=count)
    regular &= (lengths >= 3) & (lengths <= MAX_CORNERS)

    first = np.zeros(count, np.int64)
    first[edge_fan] = tails[edges]
    loops = np.full((count, lengths[regular].max(initial=3)), -1)
    here = first.copy()
    for step in range(loops.shape[1]):
        on = regular & (step < lengths)
        loops[on, step] = here[on]
        here[on] = following[here[on]]
        # One loop returns to its first corner after all of them, not before.
        regular &= ~on | (here >= 0) & ((here == first) == (step == lengths - 1))
    loops[~regular] = -1
    return loops


def _inner_difference(mesh: SplatMesh, fan: np.ndarray, loops: np.ndarray) -> np.ndarray:
    """(fans,) mean squared difference in colour, summed over RGB, between a fan and a polygon without its
    inner vertices, whose corners are adapted: on a cone, an eighteenth of that at the tip, the mean square
    of what differs from its mean."""
    rgb = mesh.colors[:, :3].astype(np.float64)
    around = np.zeros(len(rgb), bool)
    around[loops[loops >= 0]] = True
    owner = np.full(len(rgb), -1)
    owner[mesh.faces] = fan[:, None]
    rim, inner = np.flatnonzero(around), np.flatnonzero(~around & (owner >= 0))

    def means(vertices: np.ndarray, values: np.ndarray) -> np.ndarray:
        sums = np.bincount(owner[vertices], values, len(loops))
        return sums / np.maximum(np.bincount(owner[vertices], minlength=len(loops)), 1)

    mean = np.stack([means(rim, rgb[rim, channel]) for channel in range(3)], axis=1)
    return means(inner, np.square(rgb[inner] - mean[owner[inner]]).sum(axis=1)) / 18


def _with_ears(vertices: np.ndarray, fans: np.ndarray, corners: np.ndarray, colors: np.ndarray) -> _Polygons:
    """Cuts off one corner after another, the one whose triangle with its neighbours is smallest."""
    m, n = corners.shape
    rows = np.arange(m)
    points = vertices[corners].astype(np.float64)
    spokes = points - points[:, :1]
    normal = np.cross(spokes[:, 1:-1], spokes[:, 2:]).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    lasts = np.full((m, n), n - 3)
    left = np.tile(np.arange(n), (m, 1))
    ears, signed = np.empty((m, n - 2, 3), np.int64), np.empty((m, n - 2))
    for step in range(n - 2):
        before, after = np.roll(left, 1, axis=1), np.roll(left, -1, axis=1)
        here, back, ahead = (points[rows[:, None], index] for index in (left, before, after))
        area = 0.5 * np.einsum("mki,mi->mk", np.cross(here - back, ahead - here), normal)
        cut = area.argmin(axis=1)
        ears[:, step] = np.stack([index[rows, cut] for index in (before, left, after)], axis=1)
        signed[:, step] = area[rows, cut]
        if step < n - 3:
            lasts[rows, left[rows, cut]] = step
            keep = np.ones(left.shape, bool)
            keep[rows, cut] = False
            left = left[keep].reshape(m, -1)
    areas = np.cumsum(signed[:, ::-1], axis=1)[:, ::-1]
    drawn = signed > 0
    shares = np.clip(np.where(drawn, signed, 0) / np.maximum(areas, 1e-300), 0, 1)
    triangles = corners[rows[:, None, None], ears]
    return _Polygons(fans, corners, lasts, triangles, drawn, areas, shares, colors)


def _running_maxima(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """The greatest of ``values`` up to each one in its group; groups are sorted."""
    ranks = np.empty(len(values), np.int64)
    order = np.argsort(values, kind="stable")
    ranks[order] = np.arange(len(values))
    top = np.maximum.accumulate(ranks + groups.astype(np.int64) * len(values))
    return values[order][top - groups * len(values)]


def _assembled(
    mesh: SplatMesh, fan: np.ndarray, starts: np.ndarray, polygons: list[_Polygons], taken: np.ndarray
) -> SplatMesh:
    """``mesh`` after as many steps of each fan as ``taken`` says. Its triangles begin at ``starts``."""
    same = taken[fan] == 0
    faces, owners = [mesh.faces[same]], [fan[same]]
    vertices = mesh.vertices.copy()
    for polygon in polygons:
        done = np.flatnonzero(taken[polygon.fans] > 0)
        lost = taken[polygon.fans[done]] - 1
        step = np.arange(polygon.ears.shape[1])
        rows, columns = np.nonzero(polygon.drawn[done] & (step >= lost[:, None]))
        faces.append(polygon.ears[done[rows], columns])
        owners.append(polygon.fans[done[rows]])
        shrunk = np.flatnonzero((lost > 0) & (lost < len(step)))
        _keep_area(vertices, polygon, done[shrunk], lost[shrunk])
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    owner = owner[order]
    grown = replace(mesh, vertices=vertices, normals=None)
    return grown.with_faces(np.concatenate(faces)[order].astype(np.int32), starts[owner])


def _keep_area(vertices: np.ndarray, polygon: _Polygons, rows: np.ndarray, lost: np.ndarray) -> None:
    """Moves the remaining corners of the polygons ``rows`` away from their middle, in place."""
    areas = polygon.areas[rows]
    ratio = areas[:, 0] / np.maximum(areas[np.arange(len(rows)), lost], 1e-300)
    growth = np.minimum(np.sqrt(np.maximum(ratio, 1)), MAX_GROWTH)
    corners = polygon.corners[rows]
    stays = polygon.lasts[rows] >= lost[:, None]
    points = vertices[corners].astype(np.float64)
    middle = (points * stays[..., None]).sum(axis=1) / stays.sum(axis=1)[:, None]
    moved = middle[:, None] + growth[:, None, None] * (points - middle[:, None])
    vertices[corners[stays]] = moved[stays].astype(np.float32)
