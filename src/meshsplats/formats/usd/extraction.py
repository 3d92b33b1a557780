"""The part of reading USD that runs in a process of its own, which ``reader`` starts.

    python -m meshsplats.formats.usd.extraction FILE RESULT [X Y Z]

writes the arrays of all meshes of FILE to RESULT (.npz), relative to the origin X Y Z, by default one that
suits them, and prints a line of JSON: {"error": text}, or a report with the other contents.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from meshsplats._common.arrays import joined_rows
from meshsplats.errors import FileFormatError
from meshsplats.formats._validation import Budget
from meshsplats.formats.usd.looks import GREY, Looks
from meshsplats.formats.usd.motion import placements, sample_times, vertices_at
from meshsplats.formats.usd.opening import BLENDER, main, metres, opened, say_units, visible_shapes
from meshsplats.formats.usd.own_notes import is_own_placement, our_note, restored
from meshsplats.formats.usd.polygons import Polygons, polygons_of, primvar
from meshsplats.formats.usd.skeletons import pose
from meshsplats.scene.colors import srgb_to_linear
from meshsplats.scene.origin import choose_origin, lost_detail, sampled, zero_origin
from meshsplats.scene.spherical_harmonics import moved_harmonics


class Piece(NamedTuple):
    """One mesh."""

    arrays: dict[str, np.ndarray]
    """Vertices, triangles, linear colours, and normals if it has any, in its own frame."""
    rows: np.ndarray | slice
    """The points of the mesh that its vertices are."""


def extract_meshes(
    file: Path, result: Path, origin: np.ndarray | None, *, frames: bool = False
) -> dict[str, Any]:
    """Writes the arrays; returns warnings, up direction, origin, blending, names of attributes, whether there
    are textures, and the times at which meshes have values. ``frames`` adds (t, v, 3) float32 ``frames``, the
    vertices at each of these. Raises FileFormatError."""
    from pxr import UsdGeom

    stage = opened(file)
    times, warnings = pose(stage, whole=frames)
    shown = visible_shapes(stage)
    shapes = shown.meshes
    if not shapes:
        others = f", but {shown.left_out}" if shown.left_out else ""
        raise FileFormatError(f"the stage holds no visible mesh{others}")
    report: dict[str, Any] = {"warnings": warnings, "attributes": [], "blending": "display"}
    if shown.left_out:
        warnings.append(f"{shown.left_out} were left out")
    budget, unit = Budget(file), metres(stage)
    warnings += say_units(unit)
    note = our_note(shapes[0]) if len(shapes) == 1 else {}
    matrices = placements(shapes, unit)
    own = bool(note) and unit == 1 and is_own_placement(matrices[0], note)
    back = np.linalg.inv(matrices[0]) if own else np.eye(4)
    if own:
        report["up"], matrices = note["up"], [np.eye(4)]
    looks = Looks()
    pieces = [_piece(shape, budget, looks) for shape in shapes]
    if own:
        origin = np.array(note["origin"])
    elif origin is None:
        origin = _chosen_origin([piece.arrays for piece in pieces], matrices, report)
    for piece, matrix in zip(pieces, matrices, strict=True):
        _put(piece.arrays, matrix, zero_origin() if own else origin, exact=bool(note))
    report["origin"] = origin.tolist()
    report.setdefault("up", [0, 0, 1] if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else [0, 1, 0])
    arrays = _joined([piece.arrays for piece in pieces])
    if note:
        report["blending"] = note["blending"]
        arrays |= restored(shapes[0], note, arrays, report)
        if "harmonics" in arrays and not own:
            arrays["harmonics"] = moved_harmonics(arrays["harmonics"], matrices[0][:3, :3].T)
    if note.get("normals") == "computed":
        arrays.pop("normals", None)
    report["textured"] = looks.textured
    report["times"] = sorted(times | sample_times(shapes))
    if frames:
        budget.spend(12 * len(report["times"]) * len(arrays["vertices"]), "its frames")
        rows, shift = [piece.rows for piece in pieces], zero_origin() if own else origin
        arrays["frames"] = np.empty((len(report["times"]), *arrays["vertices"].shape), np.float32)
        for time, frame in zip(report["times"], arrays["frames"], strict=True):
            moved = [matrix @ back for matrix in placements(shapes, unit, time)]
            frame[:] = vertices_at(time, shapes, rows, moved) - shift
    np.savez(result, **arrays)  # type: ignore[arg-type]
    return report


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


def _piece(shape: Any, budget: Budget, looks: Looks) -> Piece:
    polygons = polygons_of(shape, budget)
    points, corners, n = polygons.points, polygons.corners, len(polygons.lengths)
    color, color_kind = primvar(shape, "displayColor", 3, polygons)
    opacity, opacity_kind = primvar(shape, "displayOpacity", 1, polygons)
    from_blender = color is None and shape.GetPrim().HasAttribute(BLENDER + "lit")
    if from_blender:
        color, color_kind, opacity, opacity_kind = _from_blender(shape, polygons)
    look = looks.of_faces(shape, n)
    rgba, kind = looks.colors(look)
    if rgba is not None and not from_blender and not our_note(shape):
        color, color_kind = _over(rgba[:, :3], kind, color, color_kind, GREY, polygons)
        opacity, opacity_kind = _over(rgba[:, 3:], kind, opacity, opacity_kind, 1.0, polygons)
    rows: np.ndarray | slice = slice(None)
    linear = np.ones((len(points), 4 if color is not None or opacity is not None else 0), np.float32)
    normals, kind = primvar(shape, "normals", 3, polygons)
    if kind not in ("vertex", "varying"):
        normals = None
    if "uniform" in (color_kind, opacity_kind) or "faceVarying" in (color_kind, opacity_kind):
        # Colours differ between corners of a vertex: each corner becomes a vertex of its own.
        budget.spend(64 * len(corners), f"mesh {polygons.at}")
        rows = corners
        points, normals = points[rows], None if normals is None else normals[rows]
        color = None if color is None else polygons.at_corners(color, color_kind)
        opacity = None if opacity is None else polygons.at_corners(opacity, opacity_kind)
        linear = np.ones((len(corners), 4), np.float32)
        corners = np.arange(len(corners))
    if color is None and linear.shape[1]:
        linear[:, :3] = GREY
    for values, columns in ((color, slice(0, 3)), (opacity, slice(3, 4))):
        if values is not None:
            linear[:, columns] = values
    faces = corners[polygons.cut].astype(np.int32)
    piece = {"vertices": points, "faces": faces, "linear": linear}
    return Piece(piece if normals is None else piece | {"normals": normals}, rows)


def _over(
    values: np.ndarray,
    kind: str,
    others: np.ndarray | None,
    other_kind: str,
    fallback: float,
    polygons: Polygons,
) -> tuple[np.ndarray, str]:
    """The ``values`` (k, columns) of a material, and where it leaves them open (NaN), those of a primvar, or
    the ``fallback``; and their interpolation."""
    left = np.isnan(values)
    if others is None or not left.any():
        return np.where(left, np.float32(fallback), values), kind
    if left.all():
        return others, other_kind
    first, second = polygons.at_corners(values, kind), polygons.at_corners(others, other_kind)
    return np.where(np.isnan(first), second, first), "faceVarying"


def _from_blender(shape: Any, polygons: Polygons) -> tuple[np.ndarray | None, str, np.ndarray | None, str]:
    """Linear colours and opacities, and their interpolations, of a splat mesh of ours that Blender's exporter
    wrote: as RGBA in a primvar of its attribute's name, display values unless its note says linear."""

    def noted(name: str) -> bool:
        return bool(shape.GetPrim().GetAttribute(BLENDER + name).Get())

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


if __name__ == "__main__":
    main(sys.argv[1:], extract_meshes)
