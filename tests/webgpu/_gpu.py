"""Comparisons of the GPU with the core, and the reason why there is none."""

from __future__ import annotations

import functools

import numpy as np
from _needs import lacking
from _rendering import outputs

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
    """Skips, or fails where one is required, without a GPU or a software driver."""
    reason = missing()
    if reason:
        lacking("gpu", reason)


def psnr(one: np.ndarray, two: np.ndarray) -> float:
    """dB, of values in [0, 1]."""
    error = float(np.mean((one.astype(np.float64) - two) ** 2))
    return np.inf if error == 0 else -10 * np.log10(error)


def both(mesh: SplatMesh, view: Camera, **options) -> tuple[Rendering, Rendering]:
    """The images by GPU and core."""
    return render(mesh, view, device="gpu", **options), render(mesh, view, **options)


def assert_same_image(gpu: Rendering, core: Rendering, *, least: float = 105, most: float = 0) -> None:
    """All outputs within ``least`` dB of each other, relative to their largest value if above 1. At most the
    share ``most`` of the pixels is off by more than 1e-3."""
    found, expected = outputs(gpu), outputs(core)
    assert found.keys() == expected.keys()
    for name, value in found.items():
        assert value.shape == expected[name].shape
        assert value.dtype == np.float32
        scale = max(1.0, float(np.abs(expected[name]).max(initial=0)))
        error = np.abs(value - expected[name]).reshape(*value.shape[:2], -1).max(axis=2) / scale
        assert psnr(value / scale, expected[name] / scale) >= least, name
        assert (error > 1e-3).sum() <= most * error.size, (name, error.max())
    samples = gpu.alpha.size
    assert abs(gpu.fragments - core.fragments) <= max(2, 1e-4 * core.fragments, most * samples)
