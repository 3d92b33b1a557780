"""Comparisons of the GPU with the core, and the reason why there is none."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from meshsplats import Camera, SplatMesh, render
from meshsplats.errors import DeviceError, MissingDependencyError
from meshsplats.rendering.api import Rendering


@functools.lru_cache(maxsize=1)
def missing() -> str | None:
    """Why no GPU can be used here, or None."""
    from meshsplats.webgpu.device import open_device

    try:
        open_device()
    except (MissingDependencyError, DeviceError) as error:
        return str(error)
    return None


def need_gpu() -> None:
    """Skips without a GPU or a software driver."""
    reason = missing()
    if reason:
        pytest.skip(reason)


def psnr(one: np.ndarray, two: np.ndarray) -> float:
    """dB, of values in [0, 1]."""
    error = float(np.mean((one.astype(np.float64) - two) ** 2))
    return np.inf if error == 0 else -10 * np.log10(error)


def both(mesh: SplatMesh, view: Camera, **options) -> tuple[Rendering, Rendering]:
    """The images by GPU and core."""
    return render(mesh, view, device="gpu", **options), render(mesh, view, **options)
