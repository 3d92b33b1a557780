"""The order in which viewers that do not sort triangles should blend them, found from many views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.kinds import need, need_all
from meshsplats._core import kernels
from meshsplats._core.library import check_threads
from meshsplats.cameras.trajectories import dome, orbit
from meshsplats.rendering.core_arguments import camera_struct
from meshsplats.rendering.looks import image_of
from meshsplats.rendering.viewers import ordered_image
from meshsplats.scene.camera import Camera
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.face_splats import FaceSplats
from meshsplats.scene.mesh import SplatMesh

VIEWS = 96
"""Largest number of views that an order is solved for."""
SIDE = 200
"""Largest side of their images, pixels."""
SWEEPS = 6
"""How often every piece may move."""
MAX_PAIRS = 22_000_000
"""Pairs of pieces that are kept at most, the heaviest ones: about 1.5 GB at work."""
PAIR_BYTES = 68
"""Memory at work for each of them."""
PAIRS_EACH = 300
"""Pairs of a splat: 150 in a still life, 600 in fog."""
NODES = 8
"""Parts of a mesh by default."""
MAX_NODES = 256
FEW_NODES = (1, 2, 4)
"""What 'auto' tries, besides ``NODES``."""
NODE_LOSS = 0.5
"""Largest loss in dB, of the images against sorted ones, for fewer nodes."""
SCORED_VIEWS = 8
"""Views in which it is measured."""
ROUNDS = 12
"""Of k-means."""
PLANES = 3
"""Largest number of planar pieces of a splat: crossed ellipses have three."""
PLANAR = 0.7
"""Least cosine between the normals of a piece's triangles and of its first one."""


class Pieces(NamedTuple):
    """Planar pieces of splats: an ellipse that is a fan of triangles, or one of several that cross."""

    of_face: np.ndarray
    """(f,) int64 piece of each triangle."""
    turned: np.ndarray
    """(f,) bool: the triangle's winding shows the back of its piece."""
    centers: np.ndarray
    """(p, 3) float64, weighted by area."""
    normals: np.ndarray
    """(p, 3) float64 unit normals."""
    areas: np.ndarray
    """(p,)"""
    splat: np.ndarray
    """(p,) int64, counted from 0."""


