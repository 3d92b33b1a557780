"""Visibility (boundary) gradients, by the motion of edges, for meshes that are drawn with a depth buffer.

The gradients of ``backward.py`` take the fragments of each sample as constant. That is right where opacities
fall to 0 at the rim of a surface, but an opaque triangle also covers other samples when it moves: an edge
between the colours c on its own side and c' on the other, which moves by d along its normal, changes the
image by ``(c - c') d`` per unit of its length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshsplats._common.geometry import edge_groups
from meshsplats._core import kernels
from meshsplats.rendering.api import render
from meshsplats.rendering.shading import seen_from
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh

EDGE_SAMPLES = 2
"""Samples along each side of a pixel between which edges are looked for."""

_ROOT = 1024


class FrontFaces(NamedTuple):
    """What a depth buffer shows."""

    faces: np.ndarray
    """(h, w) int32 index of the triangle in front at each pixel centre, -1 for none."""
    color: np.ndarray
    """(h, w, 3) float32."""


def front_faces(
    mesh: SplatMesh,
    camera: Camera,
    cutoff: float,
    *,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    threads: int | None = None,
) -> FrontFaces:
    """The nearest triangle of at least the opacity ``cutoff`` at the centre of each pixel of ``camera``."""
    count = len(mesh.faces)
    indexed = SplatMesh(
        mesh.vertices[mesh.faces].reshape(-1, 3),
        np.arange(3 * count).reshape(-1, 3),
        mesh.colors[mesh.faces].reshape(-1, 4),
        depth_group=mesh.depth_group,
        attributes={"index": index_digits(count)},
    )
    image = render(
        indexed, camera, cutoff=cutoff, background=background, attributes=("index",), threads=threads
    )
    return FrontFaces(indices_of(image.attributes["index"], image.alpha > 0.5), image.color)


def index_digits(count: int) -> np.ndarray:
    """(3 * count, 2): the index of each of ``count`` triangles at corners of its own, in two digits that
    float32 interpolates exactly."""
    indices = np.repeat(np.arange(count), 3)
    return np.stack([indices % _ROOT, indices // _ROOT], axis=1)


def indices_of(digits: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """(h, w) int32 index of the triangle at each sample of an image of ``index_digits`` (h, w, 2), -1 where
    it is not ``covered`` (h, w)."""
    indices = np.full(covered.shape, -1, np.int32)
    whole = np.rint(digits[covered]).astype(np.int32)
    indices[covered] = whole[:, 0] + _ROOT * whole[:, 1]
    return indices


def faces_across(faces: np.ndarray) -> np.ndarray:
    """(f, 3) int32: the triangle across the edge from corner i of a triangle to its next corner. -1 where no
    triangle is adjacent, or several are.

    Args:
        faces: (f, 3) int32 vertex indices.
    """
    order, starts = edge_groups(faces)
    first = starts[:-1][np.diff(starts) == 2]
    result = np.full(faces.size, -1, np.int32)
    one, other = order[first], order[first + 1]
    result[one], result[other] = other // 3, one // 3
    return result.reshape(-1, 3)


def edge_gradients(
    mesh: SplatMesh,
    camera: Camera,
    cutoff: float,
    gradient: np.ndarray,
    *,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    across: np.ndarray | None = None,
    threads: int | None = None,
) -> np.ndarray:
    """(v, 3) float32 gradient of a loss with respect to the vertices of ``mesh``, by the motion of visible
    edges.

    Edges are found where the triangle in front differs between two neighbouring samples, of ``EDGE_SAMPLES``
    x ``EDGE_SAMPLES`` in a pixel. Of two triangles that both end there, the nearer one is followed. Where a
    triangle ends at the level set of its opacities, where it goes on in another, and where two intersect,
    there is no edge.

    Args:
        mesh, camera, cutoff, background: as in ``render(..., cutoff=cutoff)``; the mesh has no filter.
        gradient: (h, w, 3) float32 gradient of the loss with respect to the image, whose pixels are means
            over their area.
        across: ``faces_across(mesh.faces)``, precomputed, if you have it.
    """
    mesh = seen_from(mesh, camera, threads=threads)
    camera = camera.with_near_plane(mesh.vertices)  # not measured again on the triangles of front_faces
    fine = camera.scaled(EDGE_SAMPLES)
    front = front_faces(mesh, fine, cutoff, background=background, threads=threads)
    across = faces_across(mesh.faces) if across is None else across
    edged = Edged(mesh.vertices.astype(np.float64), mesh.faces, mesh.colors, across)
    return motion_gradients(edged, fine, front, gradient, cutoff, threads=threads).astype(np.float32)


class Edged(NamedTuple):
    """Opaque triangles, and which lie next to each other."""

    vertices: np.ndarray
    """(v, 3) float64."""
    faces: np.ndarray
    """(f, 3) int32."""
    colors: np.ndarray
    """(v, 4) float32, of which the opacities count."""
    across: np.ndarray
    """(f, 3) int32: ``faces_across``."""


def motion_gradients(
    triangles: Edged,
    camera: Camera,
    front: FrontFaces,
    gradient: np.ndarray,
    cutoff: float,
    *,
    threads: int | None = None,
) -> np.ndarray:
    """(v, 3) float64: ``edge_gradients`` from what ``camera``, which has a near plane, sees in ``front``: an
    image of samples, the pixels of ``gradient`` times a whole number."""
    assert camera.near is not None
    rotation, offset = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    points = triangles.vertices @ rotation.T + offset
    depth = points[:, 2]
    drawn = depth >= camera.near
    scale = np.where(drawn, 1 / np.where(drawn, depth, 1), 0)[:, None] * [camera.fx, camera.fy]
    screen = np.column_stack([points[:, :2] * scale + [camera.cx, camera.cy], depth])
    image = kernels.OpaqueImage(screen, *triangles[1:], front.faces, front.color, camera.near, cutoff)
    moved = scale * kernels.edge_gradients(image, gradient, threads)
    along = -(moved * points[:, :2]).sum(axis=1) / np.where(drawn, depth, 1)
    return np.column_stack([moved, along]) @ rotation
