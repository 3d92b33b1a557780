"""Real spherical harmonics of degree 0 to 3, in the order and with the signs that splat files use."""

from __future__ import annotations

import numpy as np

ODD_AXES = ("", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
"""Axes with whose sign each harmonic, a polynomial of degree up to 3, changes its own."""


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """(n, (degree + 1)^2) values at unit ``directions`` (n, 3), camera to splat, in the input's float type.

    Concretely, a splat seen along d has the display colour ``max(0, 0.5 + sh_basis(d, degree) @ sh)``. Within
    a degree l the order is m = -l ... l and the sign that of the 3DGS trainer: the first three after the
    constant are proportional to -y, z, -x. Normalised so that the integral of each square over the sphere is
    1.

    Raises ValueError unless ``degree`` is 0, 1, 2 or 3.
    """
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"degree must be 0, 1, 2 or 3, got {degree}")
    directions = np.asarray(directions)
    # Each coefficient's values lie together in memory, as they are written.
    values = np.empty(((degree + 1) ** 2, len(directions)), np.result_type(directions, np.float32)).T
    values[:, 0] = _norm(1, 4)
    if degree == 0:
        return values
    x, y, z = directions.T
    first = _norm(3, 4)
    values[:, 1] = -first * y
    values[:, 2] = first * z
    values[:, 3] = -first * x
    if degree == 1:
        return values
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    values[:, 4] = _norm(15, 4) * xy
    values[:, 5] = -_norm(15, 4) * yz
    values[:, 6] = _norm(5, 16) * (2 * zz - xx - yy)
    values[:, 7] = -_norm(15, 4) * xz
    values[:, 8] = _norm(15, 16) * (xx - yy)
    if degree == 2:
        return values
    values[:, 9] = -_norm(35, 32) * y * (3 * xx - yy)
    values[:, 10] = _norm(105, 4) * xy * z
    values[:, 11] = -_norm(21, 32) * y * (4 * zz - xx - yy)
    values[:, 12] = _norm(7, 16) * z * (2 * zz - 3 * xx - 3 * yy)
    values[:, 13] = -_norm(21, 32) * x * (4 * zz - xx - yy)
    values[:, 14] = _norm(105, 16) * z * (xx - yy)
    values[:, 15] = -_norm(35, 32) * x * (xx - 3 * yy)
    return values


def harmonics_map(orthogonal: np.ndarray, degree: int) -> np.ndarray:
    """(k - 1, k - 1) float32 map of the coefficients 1 to k - 1 under the rotation or mirror ``orthogonal``.

    The functions of a degree span a space that rotations map to itself, so a least-squares fit to values in a
    few directions is exact.
    """
    i = np.arange(64) + 0.5  # directions on a Fibonacci spiral
    z, angle = 1 - i / 32, i * np.pi * (1 + 5**0.5)
    r = np.sqrt(1 - z * z)
    directions = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    before = sh_basis(directions @ orthogonal, degree)[:, 1:]
    matrix = np.linalg.lstsq(sh_basis(directions, degree)[:, 1:], before, rcond=None)[0]
    matrix[np.abs(matrix) < 1e-12] = 0
    return matrix.astype(np.float32)


def _norm(over: int, under: int) -> float:
    """sqrt(over / (under pi)), the constant in front of a polynomial."""
    return float(np.sqrt(over / (under * np.pi)))
