"""The part of reading USD that runs in a process of its own, which ``reader`` starts.

    python -m meshsplats.formats.usd.extraction FILE RESULT [X Y Z]

writes the arrays of all meshes of FILE to RESULT (.npz), relative to the origin X Y Z, by default one that
suits them, and prints a line of JSON: {"error": text}, or a report with the other contents.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._arrays import joined_rows
from meshsplats._origin import choose_origin, lost_detail, sampled, zero_origin
from meshsplats.colors import srgb_to_linear
from meshsplats.errors import FileFormatError
from meshsplats.formats._validation import Budget
from meshsplats.formats.usd.looks import GREY, Looks
from meshsplats.formats.usd.opening import BLENDER, main, opened, visible_meshes
from meshsplats.formats.usd.own_notes import is_own_placement, our_note, restored
from meshsplats.formats.usd.polygons import Polygons, polygons_of, primvar
from meshsplats.spherical_harmonics import moved_harmonics


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
        arrays |= restored(shapes[0], note, arrays, report)
        if "harmonics" in arrays and not own:
            arrays["harmonics"] = moved_harmonics(arrays["harmonics"], matrices[0][:3, :3].T)
    if note.get("normals") == "computed":
        arrays.pop("normals", None)
    report["textured"] = looks.textured
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


def _piece(shape: Any, budget: Budget, looks: Looks) -> dict[str, np.ndarray]:
    """Arrays of one mesh in its own frame."""
    polygons = polygons_of(shape, budget)
    points, corners, n = polygons.points, polygons.corners, len(polygons.lengths)
    color, color_kind = primvar(shape, "displayColor", 3, polygons)
    opacity, opacity_kind = primvar(shape, "displayOpacity", 1, polygons)
    if color is None and shape.GetPrim().HasAttribute(BLENDER + "lit"):
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
    faces = corners[polygons.cut].astype(np.int32)
    piece = {"vertices": points, "faces": faces, "linear": linear}
    return piece if normals is None else piece | {"normals": normals}


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
