"""Writes meshes as Universal Scene Description (`.usdc`, `.usda`, `.usd`), for film tools, Omniverse and
Blender.

Needs the optional package usd-core. One Mesh under an Xform that rotates the mesh's up direction to the
stage's +y and moves the mesh to its origin; points are stored unchanged, metersPerUnit is 1. Colour and
opacity are the primvars displayColor (linear) and displayOpacity, one value per vertex, and a
UsdPreviewSurface material reads them. All else is in the mesh's custom data. Schemas:
https://openusd.org/release/api/usd_geom_page_front.html and spec_usdpreviewsurface.html there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.errors import MissingDependencyError
from meshsplats.formats._validation import check_attribute_names
from meshsplats.formats.gltf.writer import computed_normals, linear_colors
from meshsplats.formats.usd.materials import preview_material, primvar_reader
from meshsplats.formats.usd.stage import placed_mesh
from meshsplats.scene.mesh import SplatMesh


def write_usd(mesh: SplatMesh, path: Path, *, lit: bool = False) -> None:
    """Writes ``mesh`` to ``path``: text for `.usda`, binary for `.usdc` and `.usd`.

    The material emits the colours; ``lit`` makes it a rough surface that scene lights shade, with the mesh's
    normals or else area-weighted vertex normals. Splat indices, depth groups and attributes become primvars
    of the same names (characters that USD forbids become underscores), as do harmonics, constant and splat by
    splat, and ``colors``, display RGB, where programs without harmonics should show others. Raises
    MissingDependencyError without usd-core.
    """
    try:
        import pxr  # noqa: F401
    except ModuleNotFoundError as error:
        raise MissingDependencyError("writing USD needs the extra 'usd': pip install usd-core") from error
    stage = mesh_stage(mesh, lit=lit)  # its layer does not outlive it
    if not stage.GetRootLayer().Export(str(path)):
        raise OSError(f"usd-core could not write {path}")


def mesh_stage(mesh: SplatMesh, *, lit: bool) -> Any:
    """The stage that ``write_usd`` writes. Needs usd-core."""
    from pxr import Gf, Sdf, Tf, UsdGeom, Vt

    check_attribute_names(mesh)
    stage, shape = placed_mesh(mesh)
    normals = computed_normals(mesh) if lit and mesh.normals is None else mesh.normals
    if normals is not None:
        shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
        shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    shown = mesh.plain
    linear = linear_colors(shown, "float32")
    colors = shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    colors.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(linear[:, :3])))
    opacities = shape.CreateDisplayOpacityPrimvar(UsdGeom.Tokens.vertex)
    opacities.Set(Vt.FloatArray.FromNumpy(np.ascontiguousarray(linear[:, 3])))
    _add_material(stage, shape, lit, opaque=bool((mesh.colors[:, 3] == 1).all()))
    primvars = UsdGeom.PrimvarsAPI(shape)
    types = {
        np.int32: (Sdf.ValueTypeNames.IntArray, Vt.IntArray),
        np.float32: (Sdf.ValueTypeNames.FloatArray, Vt.FloatArray),
    }
    # displayColor gives plain colours back.
    extras = {field.name: values for field, values in mesh.extras().items() if field.name != "plain_colors"}
    if shown is not mesh:
        extras["colors"] = np.ascontiguousarray(mesh.colors[:, :3])
    for name, values in extras.items():
        kind, array = types[values.dtype.type]
        per, columns = {
            "face_splat": (UsdGeom.Tokens.uniform, -1),
            "depth_group": (UsdGeom.Tokens.uniform, -1),
            "colors": (UsdGeom.Tokens.vertex, 3),
            "harmonics": (UsdGeom.Tokens.constant, values.size),
        }[name]
        primvars.CreatePrimvar(name, kind, per, columns).Set(array.FromNumpy(values.reshape(-1)))
    up = Gf.Vec3d(*(float(u) for u in mesh.up))
    note: dict[str, Any] = {"version": 1, "blending": mesh.blending, "up": up}
    note |= {name: True for name in extras}
    if mesh.harmonics is not None:
        note["harmonics"] = mesh.sh_degree
    if mesh.plain_colors is not None:
        note["plain_colors"] = True
    if mesh.origin.any():
        note["origin"] = Gf.Vec3d(*mesh.origin.tolist())
    if lit and mesh.normals is None:
        note["normals"] = "computed"
    if mesh.filter_px2:
        note["filter_px2"] = mesh.filter_px2
    if mesh.order != "fragment":
        note["order"] = mesh.order
    taken = {"displayColor", "displayOpacity", "normals", "colors", *(field.name for field in mesh.EXTRAS)}
    stored: list[tuple[str, str, int]] = []
    for name, values in mesh.attributes.items():
        columns = 1 if values.ndim == 1 else values.shape[1]
        plain = Tf.MakeValidIdentifier(name)
        while plain in taken:
            plain += "_"
        taken.add(plain)
        stored.append((name, plain, -1 if values.ndim == 1 else columns))
        if columns == 0:
            continue
        new = primvars.CreatePrimvar(plain, Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex, columns)
        new.Set(Vt.FloatArray.FromNumpy(values.reshape(-1)))
    if stored:
        names, plain_names, widths = zip(*stored, strict=True)
        note |= {"attributes": Vt.StringArray(names), "primvars": Vt.StringArray(plain_names)}
        note["columns"] = Vt.IntArray(widths)  # -1: one number per vertex, not a table of one column
    shape.GetPrim().SetCustomData({"meshsplats": note})
    return stage


def _add_material(stage: Any, shape: Any, lit: bool, *, opaque: bool) -> None:
    """A UsdPreviewSurface whose colour and, unless all is opaque, opacity come from the primvars."""
    from pxr import Sdf, UsdShade

    types, at = Sdf.ValueTypeNames, "/Splats/Material"
    color = primvar_reader(stage, f"{at}/Color", "displayColor", types.Float3, (0.5, 0.5, 0.5))
    opacity = None if opaque else primvar_reader(stage, f"{at}/Opacity", "displayOpacity", types.Float, 1.0)
    material = preview_material(stage, at, color, lit=lit, opacity=opacity)
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
