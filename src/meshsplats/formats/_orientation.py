"""Turns between files with other axes and ours."""

from __future__ import annotations

import numpy as np

from meshsplats._common.geometry import rotation_rows
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.mesh import SplatMesh

HALF_TURN_X = np.diag([1.0, -1.0, -1.0])
"""Half turn about x: from y up to y down and back; reverses z, too."""
HALF_TURN_Z = np.diag([-1.0, -1.0, 1.0])
"""Half turn about z: from y up to y down and back; reverses x, too."""
Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Quarter turn about x from y up to z up, as viewers of tilesets, Blender and slicers turn what has y up."""
Y_DOWN_FROM_Z_UP = Z_UP_FROM_Y_UP
"""The same quarter turn from z up to x right, y down, z forward."""


def up_quaternion(up: np.ndarray) -> list[float]:
    """Unit quaternion x, y, z, w of a rotation that takes the unit vector ``up`` to +y: the shortest one, for
    directions below the horizon after a half turn about x.

    For ``up`` = -y (splats of COLMAP cameras: x right, y down, z forward) it is that half turn: x stays
    right, and a camera that looked along +z looks along -z, as glTF's do. Directions near -y differ little
    from it, where the shortest rotation could have any axis.
    """
    x, y, z = (float(u) for u in np.asarray(up, np.float64) / np.linalg.norm(np.asarray(up, np.float64)))
    # up x (0, 1, 0) = (-z, 0, x); half-angle form of the shortest rotation between unit vectors. After the
    # half turn, (x, y, z) is (x, -y, -z), and (a, b, c, w) (1, 0, 0, 0) = (w, c, -b, -a).
    q = np.array([-z, 0.0, x, 1 + y]) if y >= 0 else np.array([1 - y, x, 0.0, -z])
    return [float(c) + 0.0 for c in q / np.linalg.norm(q)]  # no negative zeros


def up_rotation(up: np.ndarray) -> np.ndarray:
    """(3, 3) float64 matrix of ``up_quaternion``."""
    x, y, z, w = up_quaternion(up)
    return np.array(list(rotation_rows(w, x, y, z)))


def tile_frame(up: np.ndarray) -> np.ndarray:
    """(3, 3) float64 rotation from the world frame to that of a tileset, in which ``up`` (3,) is +z: that of
    a GLB's node and of viewers together."""
    return np.asarray(Z_UP_FROM_Y_UP @ up_rotation(up))


def turned_origin(mesh: SplatMesh | BaseMesh) -> np.ndarray:
    """(3,) float64 place of the mesh's origin in a frame whose +y is its ``up``."""
    return up_rotation(mesh.up) @ mesh.origin + 0.0
