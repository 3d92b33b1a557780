"""Writes several parts of a scene as one USD file: each as its own writer makes it, below /Scene.

The collider has the purpose 'guide', which renderers leave out, and UsdPhysics' CollisionAPI. Textures lie
beside the layer in a .usdz package. Schemas: https://openusd.org/release/api/usd_physics_page_front.html.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.base_mesh import BaseMesh
from meshsplats.colors import srgb_to_linear
from meshsplats.errors import MissingDependencyError
from meshsplats.formats._orientation import turned_origin, up_quaternion
from meshsplats.formats._scene import SceneParts
from meshsplats.formats.gltf.scene_writer import alpha_mode, png_of
from meshsplats.formats.usd.splats_writer import export, packed, splats_stage
from meshsplats.formats.usd.stage import new_stage
from meshsplats.formats.usd.writer import mesh_stage


def write_scene_usd(parts: SceneParts, path: Path, where: Path, *, lit: bool) -> None:
    """Writes ``parts``; see ``save_scene``. ``where``: the name of the file in the end.

    Raises MissingDependencyError without usd-core.
    """
    try:
        from pxr import Kind, Sdf, Usd
    except ImportError as error:
        raise MissingDependencyError(
            f"{where}: writing USD needs the extra 'usd': pip install usd-core"
        ) from error
    stages, images = {}, {}
    if parts.splats is not None:
        stages["Splats"] = splats_stage(parts.splats, linear=False)
    if parts.mesh is not None:
        stages["Mesh"] = mesh_stage(parts.mesh, lit=lit)
    if parts.surface is not None:
        stages["Surface"] = _surface_stage(parts.surface, lit)
        images = {f"texture_{i}.png": png_of(t.pixels) for i, t in enumerate(parts.surface.textures)}
    if parts.collider is not None:
        stages["Collider"] = _collider_stage(parts.collider)
    scene, root = new_stage("/Scene")
    Usd.ModelAPI(root.GetPrim()).SetKind(Kind.Tokens.assembly)
    for name, stage in stages.items():
        Sdf.CopySpec(stage.GetRootLayer(), "/Splats", scene.GetRootLayer(), f"/Scene/{name}")
    if where.suffix.lower() != ".usdz":
        export(scene, path)
        return
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".meshsplats-") as folder:
        for name, data in images.items():
            (Path(folder) / name).write_bytes(data)
        inner = Path(folder) / "scene.usdc"
        export(scene, inner)
        packed(inner, path)


def _shape_stage(base: BaseMesh) -> tuple[Any, Any]:
    """A stage with the triangles of ``base``, placed, and its mesh."""
    from pxr import Gf, UsdGeom, Vt

    stage, root = new_stage()
    if base.origin.any():
        root.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*turned_origin(base).tolist()))
    x, y, z, w = up_quaternion(base.up)
    root.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
    shape = UsdGeom.Mesh.Define(stage, "/Splats/Mesh")
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(base.vertices))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(base.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(base.faces.reshape(-1)))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(True)
    corners = np.stack([base.vertices.min(axis=0), base.vertices.max(axis=0)])
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners))
    return stage, shape


def _collider_stage(collider: BaseMesh) -> Any:
    from pxr import UsdGeom, UsdPhysics

    stage, shape = _shape_stage(collider)
    shape.CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
    UsdPhysics.MeshCollisionAPI.Apply(shape.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.none)
    return stage


def _surface_stage(base: BaseMesh, lit: bool) -> Any:
    """Faces of each texture are a subset with a material of their own; others have displayColor."""
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    stage, shape = _shape_stage(base)
    if base.colors is not None:
        colors = srgb_to_linear(base.colors[:, :3]).astype(np.float32)
        primvar = shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        primvar.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(colors)))
    if base.uv is None or base.face_texture is None:
        return stage
    flipped = base.uv.reshape(-1, 2) * np.array([1, -1], np.float32) + np.array([0, 1], np.float32)
    st = UsdGeom.PrimvarsAPI(shape).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    )
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(flipped)))
    for i in np.unique(base.face_texture[base.face_texture >= 0]).tolist():
        faces = np.flatnonzero(base.face_texture == i).astype(np.int32)
        subset = UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).CreateMaterialBindSubset(
            f"texture_{i}", Vt.IntArray.FromNumpy(faces)
        )
        material = _textured(stage, i, base, lit)
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    return stage


def _textured(stage: Any, i: int, base: BaseMesh, lit: bool) -> Any:
    """A UsdPreviewSurface that shows texture ``i``."""
    from pxr import Sdf, UsdShade

    types, texture = Sdf.ValueTypeNames, base.textures[i]
    at = f"/Splats/Texture_{i}"
    material = UsdShade.Material.Define(stage, at)
    reader = UsdShade.Shader.Define(stage, f"{at}/Coordinates")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    image = UsdShade.Shader.Define(stage, f"{at}/Image")
    image.CreateIdAttr("UsdUVTexture")
    image.CreateInput("file", types.Asset).Set(f"texture_{i}.png")
    image.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
    image.CreateInput("scale", types.Float4).Set(tuple(texture.factor))
    for axis, mode in zip("ST", texture.wrap, strict=True):
        image.CreateInput(f"wrap{axis}", types.Token).Set(mode)
    image.CreateInput("st", types.Float2).ConnectToSource(reader.CreateOutput("result", types.Float2))
    surface = UsdShade.Shader.Define(stage, f"{at}/Surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    shown = surface.CreateInput("diffuseColor" if lit else "emissiveColor", types.Color3f)
    shown.ConnectToSource(image.CreateOutput("rgb", types.Float3))
    if alpha_mode(texture) != "OPAQUE":
        opacity = surface.CreateInput("opacity", types.Float)
        opacity.ConnectToSource(image.CreateOutput("a", types.Float))
    surface.CreateInput("roughness", types.Float).Set(1.0)
    if not lit:
        surface.CreateInput("diffuseColor", types.Color3f).Set((0, 0, 0))
        surface.CreateInput("useSpecularWorkflow", types.Int).Set(1)
        surface.CreateInput("specularColor", types.Color3f).Set((0, 0, 0))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    return material
