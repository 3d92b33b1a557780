"""The specification of images of a file with an order of blending, in float64: slow, to be read.

Viewers draw one triangle after another over what is there: ``color <- (1 - a) color + a c``. The gradient
goes the same way backwards. What is drawn, and in which order, counts as constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from meshsplats.rendering.reference import _cover, _edge_functions
from meshsplats.rendering.reference_samples import sample_positions, to_camera
from meshsplats.scene.camera import Camera
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh


class Painted(NamedTuple):
    """An image and the gradient of a loss."""

    color: np.ndarray
    """(h, w, 3)"""
    vertices: np.ndarray
    """(v, 3) gradient."""
    colors: np.ndarray
    """(v, 4) gradient."""


def drawn_triangles(mesh: SplatMesh, order: DrawOrder, camera: Camera) -> np.ndarray:
    """(f,) triangles of ``mesh`` as a viewer draws them: the nodes by the depths of the middles of their
    bounds, farthest first, and of each the copies that face the camera, as they are listed."""
    f = len(mesh.faces)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    own_side = np.einsum("ij,ij->i", normals, camera.center - corners[:, 0]) > 0
    parts = []
    for first, end in zip(order.starts[:-1], order.starts[1:], strict=True):
        copies = order.copies[first:end]
        points = corners[copies % f].reshape(-1, 3)
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        depth = float(camera.world_to_camera[2, :3] @ middle)
        parts.append((-depth, copies[own_side[copies % f] == (copies < f)] % f))
    parts.sort(key=lambda part: part[0])
    return np.concatenate([faces for _, faces in parts])


def paint(
    mesh: SplatMesh,
    order: DrawOrder,
    camera: Camera,
    towards: np.ndarray,
    *,
    background: Sequence[float] = (1, 1, 1),
    samples: int = 1,
) -> Painted:
    """The image of ``mesh`` from a file that lists it in ``order``, over ``background``, and the gradient of
    the loss ``(towards * color).sum()``, with ``towards`` (h, w, 3)."""
    x, y = sample_positions(camera, samples)
    near = camera.near_plane(mesh.vertices)
    points = to_camera(mesh.vertices, camera)
    lens = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    corners = (points @ lens.T)[mesh.faces]
    edges, determinants = _edge_functions(corners)
    rgba = mesh.colors.astype(np.float64)
    color = np.tile(np.asarray(background, np.float64), (len(x), 1))
    steps = []
    for face in drawn_triangles(mesh, order, camera):
        at, _, weights = _cover(corners[face], edges[face], determinants[face], x, y, near)
        values = weights @ rgba[mesh.faces[face]]
        before, alpha = color[at], values[:, 3:]
        color[at] = (1 - alpha) * before + alpha * values[:, :3]
        steps.append((face, at, weights, values, before))

    def pixels(of_samples: np.ndarray) -> np.ndarray:
        return of_samples.reshape(camera.height, samples, camera.width, samples, 3).mean(axis=(1, 3))

    image = pixels(color)
    grad = np.repeat(np.repeat(towards.astype(np.float64), samples, axis=0), samples, axis=1)
    grad = grad.reshape(-1, 3) / samples**2
    of_corners, of_colors = np.zeros_like(points), np.zeros_like(rgba)
    position = np.column_stack([x, y, np.ones(len(x))])
    for face, at, weights, values, before in reversed(steps):
        alpha, own = values[:, 3:], grad[at]
        of_values = np.column_stack([alpha * own, (own * (values[:, :3] - before)).sum(axis=1)])
        grad[at] = (1 - alpha) * own
        corner = mesh.faces[face]
        np.add.at(of_colors, corner, weights.T @ of_values)
        # Weights are e_i / sum e, with e_i = p . (V_j x V_k).
        of_weights = of_values @ rgba[corner].T
        total = position[at] @ edges[face].sum(axis=0)
        of_edges = (of_weights - (of_weights * weights).sum(axis=1, keepdims=True)) / total[:, None]
        towards_normal = of_edges.T @ position[at]  # row i: gradient of V_j x V_k
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            np.add.at(of_corners, corner[j], np.cross(corners[face][k], towards_normal[i]))
            np.add.at(of_corners, corner[k], np.cross(towards_normal[i], corners[face][j]))
    return Painted(image, of_corners @ lens @ camera.world_to_camera[:3, :3], of_colors)
