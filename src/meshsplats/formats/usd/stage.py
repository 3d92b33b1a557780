"""A new stage of USD, as this project writes them."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshsplats.formats._orientation import turned_origin, up_quaternion
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.mesh import SplatMesh


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


def placed_mesh(
    mesh: SplatMesh | BaseMesh, name: str = "Mesh", *, double_sided: bool = True
) -> tuple[Any, Any]:
    """A stage whose root puts ``mesh`` in its place, and the Mesh of this ``name`` below it, without colours.
    Needs usd-core."""
    from pxr import Gf, UsdGeom, Vt

    stage, root = new_stage()
    x, y, z, w = up_quaternion(mesh.up)
    if mesh.origin.any():
        root.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*turned_origin(mesh).tolist()))
    root.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
    shape = UsdGeom.Mesh.Define(stage, f"/Splats/{name}")
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(mesh.vertices))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.reshape(-1)))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    if double_sided:
        shape.CreateDoubleSidedAttr(True)
    if len(mesh.vertices):
        corners = np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])
        shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners))
    return stage, shape


def make_collider(shape: Any, *, drawn: bool) -> None:
    """Makes a UsdGeom.Mesh a static collider of its triangles; unless ``drawn``, renderers leave it out."""
    from pxr import UsdGeom, UsdPhysics

    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
    UsdPhysics.MeshCollisionAPI.Apply(shape.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.none)
    if not drawn:
        shape.CreatePurposeAttr(UsdGeom.Tokens.guide)
