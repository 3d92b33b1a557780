"""Surfaces as OpenUSD: a mesh with a UsdPreviewSurface, whose texture is beside, or inside a `.usdz`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._files.atomic import write_bytes
from meshsplats.base_mesh import BaseMesh
from meshsplats.colors import srgb_to_linear
from meshsplats.errors import MissingDependencyError
from meshsplats.formats._orientation import turned_origin, up_quaternion
from meshsplats.formats.surfaces.corners import smooth_normals, texture_file
from meshsplats.formats.usd.stage import new_stage


def write_surface_usd(base: BaseMesh, path: Path, target: Path, *, unlit: bool, image: str | None) -> None:
    """Writes ``base`` to ``path``, which will be ``target``: see ``save_base``."""
    try:
        from pxr import UsdUtils
    except ImportError as error:
        raise MissingDependencyError("writing USD needs the extra 'usd': pip install usd-core") from error
    suffix, content = texture_file(base, image or ".png") if base.textured else ("", b"")
    picture = target.with_suffix(suffix) if base.textured else None
    if target.suffix.lower() != ".usdz":
        if picture is not None:
            write_bytes(picture, content)
        _export(_stage(base, unlit, picture.name if picture else None), path)
        return
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".meshsplats-") as folder:
        inner = Path(folder) / "surface.usdc"
        if picture is not None:
            inner.with_suffix(suffix).write_bytes(content)
        _export(_stage(base, unlit, f"surface{suffix}" if picture else None), inner)
        if not UsdUtils.CreateNewUsdzPackage(str(inner), str(path)):
            raise OSError(f"usd-core could not write {path}")


def _export(stage: Any, path: Path) -> None:
    if not stage.GetRootLayer().Export(str(path)):
        raise OSError(f"usd-core could not write {path}")


def _stage(base: BaseMesh, unlit: bool, picture: str | None) -> Any:
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    types = Sdf.ValueTypeNames
    stage, root = new_stage()
    x, y, z, w = up_quaternion(base.up)
    if base.origin.any():
        root.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*turned_origin(base).tolist()))
    root.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
    shape = UsdGeom.Mesh.Define(stage, "/Splats/Surface")
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(base.vertices))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(base.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(base.faces.reshape(-1)))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    corners = np.stack([base.vertices.min(axis=0), base.vertices.max(axis=0)])
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners))
    shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(smooth_normals(base)))
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    primvars = UsdGeom.PrimvarsAPI(shape)
    material = UsdShade.Material.Define(stage, "/Splats/Material")

    def shader(name: str, kind: str, **inputs: tuple[Any, Any]) -> Any:
        made = UsdShade.Shader.Define(stage, f"/Splats/Material/{name}")
        made.CreateIdAttr(kind)
        for key, (type_of, value) in inputs.items():
            slot = made.CreateInput(key, type_of)
            if isinstance(value, UsdShade.Output):
                slot.ConnectToSource(value)
            else:
                slot.Set(value)
        return made

    if picture is not None and base.uv is not None:
        uv = base.uv.copy()
        uv[..., 1] = 1 - uv[..., 1]  # USD's v is up
        st = primvars.CreatePrimvar("st", types.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        st.Set(Vt.Vec2fArray.FromNumpy(uv.reshape(-1, 2)))
        reader = shader("Coordinates", "UsdPrimvarReader_float2", varname=(types.String, "st"))
        texture = shader(
            "Texture",
            "UsdUVTexture",
            file=(types.Asset, Sdf.AssetPath(f"./{picture}")),
            st=(types.Float2, reader.CreateOutput("result", types.Float2)),
            sourceColorSpace=(types.Token, "sRGB"),
            wrapS=(types.Token, "clamp"),
            wrapT=(types.Token, "clamp"),
        )
        color: Any = texture.CreateOutput("rgb", types.Float3)
    elif base.colors is not None:
        linear = np.ascontiguousarray(srgb_to_linear(base.colors[:, :3]), np.float32)
        shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(linear))
        reader = shader("Color", "UsdPrimvarReader_float3", varname=(types.String, "displayColor"))
        color = reader.CreateOutput("result", types.Float3)
    else:
        color = Gf.Vec3f(0.2)
    black = (types.Color3f, Gf.Vec3f(0))
    inputs = {"diffuseColor": black, "emissiveColor": black, "roughness": (types.Float, 1.0)}
    inputs["emissiveColor" if unlit else "diffuseColor"] = (types.Color3f, color)
    if unlit:  # the specular workflow with black has no reflections
        inputs |= {"useSpecularWorkflow": (types.Int, 1), "specularColor": black}
    preview = shader("Preview", "UsdPreviewSurface", **inputs)
    material.CreateSurfaceOutput().ConnectToSource(preview.CreateOutput("surface", types.Token))
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
    note: dict[str, Any] = {"version": 1, "blending": "display", "up": Gf.Vec3d(*map(float, base.up))}
    if base.origin.any():
        note["origin"] = Gf.Vec3d(*base.origin.tolist())
    shape.GetPrim().SetCustomData({"meshsplats": note})
    return stage
