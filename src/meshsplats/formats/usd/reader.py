"""Reads meshes from Universal Scene Description: our own files exactly, triangles and vertex colours from
other programs' files.

Needs the optional package usd-core. That library was not written for untrusted files: broken ones crash it.
So it runs in a process of its own (``extraction``), with limits on memory and time, and a crash becomes an
error.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.errors import (
    AnimationWarning,
    DataWarning,
    FileFormatError,
    MissingDependencyError,
    NoTextureWarning,
)
from meshsplats.formats._validation import Budget, checked, straight_colors
from meshsplats.formats.content import Content
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.scene.mesh import MAX_COLOR, SplatMesh
from meshsplats.scene.origin import relative

_SECONDS = 60
_BYTES_A_SECOND = 1 << 20
"""Reading is stopped after ``_SECONDS`` and a second for each of these; it takes a fiftieth of that."""


def read_usd(path: Path, origin: np.ndarray | None = None) -> SplatMesh:
    """The mesh in a `.usdc`, `.usda` or `.usd` file, or in the layer that a `.usdz` package is read by.

    Our own files give back positions and extra arrays exactly, and colours within 1e-6. From other programs'
    files, all visible meshes are joined, in metres (a DataWarning says where the stage has other units) and
    the frame of the stage, at the first time that has values (an AnimationWarning says where there are more),
    as skeletons and blend shapes move them; subdivision surfaces become their control cage. Colours are the
    plain ones of UsdPreviewSurface, or else displayColor (linear) and displayOpacity; textures are left out,
    with a NoTextureWarning (``usd_textures`` reads them). A DataWarning counts other shapes, which are left
    out, too. Positions are relative to ``origin``; by default to that of our files, or to one that suits
    those of others, whose transforms are applied in float64.

    Raises:
        MissingDependencyError: usd-core is missing.
        FileFormatError: the file is broken, or refers to other files, which are not opened.
    """
    report, arrays = extracted(path, "meshsplats.formats.usd.extraction", origin)
    if len(times := report["times"]) > 1:
        span = f"{len(times):,} time samples, {times[0]:g} to {times[-1]:g}"
        message = f"{path}: holds an animation ({span}), of which the first was read"
        warnings.warn(message, AnimationWarning, stacklevel=3)
    for message in report["warnings"]:
        warnings.warn(f"{path}: {message}", DataWarning, stacklevel=3)
    if report["textured"]:
        message = f"{path}: has textures, which were left out; colours may differ"
        warnings.warn(message, NoTextureWarning, stacklevel=3)
    colors = straight_colors(arrays.pop("linear"), path)
    if report["blending"] != "linear":
        colors[:, :3] = linear_to_srgb(colors[:, :3])
    if "colors" in arrays:
        if report["plain_colors"]:
            arrays["plain_colors"] = colors[:, :3].copy()
        rgba = np.concatenate([arrays.pop("colors"), colors[:, 3:]], axis=1)
        colors = straight_colors(rgba, path, MAX_COLOR)
    attributes = {name: arrays.pop(f"attribute_{i}") for i, name in enumerate(report["attributes"])}
    return checked(
        path,
        SplatMesh,
        vertices=arrays.pop("vertices"),
        faces=arrays.pop("faces"),
        colors=colors,
        up=report["up"],
        origin=report["origin"],
        blending=report["blending"],
        filter_px2=report.get("filter_px2", 0.0),
        order=report.get("order", "fragment"),
        attributes=attributes,
        **arrays,
    )


def usd_frames(path: Path, origin: np.ndarray) -> np.ndarray:
    """(t, v, 3) float32 vertices of ``read_usd``, relative to ``origin`` (3,), at each of the t times at
    which a skeleton, blend shapes, points or transforms have values. Errors as ``read_usd``, and
    FileFormatError for points that change in number."""
    report, arrays = extracted(path, "meshsplats.formats.usd.frame_extraction", origin)
    own = np.array(report["origin"])  # of files of ours
    return relative(arrays["frames"], own, origin).astype(np.float32, copy=False)


def extracted(
    path: Path, module: str, origin: np.ndarray | None = None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The report and the arrays of ``module``, run as a process of its own with a USD file, or the layer of a
    `.usdz` package. Errors as ``read_usd``."""
    if importlib.util.find_spec("pxr") is None:
        raise MissingDependencyError(f"{path}: reading USD needs the extra 'usd': pip install usd-core")
    budget = Budget(path)
    with tempfile.TemporaryDirectory(prefix="meshsplats-") as folder:
        result, file = Path(folder).absolute() / "arrays.npz", path.resolve()
        with Content(path) as content:
            if content.usd_layer is not None:
                file = result.with_name("packed.usd")
                with content.open_usd() as packed, open(file, "wb") as copy:
                    shutil.copyfileobj(packed, copy)
        report = _extract(module, file, path, result, origin)
        budget.spend(result.stat().st_size, "its arrays")
        with np.load(result, allow_pickle=False) as archive:
            return report, {name: archive[name] for name in archive.files}


def _extract(module: str, file: Path, path: Path, result: Path, origin: np.ndarray | None) -> dict[str, Any]:
    """Runs ``module``, which writes arrays to ``result``; returns the rest of its report."""
    size = file.stat().st_size
    command = [sys.executable, "-m", module, str(file), str(result)]
    command += [] if origin is None else [repr(float(x)) for x in origin]
    places = os.pathsep.join(os.path.abspath(place) for place in sys.path if place)
    try:
        done = subprocess.run(
            command,
            cwd=result.parent,  # an empty folder: python -m imports from the current folder first
            env={**os.environ, "PYTHONPATH": places, "TMPDIR": str(result.parent)},  # for reports of crashes
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_SECONDS + size / _BYTES_A_SECOND,
        )
    except subprocess.TimeoutExpired as expired:
        raise FileFormatError(
            f"{path}: the USD library was stopped after {expired.timeout:.0f} s with this file"
        ) from None
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or [f"status {done.returncode}"]
        reason = f"it crashed, signal {-done.returncode}" if done.returncode < 0 else lines[-1][-300:]
        raise FileFormatError(f"{path}: the USD library does not read this file: {reason}")
    report = json.loads(done.stdout)
    if "error" in report:
        raise FileFormatError(f"{path}: {report['error']}")
    return report
