"""The part of reading cameras of USD that runs in a process of its own.

    python -m meshsplats.formats.usd.camera_extraction FILE RESULT

prints a line of JSON: {"error": text}, or {"cameras": [[angle, shape, matrix, name], ...]} as
``placed_camera`` takes them, in the world of ``load_mesh``. RESULT (.npz) has no arrays.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.formats._orientation import up_rotation
from meshsplats.formats.usd.motion import in_metres
from meshsplats.formats.usd.opening import main, metres, opened, visible_prims, visible_shapes
from meshsplats.formats.usd.own_notes import is_own_placement, our_note

_MOST = 20_000
"""Cameras that are read."""


def extract_cameras(file: Path, result: Path, origin: np.ndarray | None) -> dict[str, Any]:
    """Raises FileFormatError. ``origin`` has no effect: places are in the world."""
    from pxr import Usd, UsdGeom

    stage, now = opened(file), Usd.TimeCode.EarliestTime()
    to_mesh = np.eye(4)  # the root of a mesh of ours has turned it, and its place in the world with it
    meshes, unit = visible_shapes(stage).meshes, metres(stage)
    note = our_note(meshes[0]) if len(meshes) == 1 else {}
    if note and unit == 1 and is_own_placement(np.array(meshes[0].ComputeLocalToWorldTransform(now)), note):
        to_mesh[:3, :3] = up_rotation(np.array(note["up"])).T
    found: list[list[Any]] = []
    for prim in visible_prims(stage):
        if not prim.IsA(UsdGeom.Camera) or len(found) == _MOST:
            continue
        lens = UsdGeom.Camera(prim).GetCamera(now)
        if lens.projection != type(lens).Perspective:
            continue
        wide, high, focal = lens.horizontalAperture, lens.verticalAperture, lens.focalLength
        angle = 2 * math.atan2(high, 2 * focal)
        shape = wide / high if high else math.inf
        matrix = to_mesh @ in_metres(unit) @ np.array(lens.transform).T
        name = prim.GetDisplayName() or prim.GetName()
        found.append([angle, shape, matrix.tolist(), name[:100]])
    np.savez(result)
    return {"cameras": found}


if __name__ == "__main__":
    main(sys.argv[1:], extract_cameras)
