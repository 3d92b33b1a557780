"""Which side of a base is its inner one, and where shells on that side would stand out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshsplats._arrays import spread_indices
from meshsplats._geometry import vertex_normals
from meshsplats.camera import Camera
from meshsplats.cameras.trajectories import dome
from meshsplats.mesh import SplatMesh
from meshsplats.rendering import render

LOOKS = 24
"""Most pictures that the base is looked at in."""
SIDE = 320
"""Longer side of these, in pixels, at most."""
_TOLERANCE = 1.5
"""Pixels, laid on the surface, by which a point must stand out before it counts."""


@dataclass(frozen=True, eq=False)
class Looks:
    """A base seen from several places."""

    cameras: list[Camera]
    nearest: list[np.ndarray]
    """(h, w) float32 least depth of the base in the pixels round each pixel; infinite where it is in none."""
    facing: bool
    """Whether more of what is seen shows the side that the normals point to than the other."""

    def standing_out(self, points: np.ndarray) -> np.ndarray:
        """(k,) bool: which of ``points`` (k, 3) a camera sees before the base or beside it."""
        result = np.zeros(len(points), bool)
        for camera, nearest in zip(self.cameras, self.nearest, strict=True):
            positions, z = camera.project(points)
            rows = np.flatnonzero(camera.in_image(positions))
            column, row = positions[rows].T.astype(np.intp)
            slack = 1 + _TOLERANCE / min(camera.fx, camera.fy)
            result[rows] |= z[rows] * slack < nearest[row, column]
        return result


def look_at_base(
    vertices: np.ndarray, faces: np.ndarray, cameras: Sequence[Camera], *, threads: int | None = None
) -> Looks:
    """The base of ``vertices`` (n, 3) and ``faces`` (m, 3) from up to ``LOOKS`` of the ``cameras``, evenly
    spread; from all round where there are none."""
    normals = vertex_normals(np.asarray(vertices, np.float64), faces)
    colors = np.ones((len(vertices), 4), np.float32)
    base = SplatMesh(vertices, faces, colors, attributes={"normal": normals})
    if cameras:
        chosen = [cameras[i].within(SIDE) for i in spread_indices(len(cameras), LOOKS)]
    else:
        chosen = dome(base, LOOKS, whole=True, width=SIDE, height=SIDE)
    nearest, front = [], 0.0
    for camera in chosen:
        drawn = render(base, camera, depth=True, attributes=["normal"], threads=threads)
        nearest.append(_least_around(drawn.mean_depth(min_alpha=0.5)))
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
    return Looks(chosen, nearest, front >= 0)


def _least_around(depth: np.ndarray) -> np.ndarray:
    """Least of each pixel and its eight neighbours."""
    wide = np.pad(depth, 1, constant_values=np.inf)
    h, w = depth.shape
    return np.minimum.reduce([wide[i : i + h, j : j + w] for i in range(3) for j in range(3)])
