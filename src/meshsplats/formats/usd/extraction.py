"""The part of reading USD that runs in a process of its own, which ``reader`` starts.

    python -m meshsplats.formats.usd.extraction FILE RESULT [X Y Z]

writes the arrays of all meshes of FILE to RESULT (.npz), relative to the origin X Y Z, by default one that
suits them, and prints a line of JSON: {"error": text}, or a report with the other contents.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from meshsplats._arrays import joined_rows
from meshsplats._origin import choose_origin, lost_detail, sampled, zero_origin
from meshsplats.colors import srgb_to_linear
from meshsplats.errors import FileFormatError
from meshsplats.formats._orientation import up_quaternion
from meshsplats.formats._validation import Budget
from meshsplats.formats.usd.looks import GREY, Looks
from meshsplats.formats.usd.polygons import Polygons, polygons_of, primvar
from meshsplats.mesh import Blending, SplatMesh
from meshsplats.spherical_harmonics import TERMS, moved_harmonics

_BLENDER = "userProperties:meshsplats_"
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


def extract_meshes(file: Path, result: Path, origin: np.ndarray | None) -> dict[str, Any]:
    """Writes the arrays; returns warnings, up direction, origin, blending, names of attributes and whether
    there are textures. Raises FileFormatError."""
    from pxr import Usd, UsdGeom

    stage = opened(file)
    shapes, others = visible_meshes(stage)
    if not shapes:
        raise FileFormatError(
            "the stage holds no visible mesh" + (f", but {others:,} other shapes" if others else "")
        )
    report: dict[str, Any] = {"warnings": [], "attributes": [], "blending": "display"}
    if others:
        report["warnings"].append(f"{others:,} shapes that are no meshes were left out")
    budget = Budget(file)
    note = our_note(shapes[0]) if len(shapes) == 1 else {}
    places = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
    matrices, own = [], False
    for shape in shapes:
        matrix = np.array(places.GetLocalToWorldTransform(shape.GetPrim()))
        if note and is_own_placement(matrix, note):
            report["up"], own = note["up"], True
            matrix = np.eye(4)
        matrices.append(matrix)
    looks = Looks()
    pieces = [_piece(shape, budget, looks) for shape in shapes]
    if own:
        origin = np.array(note["origin"])
    elif origin is None:
        origin = _chosen_origin(pieces, matrices, report)
    for piece, matrix in zip(pieces, matrices, strict=True):
        _put(piece, matrix, zero_origin() if own else origin, exact=bool(note))
    report["origin"] = origin.tolist()
    report.setdefault("up", [0, 0, 1] if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else [0, 1, 0])
    arrays = _joined(pieces)
    if note:
        report["blending"] = note["blending"]
        arrays |= _restored(shapes[0], note, arrays, report)
        if "harmonics" in arrays and not own:
            arrays["harmonics"] = moved_harmonics(arrays["harmonics"], matrices[0][:3, :3].T)
    if note.get("normals") == "computed":
        arrays.pop("normals", None)
    report["textured"] = looks.textured
    np.savez(result, **arrays)  # type: ignore[arg-type]
    return report


def _refuse_references(layer: Any) -> None:
    """FileFormatError if the file refers to others."""
    others = [str(p) for p in layer.GetCompositionAssetDependencies() if p]  # '': a reference within the file
    clips: list[str] = []
    layer.Traverse("/", lambda at: clips.append(str(at)) if _has_clips(layer, at) else None)
    if others or clips:
        named = ", ".join(others[:3])[:200] if others else f"value clips of {clips[0][:100]}"
        raise FileFormatError(
            f"refers to other files ({named}), which are not opened; put all into one: usdcat --flatten"
        )


def _has_clips(layer: Any, at: Any) -> bool:
    prim = layer.GetPrimAtPath(at) if at.IsPrimPath() else None
    return prim is not None and prim.HasInfo("clips")


def visible_meshes(stage: Any) -> tuple[list[Any], int]:
    """The visible meshes, and the count of other visible shapes."""
    from pxr import Usd, UsdGeom

    meshes, others = [], 0
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if not is_visible(prim):
            continue
        if prim.GetParent().HasAttribute(_BLENDER + "stand_in"):
            continue  # only takes light in Blender
        if prim.IsA(UsdGeom.Mesh):
            meshes.append(UsdGeom.Mesh(prim))
        elif prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer):
            others += 1
    return meshes, others


def is_visible(prim: Any) -> bool:
    """Whether renderers draw it, and what is below it."""
    from pxr import Usd, UsdGeom

    imageable = UsdGeom.Imageable(prim)
    if not imageable or imageable.ComputePurpose() in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
        return False
    visibility = imageable.ComputeVisibility(Usd.TimeCode.EarliestTime())
    return bool(visibility != UsdGeom.Tokens.invisible)


def _chosen_origin(
    pieces: list[dict[str, np.ndarray]], matrices: list[np.ndarray], report: dict[str, Any]
) -> np.ndarray:
    """The origin that suits the meshes of another program."""
    few = [
        sampled(piece["vertices"]) @ matrix[:3, :3] + matrix[3, :3]
        for piece, matrix in zip(pieces, matrices, strict=True)
    ]
    sample = np.concatenate(few)
    if all((matrix == np.eye(4)).all() for matrix in matrices) and (lost := lost_detail(sample)):
        report["warnings"].append(lost)
    return choose_origin(sample)


def _put(piece: dict[str, np.ndarray], matrix: np.ndarray, origin: np.ndarray, *, exact: bool) -> None:
    """Puts a mesh into the frame of the stage, relative to ``origin``. ``exact`` keeps lengths of normals."""
    points, normals = piece["vertices"], piece.get("normals")
    if (matrix != np.eye(4)).any():
        points = points @ matrix[:3, :3] + (matrix[3, :3] - origin)
        if normals is not None:
            normals = normals @ np.linalg.pinv(matrix[:3, :3]).T
    elif origin.any():
        points = points - origin
    piece["vertices"] = points.astype(np.float32)
    if normals is not None:
        if not exact:
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            normals = normals / np.where(length > 0, length, 1)
        piece["normals"] = normals.astype(np.float32)


def _piece(shape: Any, budget: Budget, looks: Looks) -> dict[str, np.ndarray]:
    """Arrays of one mesh in its own frame."""
    polygons = polygons_of(shape, budget)
    points, corners, n = polygons.points, polygons.corners, len(polygons.lengths)
    color, color_kind = primvar(shape, "displayColor", 3, polygons)
    opacity, opacity_kind = primvar(shape, "displayOpacity", 1, polygons)
    if color is None and shape.GetPrim().HasAttribute(_BLENDER + "lit"):
        color, color_kind, opacity, opacity_kind = _from_blender(shape, polygons)
    look = looks.of_faces(shape, n)
    if color is None and not our_note(shape):
        rgba, color_kind = looks.colors(look)
        if rgba is not None:
            color = rgba[:, :3]
            if opacity is None:
                opacity, opacity_kind = rgba[:, 3:], color_kind
    linear = np.ones((len(points), 4 if color is not None or opacity is not None else 0), np.float32)
    normals, kind = primvar(shape, "normals", 3, polygons)
    if kind not in ("vertex", "varying"):
        normals = None
    if "uniform" in (color_kind, opacity_kind) or "faceVarying" in (color_kind, opacity_kind):
        # Colours differ between corners of a vertex: each corner becomes a vertex of its own.
        budget.spend(64 * len(corners), f"mesh {polygons.at}")
        points, normals = points[corners], None if normals is None else normals[corners]
        color = None if color is None else polygons.at_corners(color, color_kind)
        opacity = None if opacity is None else polygons.at_corners(opacity, opacity_kind)
        linear = np.ones((len(corners), 4), np.float32)
        corners = np.arange(len(corners))
    if color is None and linear.shape[1]:
        linear[:, :3] = GREY
    for values, columns in ((color, slice(0, 3)), (opacity, slice(3, 4))):
        if values is not None:
            linear[:, columns] = values
    faces = polygons.triangles(corners).astype(np.int32)
    piece = {"vertices": points, "faces": faces, "linear": linear}
    return piece if normals is None else piece | {"normals": normals}


def _from_blender(shape: Any, polygons: Polygons) -> tuple[np.ndarray | None, str, np.ndarray | None, str]:
    """Linear colours and opacities, and their interpolations, of a splat mesh of ours that Blender's exporter
    wrote: as RGBA in a primvar of its attribute's name, display values unless its note says linear."""

    def noted(name: str) -> bool:
        return bool(shape.GetPrim().GetAttribute(_BLENDER + name).Get())

    rgba, kind = primvar(shape, "DisplayColor" if noted("lit") else "Color", 4, polygons)
    if rgba is None:
        return None, "", None, ""
    color = rgba[:, :3] if noted("linear") else srgb_to_linear(rgba[:, :3])
    return color, kind, rgba[:, 3:], kind


