"""Meshes that skeletons and blend shapes move, where renderers draw them. For the processes that ``reader``
starts.

Schema: https://openusd.org/release/api/usd_skel_page_front.html.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def pose(stage: Any, *, whole: bool = False) -> tuple[set[float], list[str]]:
    """Gives skinned meshes, in memory, the points that their skeletons and blend shapes move them to: at the
    first time that has values, or, if ``whole``, at all of them.

    Returns the times at which skeletons have values, and warnings.
    """
    from pxr import Gf, Usd, UsdSkel

    times: set[float] = set()
    tops = stage.GetPseudoRoot(), *stage.GetPrototypes()
    if not any(prim.IsA(UsdSkel.Root) for top in tops for prim in Usd.PrimRange(top)):
        return times, []
    _unpack_instances(stage)
    at_rest = broken = 0
    for prim in stage.Traverse():
        root = UsdSkel.Root(prim)
        if not root:
            continue
        cache, starts, loose = UsdSkel.Cache(), [], list[tuple[Any, np.ndarray]]()
        cache.Populate(root, Usd.PrimDefaultPredicate)
        for binding in cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate):
            loose += [pair for target in binding.GetSkinningTargets() if (pair := _loose_points(target))]
            motion = cache.GetSkelQuery(binding.GetSkeleton()).GetAnimQuery()
            weights = motion.ComputeBlendShapeWeights(Usd.TimeCode.EarliestTime()) if motion else None
            if not weights:
                at_rest += sum(target.HasBlendShapes() for target in binding.GetSkinningTargets())
            if motion:
                for samples in motion.GetJointTransformTimeSamples(), motion.GetBlendShapeWeightTimeSamples():
                    times |= set(samples)
                    starts += samples[:1]
        rest = [np.array(points.Get(Usd.TimeCode.EarliestTime())) for points, _ in loose]
        once = starts and not whole
        span = Gf.Interval(min(starts), max(starts)) if once else Gf.Interval.GetFullInterval()
        try:
            broken += not UsdSkel.BakeSkinning(root, span)
        except RuntimeError:
            broken += 1
        for (points, rows), kept in zip(loose, rest, strict=True):
            _put_back(points, rows, kept)
    said = []
    if at_rest:
        said.append(
            f"{at_rest:,} meshes have blend shapes (shape keys) without values, and were read without them:"
            " apply them before the export, or export the animation"
        )
    if broken:
        said.append(f"{broken:,} skeletons cannot be evaluated, their meshes were read at rest")
    return times, said


def _loose_points(target: Any) -> tuple[Any, np.ndarray] | None:
    """The points of a skinned mesh, and which of them no joint has a weight for; None if there are none."""
    from pxr import Usd, UsdGeom

    primvar, count = target.GetJointWeightsPrimvar(), target.GetNumInfluencesPerComponent()
    points = UsdGeom.PointBased(target.GetPrim()).GetPointsAttr()
    if not (points and primvar and count) or target.IsRigidlyDeformed():
        return None
    weights = np.array(primvar.ComputeFlattened(Usd.TimeCode.EarliestTime()), np.float64)
    if weights.size != count * len(points.Get(Usd.TimeCode.EarliestTime()) or ()):
        return None
    rows = np.flatnonzero(~weights.reshape(-1, count).any(axis=1))
    return (points, rows) if len(rows) else None


def _put_back(points: Any, rows: np.ndarray, rest: np.ndarray) -> None:
    """Leaves the ``rows`` of ``points`` at ``rest`` (v, 3), as programs of animation do; UsdSkel puts points
    without weights to the origin."""
    from pxr import Usd, Vt

    for time in points.GetTimeSamples() or [Usd.TimeCode.Default()]:
        moved = np.array(points.Get(time))
        if len(moved) == len(rest):
            moved[rows] = rest[rows]
            points.Set(Vt.Vec3fArray.FromNumpy(moved), time)


def _unpack_instances(stage: Any) -> None:
    """Makes prims of instances that have to do with skeletons, as only those can be given points."""

    while packed := [prim for prim in stage.Traverse() if prim.IsInstance() and _is_rigged(prim)]:
        for prim in packed:
            prim.SetInstanceable(False)


def _is_rigged(instance: Any) -> bool:
    from pxr import Usd, UsdSkel

    inside = Usd.PrimRange(instance, Usd.TraverseInstanceProxies())
    return bool(UsdSkel.Root.Find(instance)) or any(prim.IsA(UsdSkel.Root) for prim in inside)
