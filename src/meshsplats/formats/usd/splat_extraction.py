"""The part of reading splats of USD that runs in a process of its own, which ``splats`` starts.

    python -m meshsplats.formats.usd.splat_extraction FILE RESULT

writes the arrays of all ParticleField3DGaussianSplat prims of FILE to RESULT (.npz), each in its own frame,
and prints a line of JSON: {"error": text}, or what else the file says of them.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, get_args

import numpy as np

from meshsplats._common.geometry import rotation_rows
from meshsplats.errors import FileFormatError
from meshsplats.formats._orientation import HALF_TURN_X
from meshsplats.formats._validation import Budget
from meshsplats.formats.usd.motion import in_metres
from meshsplats.formats.usd.opening import main, metres, opened, say_units, visible_prims
from meshsplats.formats.usd.splats_writer import PRIM, turn_of
from meshsplats.scene.gaussians import Kernel

_SH = "radiance:sphericalHarmonics"
_HIGHEST = 3
"""Degree of harmonics that is kept."""


def extract_splats(file: Path, result: Path, _origin: np.ndarray | None) -> dict[str, Any]:
    """Writes the arrays; returns warnings, up axis and, of each field, matrix, degree, colour space and the
    note of our own files. Raises FileFormatError."""
    from pxr import Usd, UsdGeom

    stage = opened(file)
    prims = [prim for prim in visible_prims(stage) if prim.GetTypeName() == PRIM]
    if not prims:
        raise FileFormatError(f"the stage holds no visible splats ({PRIM})")
    budget, unit = Budget(file), metres(stage)
    places = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
    arrays: dict[str, np.ndarray] = {}
    report: dict[str, Any] = {"warnings": say_units(unit), "fields": []}
    report["z_up"] = bool(UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z)
    for i, prim in enumerate(prims):
        found, degree = _arrays(prim, budget, report["warnings"])
        arrays |= {f"{name}_{i}": array for name, array in found.items()}
        matrix = in_metres(unit) @ np.array(places.GetLocalToWorldTransform(prim)).T
        note = _own_note(prim, matrix) if len(prims) == 1 else {}
        space = prim.GetAttribute("colorSpace:name")
        report["fields"].append(
            {
                "matrix": matrix.tolist(),
                "degree": degree,
                "linear": str(space.Get() if space else "").startswith("lin_"),
                "note": note,
            }
        )
    np.savez(result, **arrays)  # type: ignore[arg-type]
    return report


def _arrays(prim: Any, budget: Budget, warnings: list[str]) -> tuple[dict[str, np.ndarray], int]:
    """Arrays of a field in its own frame, and the degree of its harmonics."""
    at = str(prim.GetPath())[-100:]
    means = _numbers(prim, "positions", 3, at)
    if means is None:
        raise FileFormatError(f"{at} has no positions")
    n = len(means)
    budget.spend(64 * n, f"{n:,} splats of {at}")
    fallbacks = {"orientations": (1.0, 0, 0, 0), "scales": (1.0, 1, 1), "opacities": (1.0,)}
    found = {"means": means}
    for name, fallback in fallbacks.items():
        values = _numbers(prim, name, len(fallback), at)
        if values is None or len(values) < n:  # the schema: too few are ignored, too many are cut off
            values = np.broadcast_to(np.array(fallback, np.float32), (n, len(fallback)))
        found[name] = values[:n]
    stated = prim.GetAttribute(f"{_SH}Degree")
    degree = stated.Get() if stated else 3
    if not isinstance(degree, int) or not 0 <= degree <= 8:
        raise FileFormatError(f"{at}: {_SH}Degree must be 0 to 8, got {str(degree)[:20]}")
    coefficients = (degree + 1) ** 2
    sh = _numbers(prim, f"{_SH}Coefficients", 3, at)
    if sh is None or len(sh) < n * coefficients:
        sh, coefficients, degree = np.zeros((n, 3), np.float32), 1, 0
        warnings.append(f"{at}: no colours, or too few for its splats; they are grey")
    sh = sh[: n * coefficients].reshape(n, coefficients, 3)
    if degree > _HIGHEST:
        warnings.append(f"{at}: spherical harmonics of degree {degree}; those beyond degree 3 are left out")
        sh, degree = sh[:, : (_HIGHEST + 1) ** 2], _HIGHEST
    budget.spend(12 * sh.shape[0] * sh.shape[1], f"harmonics of {at}")
    return found | {"sh": sh}, degree


def _numbers(prim: Any, name: str, columns: int, at: str) -> np.ndarray | None:
    """(k, columns) float32 values of an attribute, or of its half-precision twin; None without any."""
    from pxr import Usd

    for spelt in (name, f"{name}h"):
        attribute = prim.GetAttribute(spelt)
        stored = attribute.Get(Usd.TimeCode.EarliestTime()) if attribute else None
        if stored is None:
            continue
        if name == "orientations":
            return _rotations(stored, at)
        try:
            return np.asarray(stored, np.float32).reshape(-1, columns)
        except (ValueError, TypeError):
            raise FileFormatError(f"{at}: {spelt} does not hold {columns} numbers for each splat") from None
    return None


def _rotations(stored: Any, at: str) -> np.ndarray:
    """(k, 4) w, x, y, z of an array of quaternions, whose real parts lie behind the others."""
    try:
        values = np.asarray(stored, np.float32).reshape(-1, 4)
    except (ValueError, TypeError):
        raise FileFormatError(f"{at}: orientations are no quaternions") from None
    return values[:, [3, 0, 1, 2]]


def _own_note(prim: Any, matrix: np.ndarray) -> dict[str, Any]:
    """Up, origin and kernel of our own files, if the prim is where our writer puts it; else nothing."""
    note = prim.GetCustomDataByKey("meshsplats")
    if not isinstance(note, dict):
        return {}
    try:
        up = None if "up" not in note else np.array([float(u) for u in note["up"]])
        origin = np.array([float(x) for x in note.get("origin", (0, 0, 0))])
    except (TypeError, ValueError):
        return {}
    if note.get("kernel") not in get_args(Kernel) or origin.shape != (3,) or not np.isfinite(origin).all():
        return {}
    if up is not None and (up.shape != (3,) or not 0.5 < np.linalg.norm(up) < 2):
        return {}
    x, y, z, w = turn_of(up)
    turn = np.array(list(rotation_rows(w, x, y, z)))
    place = turn @ HALF_TURN_X @ origin
    reach = max(1e-6, 1e-12 * float(np.abs(place).max()))
    if np.abs(matrix[:3, :3] - turn).max() > 1e-6 or np.abs(matrix[:3, 3] - place).max() > reach:
        return {}
    return {
        "kernel": note["kernel"],
        "up": None if up is None else (HALF_TURN_X @ up).tolist(),
        "origin": (HALF_TURN_X @ origin).tolist(),
    }


if __name__ == "__main__":
    main(sys.argv[1:], extract_splats)