def _joined(pieces: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    columns = max(p["linear"].shape[1] for p in pieces)
    for p in pieces:
        if p["linear"].shape[1] < columns:
            p["linear"] = np.tile(np.array([GREY, GREY, GREY, 1], np.float32), (len(p["vertices"]), 1))
    try:
        return joined_rows(pieces)
    except ValueError as error:
        raise FileFormatError(str(error)) from None


# -- contents of our own files beyond the schemas


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


def _restored(
    shape: Any, note: dict[str, Any], arrays: dict[str, np.ndarray], report: dict[str, Any]
) -> dict[str, np.ndarray]:
    """Extra arrays, attributes and the filter. Arrays that another program has dropped or altered are left
    out, with a warning: better no splat indices than wrong ones."""
    from pxr import UsdGeom

    def stored(name: str, dtype: type) -> np.ndarray:
        primvar = UsdGeom.PrimvarsAPI(shape).GetPrimvar(name)
        return np.array((primvar.Get() if primvar.HasValue() else None) or [], dtype)

    restored: dict[str, np.ndarray] = {}
    lost: list[str] = []
    v = len(arrays["vertices"])
    for field in SplatMesh.EXTRAS:
        if field.per == "face" and note.get(field.name) is True:
            values = stored(field.name, field.dtype)
            wanted = field.shape({"vertex": v, "face": len(arrays["faces"])})
            sorted_ = field.name != "face_splat" or not (values[1:] < values[:-1]).any()
            if values.size == math.prod(wanted) and sorted_:
                restored[field.name] = values.reshape(wanted)
            else:
                lost.append(field.name)
    if note.get("colors") is True:
        values = stored("colors", np.float32)
        if values.size == 3 * v:
            restored["colors"] = values.reshape(v, 3)
            report["plain_colors"] = note.get("plain_colors") is True
        else:
            lost.append("colors")
    if "harmonics" in note:
        degree = note["harmonics"]
        if type(degree) is not int or degree not in (1, 2, 3):
            raise FileFormatError(f"harmonics must have degree 1, 2 or 3, got {str(degree)[:60]}")
        splats, terms = len(np.unique(restored.get("face_splat", ()))), TERMS[degree - 1]
        values = stored("harmonics", np.float32)
        known = {"face_splat", "colors"} <= restored.keys()
        if known and values.size == splats * terms * 3:
            restored["harmonics"] = values.reshape(splats, terms, 3)
        else:
            lost.append("harmonics")
    if "filter_px2" in note:
        variance = note["filter_px2"]
        if not isinstance(variance, (int, float)):
            raise FileFormatError(f"filter_px2 must be a number, got {str(variance)[:60]}")
        if "face_splat" in restored:
            report["filter_px2"] = float(variance)
        else:
            lost.append("the filter of its splats")
    if "order" in note:
        if "face_splat" in restored:
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
        restored[f"attribute_{len(report['attributes'])}"] = values.reshape(rows)
        report["attributes"].append(name)
    if lost:
        report["warnings"].append(f"another program has altered the file, left out: {', '.join(lost)[:300]}")
    return restored


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


if __name__ == "__main__":
    main(sys.argv[1:], extract_meshes)
