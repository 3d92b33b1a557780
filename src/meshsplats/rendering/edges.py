"""Gradients by the motion of edges, for meshes that are drawn with a depth buffer.

The gradients of ``backward.py`` take the fragments of each sample as constant. That is right where opacities
fall to 0 at the rim of a surface, but an opaque triangle also covers other samples when it moves: an edge
between the colours c on its own side and c' on the other, which moves by d along its normal, changes the
image by ``(c - c') d`` per unit of its length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshsplats._core import kernels
from meshsplats.camera import Camera
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.api import render
from meshsplats.rendering.shading import seen_from

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
    # Every triangle has corners of its own with its index, in two digits that float32 interpolates exactly.
    indices = np.repeat(np.arange(count), 3)
    indexed = SplatMesh(
        mesh.vertices[mesh.faces].reshape(-1, 3),
        np.arange(3 * count).reshape(-1, 3),
        mesh.colors[mesh.faces].reshape(-1, 4),
        depth_group=mesh.depth_group,
        attributes={"index": np.stack([indices % _ROOT, indices // _ROOT], axis=1)},
    )
    image = render(
        indexed, camera, cutoff=cutoff, background=background, attributes=("index",), threads=threads
    )
    digits = np.rint(image.attributes["index"]).astype(np.int32)
    found = np.where(image.alpha > 0.5, digits[..., 0] + _ROOT * digits[..., 1], np.int32(-1))
    return FrontFaces(found, image.color)


def faces_across(faces: np.ndarray) -> np.ndarray:
    """(f, 3) int32: the triangle across the edge from corner i of a triangle to its next corner. -1 where no
    triangle is adjacent, or several are.

    Args:
        faces: (f, 3) int32 vertex indices.
    """
    tails, heads = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel()
    keys = np.minimum(tails, heads) * (int(faces.max(initial=0)) + 1) + np.maximum(tails, heads)
    order = np.argsort(keys, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(keys[order])) + 1, len(keys))
    starts = np.append(0, ends[:-1])
    first = starts[ends - starts == 2]
    result = np.full(len(keys), -1, np.int32)
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
    fine, near = camera.scaled(EDGE_SAMPLES), camera.near_plane(mesh.vertices)
    front = front_faces(mesh, fine, cutoff, background=background, threads=threads)
    rotation, offset = fine.world_to_camera[:3, :3], fine.world_to_camera[:3, 3]
    points = mesh.vertices.astype(np.float64) @ rotation.T + offset
    depth = points[:, 2]
    drawn = depth >= near
    scale = np.where(drawn, 1 / np.where(drawn, depth, 1), 0)[:, None] * [fine.fx, fine.fy]
    screen = np.column_stack([points[:, :2] * scale + [fine.cx, fine.cy], depth])
    across = faces_across(mesh.faces) if across is None else across
    image = kernels.OpaqueImage(
        screen, mesh.faces, mesh.colors, across, front.faces, front.color, near, cutoff
    )
    moved = scale * kernels.edge_gradients(image, gradient, threads)
    along = -(moved * points[:, :2]).sum(axis=1) / np.where(drawn, depth, 1)
    return (np.column_stack([moved, along]) @ rotation).astype(np.float32)
