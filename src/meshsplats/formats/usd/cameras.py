"""Cameras of USD files with meshes: those of our surfaces of places, and those of other programs.

Schema: https://openusd.org/release/api/class_usd_geom_camera.html.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats._file_cameras import near_plane, placed_camera
from meshsplats.formats.content import Content
from meshsplats.formats.usd.crate import holds_token, is_crate
from meshsplats.formats.usd.reader import extracted
from meshsplats.scene.camera import Camera, to_opengl

_PRIM = b"Camera"
_APERTURE = 0.36
"""Width of the film in tenths of a unit of the stage, which is a metre: 36 mm."""
_FAR = 10.0
"""Far plane, in extents of the scene."""


def add_cameras(stage: Any, cameras: Sequence[Camera], points: np.ndarray) -> None:
    """Adds ``cameras`` to a ``stage`` of ours (``stage.placed_mesh``), in the frame of its mesh, whose
    vertices are ``points`` (n, 3)."""
    from pxr import Gf, UsdGeom

    for number, camera in enumerate(cameras):
        own = UsdGeom.Camera.Define(stage, f"/Splats/View{number + 1}")
        own.AddTransformOp(UsdGeom.XformOp.PrecisionDouble).Set(
            Gf.Matrix4d(to_opengl(camera.world_to_camera).T.tolist())  # for row vectors
        )
        own.CreateHorizontalApertureAttr(_APERTURE)
        own.CreateVerticalApertureAttr(_APERTURE * camera.height * camera.fx / (camera.width * camera.fy))
        own.CreateFocalLengthAttr(_APERTURE * camera.fx / camera.width)
        near = near_plane(camera, points)
        own.CreateClippingRangeAttr(Gf.Vec2f(near, max(_FAR * float(np.ptp(points, axis=0).max()), 2 * near)))
        own.GetPrim().SetDisplayName(camera.name or f"view {number + 1}")


def cameras_in_usd(path: Path) -> list[Camera]:
    """The perspective cameras of a USD file, but for hidden ones, in the world of ``load_mesh``, in the order
    of the stage.

    Raises FileFormatError for a broken file, MissingDependencyError without usd-core.
    """
    with Content(path) as content, content.open_usd() as file:
        if is_crate(file) and not holds_token(file, _PRIM):
            return []  # without a process for the library, as with most meshes
    report, _ = extracted(path, "meshsplats.formats.usd.camera_extraction")
    found = []
    for angle, shape, matrix, name in report["cameras"]:
        try:
            found.append(placed_camera(np.array(matrix), angle, shape, name))
        except ValueError as error:
            raise FileFormatError(f"{path}: {error}") from None
    return found
