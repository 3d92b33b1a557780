"""The part of reading textures of USD that runs in a process of its own, which ``textures`` starts.

    python -m meshsplats.formats.usd.texture_extraction FILE RESULT

writes to RESULT (.npz), for each triangle in the order of ``read_usd``, texture coordinates ``uv`` (m, 3, 2)
float32, v down, NaN without any; and ``texture`` (m,) int32, the index of its texture, -1 for none. It prints
a line of JSON: {"error": text}, or {"textures": [...], "warnings": [...]}, the former with the fields of
``TextureUse``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.formats._validation import Budget
from meshsplats.formats.usd.looks import Looks
from meshsplats.formats.usd.opening import main, opened, visible_shapes
from meshsplats.formats.usd.polygons import polygons_of, primvar
from meshsplats.formats.usd.skeletons import pose

_PRIMVAR = "st"
"""Texture coordinates of faces without a texture, on which users may put one."""


def extract_textures(file: Path, result: Path, origin: np.ndarray | None) -> dict[str, Any]:
    """Raises FileFormatError. ``origin`` has no effect."""
    budget, looks, stage = Budget(file), Looks(), opened(file)
    pose(stage)
    parts = [_coordinates(shape, budget, looks) for shape in visible_shapes(stage).meshes]
    uses = [(i, look.texture) for i, look in enumerate(looks.found) if look.texture is not None]
    texture = np.full(len(looks.found) + 1, -1, np.int32)  # the last one for -1
    texture[[i for i, _ in uses]] = np.arange(len(uses))
    np.savez(
        result,
        uv=np.concatenate([uv for uv, _ in parts]) if parts else np.empty((0, 3, 2), np.float32),
        texture=texture[np.concatenate([look for _, look in parts])] if parts else np.empty(0, np.int32),
    )
    return {"textures": [use._asdict() for _, use in uses], "warnings": looks.warnings}


def _coordinates(shape: Any, budget: Budget, looks: Looks) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates (f, 3, 2) of the triangles of a mesh, and (f,) their index in ``looks.found``."""
    polygons = polygons_of(shape, budget)
    look = looks.of_faces(shape, len(polygons.lengths))
    count = len(polygons.corners)
    budget.spend(64 * count, f"texture coordinates of mesh {polygons.at}")
    uv, of_corner = np.full((count, 2), np.nan, np.float32), np.repeat(look, polygons.lengths)
    for number in np.unique(look).tolist():
        use = looks.found[number].texture if number >= 0 else None
        values, kind = primvar(shape, use.primvar if use else _PRIMVAR, 2, polygons)
        if values is None:
            continue
        here = of_corner == number
        placed = np.broadcast_to(polygons.at_corners(values, kind), (count, 2))[here].astype(np.float64)
        matrix = np.array(use.matrix) if use else np.eye(3)
        with np.errstate(over="ignore", invalid="ignore"):
            placed = placed @ matrix[:2, :2].T + matrix[:2, 2]
            uv[here] = placed * [1, -1] + [0, 1]  # USD's v is up
    return uv[polygons.cut], look[polygons.owner]


if __name__ == "__main__":
    main(sys.argv[1:], extract_textures)