def pieces_of(mesh: SplatMesh) -> Pieces:
    """The planar pieces of the splats of ``mesh``: triangles that face one way, or the opposite one, as the
    first triangle does that is in no piece yet."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(cross, axis=1)
    unit = cross / np.maximum(size, 1e-300)[:, None]
    splats = FaceSplats(mesh.faces, mesh.face_splat, len(mesh.vertices))
    splat, f = splats.of_face, len(mesh.faces)
    plane, sign, rest = np.zeros(f, np.int64), np.ones(f), np.arange(f)
    for k in range(PLANES):
        first = np.zeros(len(splats), np.int64)
        first[splat[rest[::-1]]] = rest[::-1]
        cosine = np.einsum("ij,ij->i", unit[rest], unit[first[splat[rest]]])
        taken = (np.abs(cosine) > PLANAR) | (k == PLANES - 1)
        plane[rest[taken]] = k
        sign[rest[taken]] = np.where(cosine[taken] < 0, -1, 1)
        rest = rest[~taken]
        if not len(rest):
            break
    numbers, piece = np.unique(splat * PLANES + plane, return_inverse=True)
    piece, p = piece.reshape(-1), len(numbers)
    weight = size + 1e-300
    total = np.bincount(piece, weight, p)
    middle = corners.mean(axis=1)
    sums = [np.bincount(piece, weight * middle[:, k], p) / total for k in range(3)]
    normals = np.stack([np.bincount(piece, sign * cross[:, k], p) for k in range(3)], axis=1)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    turned = np.einsum("ij,ij->i", cross, normals[piece]) < 0
    return Pieces(piece, turned, np.stack(sums, axis=1), normals, total / 2, numbers // PLANES)


def check_nodes(nodes: int | Literal["auto"]) -> None:
    """ValueError for a number of parts that no order can have."""
    if nodes != "auto" and not (isinstance(nodes, (int, np.integer)) and 1 <= nodes <= MAX_NODES):
        raise ValueError(f"nodes must be a number from 1 to {MAX_NODES}, or 'auto', got {nodes!r}")


def drawing_order(
    mesh: SplatMesh,
    cameras: Sequence[Camera] | None = None,
    *,
    nodes: int | Literal["auto"] = NODES,
    quick: bool = False,
    threads: int | None = None,
) -> DrawOrder:
    """The order in which viewers that cull and do not sort should blend the triangles of ``mesh``: for
    ``save_mesh(mesh, "scene.glb", order=...)``.

    A viewer that culls back faces shows one of the two windings of a triangle, so each has a place of its
    own in the order: two triangles may cover each other one way when seen from here, and the other way from
    behind. The order is solved: pairs of planar pieces of splats that overlap in views are counted by what
    a pixel would lose if the nearer one, by its centre, came first; pieces are moved until little is lost. It
    holds for views like those it is solved for.

    Args:
        mesh: the mesh.
        cameras: where it will be seen from; a few of them are used, at most ``VIEWS``, in small images. By
            default, all around it, from above and below, near and far.
        nodes: number of parts by place, which viewers sort by the middles of their bounds, 1 to
            ``MAX_NODES``; fewer if there are fewer splats. Each is a draw call, and a border where triangles
            may be in the wrong order; but inside them, fewer pairs contradict each other. 'auto': the fewest
            of ``FEW_NODES`` and ``NODES`` that are within ``NODE_LOSS`` dB of the last, which takes up to
            four times as long.
        quick: the order that is the start of the search: by how far outward of the middle a triangle lies
            along its normal. Seconds, and several dB worse.
        threads: at most this many; all processors by default. The result does not depend on it.

    Raises ValueError for a mesh without triangles and a value out of range.
    """
    need(SplatMesh, mesh=mesh)
    need_all(Camera, optional=True, cameras=cameras)
    if not len(mesh.faces):
        raise ValueError("a mesh without triangles has no order")
    check_nodes(nodes)
    check_threads(threads)
    if cameras is not None and not len(cameras):
        raise ValueError("cameras must hold a camera, or be None for views from all around")
    views = default_views(mesh) if cameras is None else subsample(cameras, VIEWS)
    pieces = pieces_of(mesh)

    def ordered(count: int) -> DrawOrder:
        return _order(mesh, pieces, count, None if quick else views, threads)

    if nodes != "auto":
        return ordered(int(nodes))
    # Other views than those that are solved for, where there are others.
    scored = (
        subsample(cameras, SCORED_VIEWS) if cameras else dome(mesh, SCORED_VIEWS, whole=True, distance=0.8)
    )
    scored = [camera.within(SIDE) for camera in scored]
    plain = replace(mesh.plain, order="fragment", filter_px2=0)  # viewers have no filter
    truths = [image_of(plain, camera, (1, 1, 1), threads=threads)[0] for camera in scored]

    def score(order: DrawOrder) -> float:
        """PSNR against sorted triangles."""
        options: dict[str, Any] = {"multisample": False, "threads": threads}
        images = [ordered_image(mesh, order, camera, **options) for camera in scored]
        errors = [np.square(a - b, dtype=np.float64).mean() for a, b in zip(images, truths, strict=True)]
        return float(-10 * np.log10(max(np.mean(errors), 1e-30)))

    best = ordered(NODES)
    least = score(best) - NODE_LOSS
    return next((order for order in map(ordered, FEW_NODES) if score(order) >= least), best)


def ordering_bytes(mesh: SplatMesh) -> int:
    """Memory that ``drawing_order(mesh)`` takes beside the mesh, estimated."""
    return min(PAIRS_EACH * len(mesh.splats), MAX_PAIRS) * PAIR_BYTES


def _order(
    mesh: SplatMesh, pieces: Pieces, count: int, views: Sequence[Camera] | None, threads: int | None
) -> DrawOrder:
    """An order of ``count`` nodes, solved for ``views``; None: by the formula."""
    node = _nodes(mesh, pieces, count)
    rank = _outward(mesh, pieces, node)
    if views is not None:
        rank = solve(mesh, pieces, node, rank, views, threads).rank
    turned = pieces.turned.astype(np.int64)
    units = np.concatenate([2 * pieces.of_face + turned, 2 * pieces.of_face + 1 - turned])
    of_copy = np.tile(node[pieces.of_face], 2)
    copies = np.lexsort((rank[units], of_copy)).astype(np.int32)
    return DrawOrder(copies, np.searchsorted(of_copy[copies], np.arange(node.max() + 2)))


def default_views(mesh: SplatMesh) -> list[Camera]:
    """Views of ``mesh`` from all around."""
    return [
        *dome(mesh, VIEWS // 2, whole=True, width=SIDE, height=SIDE),
        *orbit(mesh, VIEWS // 4, elevation=18, width=SIDE, height=SIDE),  # as things are mostly looked at
        *dome(mesh, VIEWS // 4, whole=True, distance=0.5, width=SIDE, height=SIDE),
    ]


def _nodes(mesh: SplatMesh, pieces: Pieces, count: int) -> np.ndarray:
    """(p,) node of each piece, those of a splat in one: weighted k-means of the splats' places."""
    s = int(pieces.splat.max()) + 1
    opacity = np.zeros(len(pieces.splat))
    np.maximum.at(opacity, pieces.of_face, mesh.colors[mesh.faces, 3].max(axis=1))
    weight = np.bincount(pieces.splat, opacity * pieces.areas, s) + 1e-300
    total = np.bincount(pieces.splat, pieces.areas + 1e-300, s)
    sums = [np.bincount(pieces.splat, (pieces.areas + 1e-300) * pieces.centers[:, k], s) for k in range(3)]
    places = np.stack(sums, axis=1) / total[:, None]
    rng = np.random.default_rng(0)
    some = np.sort(rng.choice(s, min(s, 20_000), replace=False))
    middles = places[
        some[rng.choice(len(some), min(count, len(some)), False, weight[some] / weight[some].sum())]
    ]
    for _ in range(ROUNDS if count > 1 else 0):
        label = _nearest(places[some], middles)
        share = np.bincount(label, weight[some], len(middles))
        for k in range(3):
            sums_k = np.bincount(label, weight[some] * places[some, k], len(middles))
            middles[share > 0, k] = sums_k[share > 0] / share[share > 0]
    label = np.unique(_nearest(places, middles), return_inverse=True)[1].reshape(-1)
    return label[pieces.splat]


