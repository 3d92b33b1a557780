"""Meshes of a stage over time, and where they are. For the processes that ``reader`` starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from meshsplats.errors import FileFormatError


def placements(shapes: Sequence[Any], unit: float, time: float | None = None) -> list[np.ndarray]:
    """(4, 4) matrices, for row vectors, from the frames of ``shapes`` to that of the stage, whose ``unit`` is
    so many metres, in metres; by default at the first time that has values."""
    from pxr import Usd, UsdGeom

    cache = UsdGeom.XformCache(Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(time))
    return [np.array(cache.GetLocalToWorldTransform(shape.GetPrim())) @ in_metres(unit) for shape in shapes]


def in_metres(unit: float) -> np.ndarray:
    """(4, 4) matrix, for row or column vectors, from coordinates in a ``unit`` of so many metres."""
    return np.diag([unit, unit, unit, 1.0])


def sample_times(shapes: Sequence[Any]) -> set[float]:
    """The times at which points or transforms of ``shapes`` have values."""
    from pxr import UsdGeom

    times: set[float] = set()
    seen = set()
    for shape in shapes:
        times |= set(shape.GetPointsAttr().GetTimeSamples())
        prim = shape.GetPrim()
        while prim and prim.GetPath() not in seen:
            seen.add(prim.GetPath())
            if prim.IsA(UsdGeom.Xformable):
                times |= set(UsdGeom.Xformable(prim).GetTimeSamples())
            prim = prim.GetParent()
    return times


def vertices_at(
    time: float, shapes: Sequence[Any], rows: Sequence[np.ndarray | slice], matrices: Sequence[np.ndarray]
) -> np.ndarray:
    """(v, 3) float64 vertices of ``shapes`` at a ``time``: the points ``rows`` of each, moved by its matrix
    of ``matrices``. FileFormatError for a mesh that has other points then than at first."""
    from pxr import Usd

    parts = []
    for shape, chosen, matrix in zip(shapes, rows, matrices, strict=True):
        at, stored = str(shape.GetPath())[-100:], shape.GetPointsAttr()
        found = np.array(stored.Get(time), np.float64).reshape(-1, 3)
        first = len(stored.Get(Usd.TimeCode.EarliestTime()))
        if len(found) != first:
            raise FileFormatError(
                f"mesh {at} has {len(found):,} points at the time {time:g}, but {first:,} at first: points"
                " may move, but not change in number"
            )
        parts.append(found[chosen] @ matrix[:3, :3] + matrix[3, :3])
    return np.concatenate(parts)
