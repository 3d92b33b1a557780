"""Colours of Deformable Beta Splatting (Liu and others 2025, arXiv 2501.18630) as spherical harmonics.

A splat has lobes, each with a colour c, a direction u by the angles theta and phi, and an exponent p = 4
exp(beta); seen along the unit vector d it has the colour of its constant and sum_l c_l max(0, u_l . d)^p_l.
The columns ``sb_params_*`` hold the numbers of all lobes one after the other: red of each, then green, blue,
theta, phi, beta. Colours are stored before softplus(x) = ln(1 + 2^(10 x)) / (10 ln 2).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.scene.spherical_harmonics import sh_basis

PREFIX = "sb_params_"
DEGREE = 3
"""Of the harmonics. They have 97 % of the energy of a lobe with beta = 0, 75 % with 1, 41 % with 2."""
_NUMBERS = 6
_SHARPNESS = 10 * np.log(2.0)


def lobe_columns(names: Sequence[str], where: object) -> tuple[str, ...]:
    """The columns of lobes, in their order; FileFormatError where they are not those of whole lobes."""
    ends = (name.removeprefix(PREFIX) for name in names if name.startswith(PREFIX) and name.isascii())
    found = sorted(int(end) for end in ends if end.isdecimal())
    if len(found) % _NUMBERS or found != list(range(len(found))):
        raise FileFormatError(
            f"{where}: found {len(found)} {PREFIX}* properties{f' up to {found[-1]}' if found else ''}; Beta"
            f" splats have {_NUMBERS} for each lobe of their colour, from {PREFIX}0 on"
        )
    return tuple(f"{PREFIX}{i}" for i in found)


def add_lobes(sh: np.ndarray, stored: np.ndarray) -> None:
    """Adds lobes to harmonics ``sh`` (n, 16, 3): for each the nearest function of degree 3, by least squares
    over the sphere. ``stored``: (n, 6 k) float32 columns of a file.

    A lobe is a function of the angle from its direction, so that its coefficients are those of the harmonics
    in that direction, times 2 pi times the integral of t^p P_l(t) from 0 to 1 (Funk and Hecke), with the
    Legendre polynomials P_l.
    """
    red, green, blue, theta, phi, beta = np.moveaxis(
        stored.astype(np.float64).reshape(len(stored), _NUMBERS, -1), 1, 0
    )
    for lobe in range(red.shape[1]):
        t, f = theta[:, lobe], phi[:, lobe]
        direction = np.stack([np.sin(t) * np.cos(f), np.sin(t) * np.sin(f), np.cos(t)], axis=1)
        with np.errstate(over="ignore"):
            power = 4 * np.exp(beta[:, lobe])
        first, second, third, fourth = (1 / (power + k) for k in (1, 2, 3, 4))
        zonal = [first, second, (3 * third - first) / 2, (5 * fourth - 3 * second) / 2]
        by_degree = 2 * np.pi * np.stack(zonal, axis=1)[:, [0, 1, 1, 1, *5 * [2], *7 * [3]]]
        color = np.stack([red[:, lobe], green[:, lobe], blue[:, lobe]], axis=1)
        color = np.logaddexp(0, _SHARPNESS * color) / _SHARPNESS
        sh += ((by_degree * sh_basis(direction, DEGREE))[:, :, None] * color[:, None]).astype(np.float32)


def warn_of_beta(names: Sequence[str], where: object) -> None:
    """A DataWarning for columns that are not read as they were trained."""
    told = {
        "colours of lobes (sb_params_*) become harmonics of degree 3, which are smoother": any(
            name.startswith(PREFIX) for name in names
        ),
        "kernels other than Gaussians (beta) are left out, images are those of Gaussians": "beta" in names,
    }
    if changed := [what for what, there in told.items() if there]:
        warnings.warn(f"{where}: Beta splats: {'; '.join(changed)}", DataWarning, stacklevel=4)
