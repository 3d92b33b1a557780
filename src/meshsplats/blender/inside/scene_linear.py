"""Linear colours in the working space of the open file. That has the primaries of Rec.709, as ours do, unless
the file is for ACEScg or Rec.2020 (since Blender 5), or Blender has another OpenColorIO configuration."""

from __future__ import annotations

import numpy as np


def from_rec709(colors: np.ndarray) -> np.ndarray:
    """(n, 3 or 4) float32 linear ``colors`` of Rec.709 in the working space; alpha stays."""
    return _mapped(colors, _matrix())


def to_rec709(colors: np.ndarray) -> np.ndarray:
    """As ``from_rec709``, back again."""
    return _mapped(colors, np.linalg.inv(_matrix()))


def _matrix() -> np.ndarray:
    """(3, 3) float64 map of rows of linear RGB from Rec.709 to the working space; exact where they agree."""
    from mathutils import Color

    found = np.array([Color(row).from_rec709_linear_to_scene_linear() for row in np.eye(3).tolist()])
    return np.eye(3) if np.allclose(found, np.eye(3), atol=1e-4) else found


def _mapped(colors: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    if (matrix == np.eye(3)).all():
        return colors
    found = np.array(colors, np.float32)
    found[:, :3] = found[:, :3] @ matrix.astype(np.float32)
    return found
