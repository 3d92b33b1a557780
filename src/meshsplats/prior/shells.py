"""The interior side of a base mesh, and where shells on that side would protrude through the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshsplats._common.arrays import spread_indices
from meshsplats._common.geometry import vertex_normals
from meshsplats.cameras.trajectories import dome
from meshsplats.rendering import render
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh

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
            shown, column, row, z = camera.pixels_of(points)
            slack = 1 + _TOLERANCE / min(camera.fx, camera.fy)
            result[shown] |= z * slack < nearest[row, column]
        return result


def render_depth_views(
    vertices: np.ndarray, faces: np.ndarray, cameras: Sequence[Camera], *, threads: int | None = None
) -> DepthViews:
    """Renders the base mesh of ``vertices`` (n, 3) and ``faces`` (m, 3) with depth.

    The views are up to ``MAX_VIEWS`` of the ``cameras``, evenly spread; without cameras, views from all
    directions.
    """
    normals = vertex_normals(np.asarray(vertices, np.float64), faces)
    colors = np.ones((len(vertices), 4), np.float32)
    base = SplatMesh(vertices, faces, colors, attributes={"normal": normals})
    if cameras:
        chosen = [cameras[i].within(MAX_SIDE) for i in spread_indices(len(cameras), MAX_VIEWS)]
    else:
        chosen = dome(base, MAX_VIEWS, whole=True, width=MAX_SIDE, height=MAX_SIDE)
    nearest, front = [], 0.0
    for camera in chosen:
        drawn = render(base, camera, depth=True, attributes=["normal"], threads=threads)
        nearest.append(_neighbourhood_minimum(drawn.mean_depth(min_alpha=0.5)))
        solid = drawn.alpha > 0.5
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
