"""Real spherical harmonics of degree 0 to 3, in the order and with the signs that splat files use."""

from __future__ import annotations

from typing import Any

import numpy as np

ODD_AXES = ("", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
"""Axes with whose sign each harmonic, a polynomial of degree up to 3, changes its own."""

TERMS = (3, 8, 15)
"""Counts of harmonics of degree 1, 2 and 3, without the constant one."""


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
    directions = spiral(64)
    before = sh_basis(directions @ orthogonal, degree)[:, 1:]
    matrix = np.linalg.lstsq(sh_basis(directions, degree)[:, 1:], before, rcond=None)[0]
    matrix[np.abs(matrix) < 1e-12] = 0
    return matrix.astype(np.float32)


def degree_of(harmonics: Any) -> int:
    """Degree, 1 to 3, of (s, k, 3) ``harmonics`` without the constant one; k as in ``TERMS``."""
    return TERMS.index(harmonics.shape[1]) + 1


def in_fours(harmonics: np.ndarray) -> np.ndarray:
    """(3, m, s, 4) float32 red, green and blue of ``harmonics`` (s, k, 3), four coefficients at a time; the
    last ones are padded with zeros."""
    count, terms, _ = harmonics.shape
    fours = np.zeros((3, -(-terms // 4), count, 4), np.float32)
    for k in range(terms):
        fours[:, k // 4, :, k % 4] = harmonics[:, k].T
    return fours


def harmonic_terms(index: int) -> tuple[tuple[float, tuple[int, int, int]], ...]:
    """The harmonic of ``index``, 1 to 15, as a polynomial of a unit direction: factors, and the powers of x,
    y and z that each belongs to."""
    over, under, terms = _POLYNOMIALS[index - 1]
    return tuple((factor * _norm(over, under), powers) for factor, powers in terms)


def turned_harmonics(harmonics: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """(s, k, 3) float32 ``harmonics`` (s, k, 3) of degree 1 and more, k = 3, 8 or 15, each turned by its
    rotation, of (s, 3, 3): seen along ``rotation @ d``, a splat then looks as it did along d."""
    degree = degree_of(harmonics)
    basis = sh_basis(_DIRECTIONS, degree)[:, 1:]
    # As in harmonics_map, but from the values of each splat.
    fit = np.linalg.pinv(basis)
    turned = np.empty_like(harmonics, np.float32)
    for start in range(0, len(harmonics), 1 << 13):
        part = slice(start, start + (1 << 13))
        before = (_DIRECTIONS @ rotations[part]).reshape(-1, 3)
        values = sh_basis(before, degree)[:, 1:].reshape(-1, *basis.shape) @ harmonics[part]
        turned[part] = fit @ values
    return turned


def moved_harmonics(harmonics: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """(s, k, 3) float32 ``harmonics`` (s, k, 3) of degree 1 and more, all turned as points x move to ``matrix
    @ x``: by the rotation or mirror that is nearest to (3, 3) ``matrix``."""
    u, _, v = np.linalg.svd(matrix)
    turn = harmonics_map(u @ v, degree_of(harmonics))
    return np.ascontiguousarray(turn @ harmonics, np.float32)


def spiral(count: int) -> np.ndarray:
    """(count, 3) unit directions on a Fibonacci spiral."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, i * np.pi * (1 + 5**0.5)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


_DIRECTIONS = spiral(32)


def _norm(over: int, under: int) -> float:
    """sqrt(over / (under pi)), the constant in front of a polynomial."""
    return float(np.sqrt(over / (under * np.pi)))


_X, _Y, _Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
_POLYNOMIALS: tuple[tuple[int, int, tuple[tuple[float, tuple[int, int, int]], ...]], ...] = (
    (3, 4, ((-1, _Y),)),
    (3, 4, ((1, _Z),)),
    (3, 4, ((-1, _X),)),
    (15, 4, ((1, (1, 1, 0)),)),
    (15, 4, ((-1, (0, 1, 1)),)),
    (5, 16, ((2, (0, 0, 2)), (-1, (2, 0, 0)), (-1, (0, 2, 0)))),
    (15, 4, ((-1, (1, 0, 1)),)),
    (15, 16, ((1, (2, 0, 0)), (-1, (0, 2, 0)))),
    (35, 32, ((-3, (2, 1, 0)), (1, (0, 3, 0)))),
    (105, 4, ((1, (1, 1, 1)),)),
    (21, 32, ((-4, (0, 1, 2)), (1, (2, 1, 0)), (1, (0, 3, 0)))),
    (7, 16, ((2, (0, 0, 3)), (-3, (2, 0, 1)), (-3, (0, 2, 1)))),
    (21, 32, ((-4, (1, 0, 2)), (1, (3, 0, 0)), (1, (1, 2, 0)))),
    (105, 16, ((1, (2, 0, 1)), (-1, (0, 2, 1)))),
    (35, 32, ((-1, (3, 0, 0)), (3, (1, 2, 0)))),
)
"""Of harmonics 1 to 15: n and m of the factor sqrt(n / (m pi)), then factors with powers of x, y and z."""
