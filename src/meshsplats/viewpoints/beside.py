"""Training cameras that belong to a file: in a record beside it, or in its model folder."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.cameras.files import load_cameras, model_folder
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats.outputs import CAMERAS, beside
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

_OLDER = 60.0
"""Seconds by which a record of cameras may be older than its file: copies are made in any order."""
_POINTS = 10_000
"""Points of a scene, at most, that cameras are asked for."""


def cameras_beside(source: Path, origin: Sequence[float] | np.ndarray = (0, 0, 0)) -> list[Camera] | None:
    """The training cameras of ``source``, relative to the point ``origin`` (3,) of the world: those in the
    record ``NAME.cameras.json`` beside the file NAME, as ``train`` writes it, else those of its
    ``model_folder``. None where there are none.

    A DataWarning says where they cannot be read, and where a record is older than the file: it may be of
    another.
    """
    record, stored = record_of(source), stored_cameras(source)
    if stored is None:
        return None
    try:
        if record is None or os.stat(record).st_mtime >= os.stat(source).st_mtime - _OLDER:
            return load_cameras(stored, origin=origin)
        said = f"{record} is older than {source.name} and may be of another: save it anew, or delete it"
    except (FileFormatError, OSError) as error:
        said = str(error)
    whose = "of the model folder" if record is None else "beside the file"
    warnings.warn(f"{said}; the cameras {whose} are not used", DataWarning, stacklevel=2)
    return None


def stored_cameras(source: Path) -> Path | None:
    """Where ``cameras_beside`` reads: the record, else the model folder of ``source``; None: nowhere."""
    return record_of(source) or model_folder(source)


def record_of(source: Path) -> Path | None:
    """The record of cameras beside the file ``source``; None if there is none."""
    if not source.is_file():
        return None
    record = beside(source, CAMERAS)
    return record if os.path.isfile(record) else None  # which bears names that are too long


def that_see(
    cameras: Sequence[Camera] | None, scene: GaussianCloud | SplatMesh | BaseMesh
) -> list[Camera] | None:
    """Those of the ``cameras`` beside the file of ``scene`` that see some of it; None: there are none. A
    DataWarning says that none does."""
    if not cameras:
        return None
    points = subsample(scene.means if isinstance(scene, GaussianCloud) else scene.vertices, _POINTS)
    with np.errstate(all="ignore"):  # a camera may be anywhere
        seeing = [camera for camera in cameras if camera.sees(points).any()]
    if not seeing:
        warnings.warn(
            f"none of the {len(cameras)} cameras beside the file sees anything of it: they are not used",
            DataWarning,
            stacklevel=3,
        )
    return seeing or None
