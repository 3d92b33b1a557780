"""A new stage of USD, as this project writes them."""

from __future__ import annotations

from typing import Any


def new_stage(name: str = "/Splats") -> tuple[Any, Any]:
    """A stage in memory, with +y up and in metres, and its root, an Xform of this ``name``. Needs
    usd-core."""
    from pxr import Kind, Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, name)
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root.GetPrim()).SetKind(Kind.Tokens.component)
    return stage, root