def _nearest(points: np.ndarray, middles: np.ndarray) -> np.ndarray:
    best, result = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    for k, middle in enumerate(middles):
        distance = np.square(points - middle).sum(axis=1)
        nearer = distance < best
        best[nearer], result[nearer] = distance[nearer], k
    return result


def _outward(mesh: SplatMesh, pieces: Pieces, node: np.ndarray) -> np.ndarray:
    """(2 p,) int32 places of the sides of pieces, front and back, by their heights above the middle of the
    node's bounds along the direction that they face: of two that face a viewer, the higher one is usually in
    front."""
    middles = np.empty((int(node.max()) + 1, 3))
    of_face = node[pieces.of_face]
    for k in range(len(middles)):
        corners = mesh.vertices[mesh.faces[of_face == k].reshape(-1)]
        middles[k] = (corners.min(axis=0).astype(np.float64) + corners.max(axis=0)) / 2
    height = np.einsum("ij,ij->i", pieces.centers - middles[node], pieces.normals)
    heights = np.stack([height, -height], axis=1).reshape(-1)
    rank = np.empty(len(heights), np.int32)
    rank[np.argsort(heights, kind="stable")] = np.arange(len(heights), dtype=np.int32)
    return rank


def solve(
    mesh: SplatMesh,
    pieces: Pieces,
    node: np.ndarray,
    rank: np.ndarray,
    cameras: Sequence[Camera],
    threads: int | None = None,
) -> kernels.Ordered:
    """The order of the sides of ``pieces`` that suits ``cameras`` best, from that of ``rank``."""
    order = np.argsort(pieces.of_face, kind="stable")
    counts = np.bincount(pieces.of_face, minlength=len(pieces.splat))
    record = kernels.Pieces(
        mesh.vertices,
        mesh.plain.colors,
        np.ascontiguousarray(mesh.faces[order]),
        np.ascontiguousarray(pieces.turned[order]),
        np.concatenate([[0], np.cumsum(counts)]),
        np.ascontiguousarray(pieces.centers),
        pieces.splat.astype(np.int32),
        node.astype(np.int32),
    )
    views = [camera.within(SIDE).with_near_plane(mesh.vertices) for camera in cameras]
    structs = [camera_struct(view) for view in views]
    return kernels.order_triangles(record, rank, structs, sweeps=SWEEPS, max_pairs=MAX_PAIRS, threads=threads)
