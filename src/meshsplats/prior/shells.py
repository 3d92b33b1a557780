"""The interior side of a base mesh, and where shells on that side would protrude through the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshsplats.binding import surface_normals
from meshsplats.camera import Camera
from meshsplats.cameras.trajectories import dome
from meshsplats.mesh import SplatMesh
from meshsplats.rendering import render

MAX_VIEWS = 24
"""Maximum number of depth images."""
MAX_SIDE = 320
"""Maximum of their longer side, in pixels."""
_TOLERANCE = 1.5
"""Depth tolerance of protrusion, in pixels at the depth of the point."""


@dataclass(frozen=True, eq=False)
class DepthViews:
    """Depth images of a base mesh."""

    cameras: list[Camera]
    nearest: list[np.ndarray]
    """For each camera (h, w) float32, the smallest depth in the 3 x 3 pixels around each pixel; infinite
    where the base covers none of them."""
    facing: bool
    """Whether most covered pixels show the side that the normals point to."""

    def protruding(self, points: np.ndarray) -> np.ndarray:
        """(k,) bool: which of ``points`` (k, 3) any camera sees in front of the base or beside it."""
        result = np.zeros(len(points), bool)
        for camera, nearest in zip(self.cameras, self.nearest, strict=True):
            matrix = camera.world_to_camera
            x, y, z = matrix[:3, :3] @ points.T + matrix[:3, 3:]
            rows = np.flatnonzero(z > camera.near)
            column = np.floor(camera.fx * x[rows] / z[rows] + camera.cx)
            row = np.floor(camera.fy * y[rows] / z[rows] + camera.cy)
            on = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            rows, place = rows[on], (row[on].astype(np.intp), column[on].astype(np.intp))
            slack = 1 + _TOLERANCE / min(camera.fx, camera.fy)
            result[rows] |= z[rows] * slack < nearest[place]
        return result


def render_depth_views(
    vertices: np.ndarray, faces: np.ndarray, cameras: Sequence[Camera], *, threads: int | None = None
) -> DepthViews:
    """Renders the base mesh of ``vertices`` (n, 3) and ``faces`` (m, 3) with depth.

    The views are up to ``MAX_VIEWS`` of the ``cameras``, evenly spread; without cameras, views from all
    directions.
    """
    normals = surface_normals(vertices, faces)
    colors = np.ones((len(vertices), 4), np.float32)
    base = SplatMesh(vertices, faces, colors, attributes={"normal": normals})
    if cameras:
        chosen = [cameras[i] for i in np.linspace(0, len(cameras) - 1, MAX_VIEWS).round().astype(int)]
        chosen = [camera.within(MAX_SIDE) for camera in dict.fromkeys(chosen)]
    else:
        chosen = dome(base, MAX_VIEWS, whole=True, width=MAX_SIDE, height=MAX_SIDE)
    nearest, front = [], 0.0
    for camera in chosen:
        drawn = render(base, camera, depth=True, attributes=["normal"], threads=threads)
        assert drawn.depth is not None
        solid = drawn.alpha > 0.5
        depth = np.where(solid, drawn.depth / np.where(solid, drawn.alpha, 1), np.inf)
        nearest.append(_neighbourhood_minimum(depth))
        rows, columns = np.nonzero(solid)
        ray = np.stack(
            [
                (columns + 0.5 - camera.cx) / camera.fx,
                (rows + 0.5 - camera.cy) / camera.fy,
                np.ones(len(rows)),
            ]
        )
        world = camera.world_to_camera[:3, :3].T @ ray
        front -= float(np.sign(np.einsum("ck,kc->k", world, drawn.attributes["normal"][solid])).sum())
    return DepthViews(chosen, nearest, front >= 0)


def _neighbourhood_minimum(depth: np.ndarray) -> np.ndarray:
    """Minimum of each pixel and its eight neighbours."""
    wide = np.pad(depth, 1, constant_values=np.inf)
    h, w = depth.shape
    return np.minimum.reduce([wide[i : i + h, j : j + w] for i in range(3) for j in range(3)])
