"""Contents of our own files beyond the schemas. For the processes that ``reader`` starts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, get_args

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats._orientation import up_quaternion
from meshsplats.scene.mesh import Blending, SplatMesh
from meshsplats.scene.spherical_harmonics import TERMS


def our_note(shape: Any) -> dict[str, Any]:
    """Our custom data of a mesh if it is valid, else an empty dictionary."""
    note = shape.GetPrim().GetCustomDataByKey("meshsplats")
    if not isinstance(note, dict):
        return {}
    try:
        up = [float(u) for u in note["up"]]
        origin = [float(x) for x in note.get("origin", (0, 0, 0))]
    except (KeyError, TypeError, ValueError):
        return {}
    good = len(up) == 3 and 0.5 < np.linalg.norm(up) < 2 and note.get("blending") in get_args(Blending)
    good = good and len(origin) == 3 and bool(np.isfinite(origin).all())
    return {**note, "up": up, "origin": origin} if good else {}


def is_own_placement(matrix: np.ndarray, note: dict[str, Any]) -> bool:
    """Whether the node has the matrix (for row vectors) that our writer gives it."""
    from pxr import Gf

    x, y, z, w = up_quaternion(np.array(note["up"]))
    turn = np.array(Gf.Matrix4d(Gf.Rotation(Gf.Quatd(w, x, y, z)), Gf.Vec3d(0)))
    shift = np.array(note["origin"]) @ turn[:3, :3]
    rounding = 1e-12 * np.abs(shift).max()
    return bool(
        np.abs(matrix[:3, :3] - turn[:3, :3]).max() < 1e-6
        and np.abs(matrix[3, :3] - shift).max() < max(1e-6, rounding)
    )


def restored(
    shape: Any, note: dict[str, Any], arrays: dict[str, np.ndarray], report: dict[str, Any]
) -> dict[str, np.ndarray]:
    """Extra arrays, attributes and the filter. Arrays that another program has dropped or altered are left
    out, with a warning: better no splat indices than wrong ones."""
    from pxr import UsdGeom

    def stored(name: str, dtype: type) -> np.ndarray:
        primvar = UsdGeom.PrimvarsAPI(shape).GetPrimvar(name)
        return np.array((primvar.Get() if primvar.HasValue() else None) or [], dtype)

    found: dict[str, np.ndarray] = {}
    lost: list[str] = []
    v = len(arrays["vertices"])
    for field in SplatMesh.EXTRAS:
        if field.per == "face" and note.get(field.name) is True:
            values = stored(field.name, field.dtype)
            wanted = field.shape({"vertex": v, "face": len(arrays["faces"])})
            sorted_ = field.name != "face_splat" or not (values[1:] < values[:-1]).any()
            if values.size == math.prod(wanted) and sorted_:
                found[field.name] = values.reshape(wanted)
            else:
                lost.append(field.name)
    if note.get("colors") is True:
        values = stored("colors", np.float32)
        if values.size == 3 * v:
            found["colors"] = values.reshape(v, 3)
            report["plain_colors"] = note.get("plain_colors") is True
        else:
            lost.append("colors")
    if "harmonics" in note:
        degree = note["harmonics"]
        if type(degree) is not int or degree not in (1, 2, 3):
            raise FileFormatError(f"harmonics must have degree 1, 2 or 3, got {str(degree)[:60]}")
        splats, terms = len(np.unique(found.get("face_splat", ()))), TERMS[degree - 1]
        values = stored("harmonics", np.float32)
        known = {"face_splat", "colors"} <= found.keys()
        if known and values.size == splats * terms * 3:
            found["harmonics"] = values.reshape(splats, terms, 3)
        else:
            lost.append("harmonics")
    if "filter_px2" in note:
        variance = note["filter_px2"]
        if not isinstance(variance, (int, float)):
            raise FileFormatError(f"filter_px2 must be a number, got {str(variance)[:60]}")
        if "face_splat" in found:
            report["filter_px2"] = float(variance)
        else:
            lost.append("the filter of its splats")
    if "order" in note:
        if "face_splat" in found:
            report["order"] = str(note["order"])[:60]
        else:
            lost.append("the order of its splats")
    for name, plain, columns in _attributes_of(note):
        wide = abs(columns)
        values = stored(plain, np.float32) if wide else np.empty(0, np.float32)
        if values.size != v * wide:
            lost.append(name)
            continue
        rows = (v,) if columns < 0 else (v, wide)
        found[f"attribute_{len(report['attributes'])}"] = values.reshape(rows)
        report["attributes"].append(name)
    if lost:
        report["warnings"].append(
            f"another program has changed the file, so this is ignored: {', '.join(lost)[:300]}"
        )
    return found


def _attributes_of(note: dict[str, Any]) -> Iterator[tuple[str, str, int]]:
    """Name, primvar and columns (-1: one number per vertex) of the attributes in our note."""
    try:
        rows = zip(
            list(note.get("attributes", [])),
            list(note.get("primvars", [])),
            [int(c) for c in note.get("columns", [])],
            strict=True,
        )
        for name, plain, columns in rows:
            if isinstance(name, str) and isinstance(plain, str) and -1 <= columns <= 4096:
                yield name, plain, columns
    except (TypeError, ValueError):
        return
