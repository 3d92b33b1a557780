"""Writes splats as Universal Scene Description: ParticleField3DGaussianSplat, core since OpenUSD 26.03.

Needs the optional package usd-core, of any version: the prim and its attributes are written by name. Under an
Xform that turns the cloud's ``up`` to the stage's +y and moves it to its ``origin``, arrays are float and
activated, with x right, y up and z back, as meshes by ``writer`` are. Hints: splats are sorted by depth, as
3DGS sorts them. All else is in the prim's custom data. Schema:
https://openusd.org/release/user_guides/schemas/usdVol/ParticleField3DGaussianSplat.html

Without a mark, colours in USD are linear. Splats are trained on display values, and are written as they are,
with the mark of ColorSpaceAPI that says so; or, as ``linear``, converted for renderers that ignore it.
"""

from __future__ import annotations

import struct
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.geometry import rotation_rows
from meshsplats.errors import MissingDependencyError
from meshsplats.formats._display import linear_cloud
from meshsplats.formats._orientation import HALF_TURN_X, up_quaternion
from meshsplats.formats.usd.stage import new_stage
from meshsplats.formats.writing import FormatWriter, Writing
from meshsplats.scene.gaussians import GaussianCloud

PRIM = "ParticleField3DGaussianSplat"
DISPLAY, LINEAR = "srgb_rec709_scene", "lin_rec709_scene"
"""Names of colour spaces."""
_NO_DATE = struct.pack("<2H", 0, 1 << 5 | 1)
"""Time and date of 1980-01-01 in a zip archive."""
_SH = "radiance:sphericalHarmonics"
_EXTENT = 3.0
"""Standard deviations that a splat is taken to reach."""


def write_usd_splats(cloud: GaussianCloud, path: Path, writing: Writing) -> None:
    """Writes ``cloud``; see ``save_gaussians``. MissingDependencyError without usd-core."""
    try:
        import pxr  # noqa: F401
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"{writing.where}: writing USD needs the extra 'usd': pip install usd-core"
        ) from error
    stage = splats_stage(linear_cloud(cloud) if writing.linear else cloud, linear=bool(writing.linear))
    if writing.where.suffix.lower() != ".usdz":
        export(stage, path)
        return
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".meshsplats-") as folder:
        inner = Path(folder) / "splats.usdc"
        export(stage, inner)
        packed(inner, path)


def packed(layer: Path, path: Path) -> None:
    """Writes a .usdz package of a ``layer`` and what it refers to, without dates: the same scene makes the
    same bytes."""
    from pxr import UsdUtils

    if not UsdUtils.CreateNewUsdzPackage(str(layer), str(path)):
        raise OSError(f"usd-core could not write {path}")
    with open(path, "r+b") as file:
        with zipfile.ZipFile(file) as package:
            entries, central = package.infolist(), package.start_dir
        for entry in entries:
            file.seek(central + 28)
            lengths = struct.unpack("<3H", file.read(6))  # of the name, of more fields, and of a comment
            for at in (entry.header_offset + 10, central + 12):
                file.seek(at)
                file.write(_NO_DATE)
            central += 46 + sum(lengths)


def export(stage: Any, path: Path) -> None:
    """Writes a stage to the file ``path``."""
    if not stage.GetRootLayer().Export(str(path)):
        raise OSError(f"usd-core could not write {path}")


def splats_stage(cloud: GaussianCloud, *, linear: bool) -> Any:
    """A stage of ``cloud``; ``linear``: its colours are. Needs usd-core."""
    from pxr import Gf, Sdf, UsdGeom, Vt

    stage, root = new_stage()
    x, y, z, w = turn_of(cloud.up)
    if cloud.origin.any():
        place = np.array(list(rotation_rows(w, x, y, z))) @ HALF_TURN_X @ cloud.origin + 0.0
        root.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*place.tolist()))
    if w != 1:
        root.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
    prim = stage.DefinePrim("/Splats/Field", PRIM)
    turned = cloud.transformed(HALF_TURN_X)
    # Bytes of quatf in memory: the real part last.
    rotations = np.ascontiguousarray(turned.quaternions[:, [1, 2, 3, 0]])
    reach = _EXTENT * turned.scales.max(axis=1, keepdims=True)
    corners = np.stack([(turned.means - reach).min(axis=0), (turned.means + reach).max(axis=0)])
    types = Sdf.ValueTypeNames
    token, uniform = types.Token, Sdf.VariabilityUniform
    for name, kind, value in (
        ("positions", types.Point3fArray, Vt.Vec3fArray.FromNumpy(turned.means)),
        ("orientations", types.QuatfArray, Vt.QuatfArray.FromNumpy(rotations)),
        ("scales", types.Float3Array, Vt.Vec3fArray.FromNumpy(turned.scales)),
        ("opacities", types.FloatArray, Vt.FloatArray.FromNumpy(turned.opacities)),
        (f"{_SH}Coefficients", types.Float3Array, Vt.Vec3fArray.FromNumpy(turned.sh.reshape(-1, 3))),
        ("extent", types.Float3Array, Vt.Vec3fArray.FromNumpy(corners.astype(np.float32))),
    ):
        prim.CreateAttribute(name, kind, custom=False).Set(value)
    for name, kind, word in (
        (f"{_SH}Degree", types.Int, turned.sh_degree),
        ("projectionModeHint", token, "perspective"),
        ("sortingModeHint", token, "zDepth"),
        ("colorSpace:name", token, LINEAR if linear else DISPLAY),
    ):
        prim.CreateAttribute(name, kind, custom=False, variability=uniform).Set(word)
    prim.SetMetadata("apiSchemas", Sdf.TokenListOp.Create(prependedItems=["ColorSpaceAPI"]))
    prim.SetCustomData({"meshsplats": _note(cloud)})
    return stage


def _note(cloud: GaussianCloud) -> dict[str, Any]:
    from pxr import Gf

    note: dict[str, Any] = {"version": 1, "kernel": cloud.kernel}
    if cloud.up is not None:
        note["up"] = Gf.Vec3d(*(float(u) for u in cloud.up))
    if cloud.origin.any():
        note["origin"] = Gf.Vec3d(*cloud.origin.tolist())
    return note


def turn_of(up: np.ndarray | None) -> list[float]:
    """Unit quaternion x, y, z, w of the Xform of our own files, for a cloud with this ``up``."""
    return up_quaternion(HALF_TURN_X @ (np.array([0.0, -1.0, 0.0]) if up is None else up))


def _bytes_a_splat(coefficients: int) -> float:
    return 44 + 12 * coefficients


WRITER = FormatWriter(write_usd_splats, _bytes_a_splat, ("linear",))
