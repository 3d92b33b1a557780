"""The polygons of a mesh of a stage, and its primvars. For the processes that ``reader`` starts."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats._polygons import cut_polygons
from meshsplats.formats._validation import Budget


class Polygons(NamedTuple):
    """n polygons with k corners in all."""

    at: str
    """Where it is in the stage, for messages."""
    points: np.ndarray
    """(v, 3) float32 or float64 positions in the frame of the mesh."""
    lengths: np.ndarray
    """(n,) int64 corners of each polygon."""
    corners: np.ndarray
    """(k,) int64 point at each corner."""
    cut: np.ndarray
    """(f, 3) int64 corners, among the k, of the triangles that they are cut into, but for holes;
    counterclockwise as seen from the front in the frame of the stage."""
    owner: np.ndarray
    """(f,) int64 polygon of each triangle."""

    def at_corners(self, values: np.ndarray, kind: str) -> np.ndarray:
        """(k, columns) of the values of a primvar, by its interpolation; a constant stays one row."""
        if kind == "uniform":
            return np.repeat(values, self.lengths, axis=0)
        return values[self.corners] if kind in ("vertex", "varying") else values


def polygons_of(shape: Any, budget: Budget) -> Polygons:
    """The polygons of a UsdGeom.Mesh. FileFormatError if their corners are not points of the mesh."""
    from pxr import Usd, UsdGeom

    at = str(shape.GetPath())[-100:]
    points = _array(shape.GetPointsAttr(), None, at, "points").reshape(-1, 3)
    if points.dtype != np.float64:
        points = points.astype(np.float32, copy=False)
    lengths = _array(shape.GetFaceVertexCountsAttr(), np.int64, at, "faceVertexCounts")
    corners = _array(shape.GetFaceVertexIndicesAttr(), np.int64, at, "faceVertexIndices")
    v = len(points)
    budget.spend(64 * len(corners) + 64 * v, f"mesh {at}")
    if (lengths < 0).any() or lengths.sum() != len(corners):
        raise FileFormatError(f"mesh {at}: faceVertexCounts do not add up to {len(corners):,} corners")
    if len(corners) and (corners.min() < 0 or corners.max() >= v):
        raise FileFormatError(f"mesh {at}: corners {corners.min()} to {corners.max()} of {v:,} points")
    cut, owner = cut_polygons(lengths, points[corners])
    holes = _array(shape.GetHoleIndicesAttr(), np.int64, at, "holeIndices", required=False)
    kept = ~np.isin(owner, holes)
    # A mirror turns a mesh inside out, unless its faces are wound the other way.
    mirrored = shape.ComputeLocalToWorldTransform(Usd.TimeCode.EarliestTime()).GetDeterminant() < 0
    backwards = (shape.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded) != mirrored
    return Polygons(at, points, lengths, corners, cut[kept, :: -1 if backwards else 1], owner[kept])


def primvar(shape: Any, name: str, columns: int, polygons: Polygons) -> tuple[np.ndarray | None, str]:
    """Values (k, columns) of a primvar, own or inherited, and its interpolation; (None, '') without any."""
    from pxr import Usd, UsdGeom

    found = UsdGeom.PrimvarsAPI(shape).FindPrimvarWithInheritance(name)
    time = Usd.TimeCode.EarliestTime()
    if found and found.HasValue():
        stored, kind = found.ComputeFlattened(time), str(found.GetInterpolation())
    elif name == "normals" and shape.GetNormalsAttr().HasValue():
        stored, kind = shape.GetNormalsAttr().Get(time), str(shape.GetNormalsInterpolation())
    else:
        return None, ""
    if stored is None:
        return None, ""
    try:
        values = np.asarray(stored, np.float32).reshape(-1, columns)
    except (ValueError, TypeError):
        raise FileFormatError(
            f"mesh {polygons.at}: {name} does not hold {columns} numbers per value"
        ) from None
    n, v, corners = len(polygons.lengths), len(polygons.points), len(polygons.corners)
    wanted = {"constant": 1, "uniform": n, "vertex": v, "varying": v, "faceVarying": corners}.get(kind)
    if len(values) != wanted:
        raise FileFormatError(
            f"mesh {polygons.at}: {name} ({kind[:20]}) has {len(values):,} values, expected {wanted}"
        )
    return values, kind


def _array(attribute: Any, dtype: type | None, at: str, what: str, *, required: bool = True) -> np.ndarray:
    from pxr import Usd

    stored = attribute.Get(Usd.TimeCode.EarliestTime()) if attribute else None
    if stored is None and required:
        raise FileFormatError(f"mesh {at} has no {what}")
    return np.array(() if stored is None else stored, dtype)
