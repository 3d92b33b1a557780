"""Materials of USD: UsdPreviewSurface, and what gives it colours. Needs usd-core.

Schema: https://openusd.org/release/spec_usdpreviewsurface.html.
"""

from __future__ import annotations

from typing import Any


def preview_material(
    stage: Any, at: str, color: Any, *, lit: bool, opacity: Any = None, normal: Any = None
) -> Any:
    """A material at the path ``at``: rough and without metal, of ``color``, the output of a shader or a
    value; ``lit`` by the lights of a scene, else emitting its colour. ``opacity``, ``normal``: outputs of
    shaders."""
    from pxr import Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, at)
    surface = UsdShade.Shader.Define(stage, f"{at}/Surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    shown = surface.CreateInput("diffuseColor" if lit else "emissiveColor", types.Color3f)
    if isinstance(color, UsdShade.Output):
        shown.ConnectToSource(color)
    else:
        shown.Set(color)
    if not lit:
        surface.CreateInput("diffuseColor", types.Color3f).Set((0, 0, 0))
    if opacity is not None:  # renderers sort or trace through a surface with an opacity, whatever it is
        surface.CreateInput("opacity", types.Float).ConnectToSource(opacity)
    if normal is not None:
        surface.CreateInput("normal", types.Normal3f).ConnectToSource(normal)
    surface.CreateInput("roughness", types.Float).Set(1.0)
    # The specular workflow with black has no reflections, which an emissive surface should not show.
    surface.CreateInput("useSpecularWorkflow", types.Int).Set(0 if lit else 1)
    if not lit:
        surface.CreateInput("specularColor", types.Color3f).Set((0, 0, 0))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    return material


def primvar_reader(stage: Any, at: str, primvar: str, kind: Any, fallback: Any) -> Any:
    """The output of a shader at the path ``at`` that reads a primvar of the type ``kind``: float3, float."""
    from pxr import Sdf, UsdShade

    shader = UsdShade.Shader.Define(stage, at)
    shader.CreateIdAttr(f"UsdPrimvarReader_{kind}")
    shader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(primvar)
    shader.CreateInput("fallback", kind).Set(fallback)
    return shader.CreateOutput("result", kind)


def normal_reader(stage: Any, at: str, file: str) -> Any:
    """The output of a shader below the path ``at`` that reads a normal map by the primvar ``st``."""
    from pxr import Sdf

    types = Sdf.ValueTypeNames
    texture = texture_reader(stage, at, file, ("clamp", "clamp"), name="Normals", space="raw")
    # From 0 to 1 to -1 to 1, as the specification asks for 8 bits.
    texture.CreateInput("scale", types.Float4).Set((2, 2, 2, 1))
    texture.CreateInput("bias", types.Float4).Set((-1, -1, -1, 0))
    return texture.CreateOutput("rgb", types.Float3)


def texture_reader(
    stage: Any, at: str, file: str, wrap: tuple[str, str], *, name: str = "Texture", space: str = "sRGB"
) -> Any:
    """A shader of this ``name`` below the path ``at`` that reads an image by the primvar ``st``; ``space`` is
    that of its colours, sRGB or raw."""
    from pxr import Sdf, UsdShade

    types = Sdf.ValueTypeNames
    coordinates = UsdShade.Shader.Define(stage, f"{at}/Coordinates")
    coordinates.CreateIdAttr("UsdPrimvarReader_float2")
    coordinates.CreateInput("varname", types.String).Set("st")
    texture = UsdShade.Shader.Define(stage, f"{at}/{name}")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(file))
    texture.CreateInput("sourceColorSpace", types.Token).Set(space)
    for axis, mode in zip("ST", wrap, strict=True):
        texture.CreateInput(f"wrap{axis}", types.Token).Set(mode)
    texture.CreateInput("st", types.Float2).ConnectToSource(coordinates.CreateOutput("result", types.Float2))
    return texture
