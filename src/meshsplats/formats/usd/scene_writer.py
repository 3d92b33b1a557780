"""Writes several parts of a scene as one USD file: each as its own writer makes it, below /Scene.

The collider has the purpose 'guide', which renderers leave out, and UsdPhysics' CollisionAPI. Textures lie
beside the layer in a .usdz package. Schemas: https://openusd.org/release/api/usd_physics_page_front.html.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.errors import MissingDependencyError
from meshsplats.formats._scene import SceneParts
from meshsplats.formats.gltf.scene_writer import alpha_mode, png_of
from meshsplats.formats.surfaces.corners import normal_file, smooth_normals
from meshsplats.formats.usd.materials import normal_reader, preview_material, texture_reader
from meshsplats.formats.usd.splats_writer import export, packed, splats_stage
from meshsplats.formats.usd.stage import make_collider, new_stage, placed_mesh
from meshsplats.formats.usd.writer import mesh_stage
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.colors import srgb_to_linear

_NORMALS = "normals.png"


def write_scene_usd(parts: SceneParts, path: Path, where: Path, *, lit: bool) -> None:
    """Writes ``parts``; see ``save_scene``. ``where``: the name of the file in the end.

    Raises MissingDependencyError without usd-core.
    """
    try:
        from pxr import Kind, Sdf, Usd
    except ModuleNotFoundError as error:
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
        if _has_relief(parts.surface, lit):
            images[_NORMALS] = normal_file(parts.surface)[1]
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


def _collider_stage(collider: BaseMesh) -> Any:
    stage, shape = placed_mesh(collider)
    make_collider(shape, drawn=False)
    return stage


def _surface_stage(base: BaseMesh, lit: bool) -> Any:
    """Faces of each texture are a subset with a material of their own; others have displayColor."""
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    stage, shape = placed_mesh(base)
    if lit:
        shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(smooth_normals(base)))
        shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
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

    types, texture, at = Sdf.ValueTypeNames, base.textures[i], f"/Splats/Texture_{i}"
    image = texture_reader(stage, at, f"texture_{i}.png", texture.wrap)
    image.CreateInput("scale", types.Float4).Set(tuple(texture.factor))
    opacity = None if alpha_mode(texture) == "OPAQUE" else image.CreateOutput("a", types.Float)
    color = image.CreateOutput("rgb", types.Float3)
    normal = normal_reader(stage, at, _NORMALS) if _has_relief(base, lit) else None
    material = preview_material(stage, at, color, lit=lit, opacity=opacity, normal=normal)
    if alpha_mode(texture) == "MASK":  # cut out, so that nothing has to be sorted
        UsdShade.Shader.Get(stage, f"{at}/Surface").CreateInput("opacityThreshold", types.Float).Set(0.5)
    return material


def _has_relief(base: BaseMesh, lit: bool) -> bool:
    """Whether the normal map of the surface counts."""
    return lit and base.normal_map is not None
