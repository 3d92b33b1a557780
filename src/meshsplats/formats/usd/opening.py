"""Shared by the processes that ``reader`` starts: their limits, and what of a stage is drawn."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from meshsplats.errors import FileFormatError

BLENDER = "userProperties:meshsplats_"
"""Beginning of the names of attributes that Blender makes of the extension's properties."""
_LIBRARY_BYTES = 2 << 30
_FACTOR = 256
"""Limit of address space: that at the start, ``_LIBRARY_BYTES``, and ``_FACTOR`` times the file's size."""

Extract = Callable[[Path, Path, "np.ndarray | None"], dict[str, Any]]
"""Writes arrays of the first file to the second, relative to an origin, and returns a report."""


def main(arguments: Sequence[str], extract: Extract) -> None:
    """Runs ``extract`` for the ``arguments`` of a command, FILE RESULT [X Y Z], and prints its report."""
    import pxr.UsdGeom  # noqa: F401  (loaded before memory is limited)

    file, result = Path(arguments[0]), Path(arguments[1])
    origin = np.array([float(x) for x in arguments[2:]]) if len(arguments) > 2 else None
    _limit_memory(file.stat().st_size)
    try:
        report = checked(extract, file, result, origin)
    except FileFormatError as error:
        report = {"error": str(error).removeprefix(f"{file}: ")}
    except MemoryError:
        report = {
            "error": "its data would take more memory than a file of this size may (a decompression bomb?)"
        }
    print(json.dumps(report))


def _limit_memory(file_bytes: int) -> None:
    try:
        import resource
    except ImportError:  # Windows
        return
    taken = 0
    if os.path.exists("/proc/self/statm"):
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limit = taken + _LIBRARY_BYTES + _FACTOR * file_bytes
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    try:
        resource.setrlimit(resource.RLIMIT_AS, (limit if hard < 0 else min(limit, hard), hard))
    except (ValueError, OSError):  # macOS has the limit, but refuses to set it
        return


def checked(extract: Extract, file: Path, result: Path, origin: np.ndarray | None) -> dict[str, Any]:
    """``extract``, with FileFormatError for the library's own errors."""
    try:
        return extract(file, result, origin)
    except RuntimeError as error:  # including the library's own errors
        try:
            lines = str(error).split("\n")
        except UnicodeDecodeError:  # the message quotes the file
            lines = []
        reason = next((line.strip() for line in lines if line.strip()), "no reason given")
        raise FileFormatError(f"not readable as USD: {reason.rpartition(' : ')[2][:300]}") from None
    except UnicodeDecodeError:
        raise FileFormatError("not readable as USD: it holds text that is not UTF-8") from None


def opened(file: Path) -> Any:
    """The stage of ``file``. FileFormatError if it refers to others."""
    from pxr import Sdf, Usd

    layer = Sdf.Layer.OpenAsAnonymous(str(file))  # this file alone, without its references
    if layer is None:
        raise FileFormatError("not readable as USD")
    _refuse_references(layer)
    return Usd.Stage.Open(layer)


def _refuse_references(layer: Any) -> None:
    """FileFormatError if the file refers to others."""
    others = [str(p) for p in layer.GetCompositionAssetDependencies() if p]  # '': a reference within the file
    clips: list[str] = []
    layer.Traverse("/", lambda at: clips.append(str(at)) if _has_clips(layer, at) else None)
    if others or clips:
        named = ", ".join(others[:3])[:200] if others else f"value clips of {clips[0][:100]}"
        raise FileFormatError(
            f'refers to other files ({named}), which are not opened; put all into one: python -c "from pxr'
            " import Usd; Usd.Stage.Open('old.usda').Flatten().Export('new.usdc')\", with new.usdc in the"
            " folder of its textures or above"
        )


def _has_clips(layer: Any, at: Any) -> bool:
    prim = layer.GetPrimAtPath(at) if at.IsPrimPath() else None
    return prim is not None and prim.HasInfo("clips")


class Shapes(NamedTuple):
    """What a stage shows."""

    meshes: list[Any]
    """UsdGeom.Mesh of each that is visible."""
    others: int
    """Other visible shapes."""
    instancers: int
    """Visible point instancers, which draw copies of what is below them."""

    @property
    def left_out(self) -> str:
        """The shapes that are not read, in words; empty if there are none."""
        said = [f"{self.others:,} shapes that are no meshes"] if self.others else []
        if self.instancers:
            said.append(f"{self.instancers:,} point instancers (make their copies meshes before the export)")
        return " and ".join(said)


def visible_prims(stage: Any) -> Iterator[Any]:
    """The prims that renderers draw, but for copies of point instancers."""
    from pxr import Usd, UsdGeom

    prims = iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
    for prim in prims:
        if prim.IsA(UsdGeom.PointInstancer):
            prims.PruneChildren()  # models of the copies, not drawn where they stand
        if is_visible(prim):
            yield prim


def visible_shapes(stage: Any) -> Shapes:
    """The shapes that renderers draw."""
    from pxr import UsdGeom

    meshes, others, instancers = [], 0, 0
    for prim in visible_prims(stage):
        if prim.GetParent().HasAttribute(BLENDER + "stand_in"):
            continue  # only takes light in Blender
        if prim.IsA(UsdGeom.Mesh):
            meshes.append(UsdGeom.Mesh(prim))
        instancers += prim.IsA(UsdGeom.PointInstancer)
        others += prim.IsA(UsdGeom.Gprim) and not prim.IsA(UsdGeom.Mesh)
    return Shapes(meshes, others, instancers)


def metres(stage: Any) -> float:
    """Metres in a unit of a stage that states them, else 1."""
    from pxr import UsdGeom

    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        return 1.0
    stated = float(f"{UsdGeom.GetStageMetersPerUnit(stage):.6g}")  # of float32, too
    return stated if 0 < stated < math.inf else 1.0


def say_units(unit: float) -> list[str]:
    """A warning of a stage in other units than metres; none for ``unit`` 1."""
    if unit == 1:
        return []
    return [f"its unit is {unit:g} m: read in metres, coordinates times {unit:g}"]


def is_visible(prim: Any) -> bool:
    """Whether renderers draw it, and what is below it."""
    from pxr import Usd, UsdGeom

    imageable = UsdGeom.Imageable(prim)
    if not imageable or imageable.ComputePurpose() in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
        return False
    visibility = imageable.ComputeVisibility(Usd.TimeCode.EarliestTime())
    return bool(visibility != UsdGeom.Tokens.invisible)
