"""Surfaces as OpenUSD: a mesh with a UsdPreviewSurface, whose texture is beside, or inside a `.usdz`."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._files.atomic import write_bytes
from meshsplats.errors import MissingDependencyError
from meshsplats.formats.surfaces.corners import normal_file, smooth_normals, texture_file
from meshsplats.formats.usd.cameras import add_cameras
from meshsplats.formats.usd.materials import normal_reader, preview_material, primvar_reader, texture_reader
from meshsplats.formats.usd.splats_writer import export, packed
from meshsplats.formats.usd.stage import make_collider, placed_mesh
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import srgb_to_linear


def write_surface_usd(
    base: BaseMesh,
    path: Path,
    target: Path,
    *,
    unlit: bool,
    image: str | None,
    collision: str | None = None,
    cameras: Sequence[Camera] = (),
) -> None:
    """Writes ``base`` to ``path``, which will be ``target``: see ``save_base``."""
    try:
        import pxr  # noqa: F401
    except ModuleNotFoundError as error:
        raise MissingDependencyError("writing USD needs the extra 'usd': pip install usd-core") from error
    stem = target.stem if target.suffix.lower() != ".usdz" else "surface"
    pictures: dict[str, bytes] = {}
    if base.textured:
        suffix, content = texture_file(base, image or ".png")
        pictures[f"{stem}{suffix}"] = content
    if base.textured and base.normal_map is not None and not unlit:
        suffix, content = normal_file(base, image)
        pictures[f"{stem}_normal{suffix}"] = content
    stage = _stage(base, unlit, list(pictures), collision)
    add_cameras(stage, cameras, base.vertices)
    if target.suffix.lower() != ".usdz":
        for name, content in pictures.items():
            write_bytes(target.with_name(name), content)
        export(stage, path)
        return
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".meshsplats-") as folder:
        inner = Path(folder) / "surface.usdc"
        for name, content in pictures.items():
            inner.with_name(name).write_bytes(content)
        export(stage, inner)
        packed(inner, path)


def _stage(base: BaseMesh, unlit: bool, pictures: list[str], collision: str | None) -> Any:
    """The stage; ``pictures``: the names of the files of texture and normal map, as far as there are any."""
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    types, at = Sdf.ValueTypeNames, "/Splats/Material"
    stage, shape = placed_mesh(base, "Surface", double_sided=False)
    shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(smooth_normals(base)))
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    if collision is not None:
        make_collider(shape, drawn=collision == "drawn")
    if pictures and base.uv is not None:
        uv = base.uv.copy()
        uv[..., 1] = 1 - uv[..., 1]  # USD's v is up
        st = UsdGeom.PrimvarsAPI(shape).CreatePrimvar("st", types.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        st.Set(Vt.Vec2fArray.FromNumpy(uv.reshape(-1, 2)))
        texture = texture_reader(stage, at, f"./{pictures[0]}", base.textures[0].wrap)
        color: Any = texture.CreateOutput("rgb", types.Float3)
    elif base.colors is not None:
        linear = np.ascontiguousarray(srgb_to_linear(base.colors[:, :3]), np.float32)
        shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(linear))
        color = primvar_reader(stage, f"{at}/Color", "displayColor", types.Float3, (0.5, 0.5, 0.5))
    else:
        color = Gf.Vec3f(0.2)
    normal = normal_reader(stage, at, f"./{pictures[1]}") if len(pictures) > 1 else None
    material = preview_material(stage, at, color, lit=not unlit, normal=normal)
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
    note: dict[str, Any] = {"version": 1, "blending": "display", "up": Gf.Vec3d(*map(float, base.up))}
    if base.origin.any():
        note["origin"] = Gf.Vec3d(*base.origin.tolist())
    shape.GetPrim().SetCustomData({"meshsplats": note})
    return stage
