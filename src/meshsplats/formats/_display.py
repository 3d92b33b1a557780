"""Splats with linear colours, as display colours, and back."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from meshsplats.errors import DataWarning
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.scene.gaussians import SH_C0, GaussianCloud, constant_harmonics
from meshsplats.scene.spherical_harmonics import sh_basis, spiral

_DIRECTIONS = 128
_AT_ONCE = 1 << 14


def display_cloud(cloud: GaussianCloud) -> GaussianCloud:
    """``cloud``, whose colours are linear, with display colours.

    Concretely, the colour of a splat of degree 0 is encoded. Of others it is encoded in directions all over
    the sphere, and harmonics of the same degree are fitted to that. Images blend display colours, as those of
    all splats here, where the program that made them blends linear ones: they agree where splats are opaque.
    """
    return _mapped(cloud, linear_to_srgb)


def linear_cloud(cloud: GaussianCloud) -> GaussianCloud:
    """``cloud`` with linear colours, for renderers that want them: the inverse of ``display_cloud``, but for
    the fit."""
    return _mapped(cloud, srgb_to_linear)


def _mapped(cloud: GaussianCloud, curve: Callable[[np.ndarray], np.ndarray]) -> GaussianCloud:
    sh = cloud.sh
    if cloud.sh_degree == 0:
        colors = np.maximum(np.float32(0.5) + np.float32(SH_C0) * sh, 0)
        return replace(cloud, sh=constant_harmonics(curve(colors)))
    basis = sh_basis(spiral(_DIRECTIONS), cloud.sh_degree)
    fit = np.linalg.pinv(basis).astype(np.float32)
    basis = basis.astype(np.float32)
    fitted = np.empty_like(sh)
    for start in range(0, len(sh), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        colors = np.maximum(np.float32(0.5) + basis @ sh[part], 0)
        fitted[part] = fit @ (curve(colors) - np.float32(0.5))
    return replace(cloud, sh=fitted)


def say_converted(where: object) -> None:
    """Tells that colours were converted."""
    warnings.warn(
        f"{where}: its colours are linear by its header; they are read as display colours, and where splats"
        " are translucent, images differ somewhat from those of the program that made them",
        DataWarning,
        stacklevel=4,
    )
