"""Affine transforms of splats, for the nodes of scenes and for files with other axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshsplats._geometry import quaternions_of
from meshsplats.gaussians import GaussianCloud
from meshsplats.spherical_harmonics import sh_basis

HALF_TURN_X = np.diag([1.0, -1.0, -1.0])
"""Half turn about x: from y up to y down and back; reverses z, too."""
HALF_TURN_Z = np.diag([-1.0, -1.0, 1.0])
"""Half turn about z: from y up to y down and back; reverses x, too."""

# Spherical harmonics 1 to 15 are polynomials whose terms all change sign with the axes named here.
_ODD = ["y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x"]


def transformed(cloud: GaussianCloud, matrix: np.ndarray, origin: np.ndarray | None = None) -> GaussianCloud:
    """``cloud`` after the affine map ``matrix``, (3, 3) or (4, 4), from the file's frame to the world's.

    Concretely, a splat of covariance C and mean m in the world gets covariance A C A^T and mean A m + t. Its
    colour seen from direction d becomes its earlier colour seen from U^T d, where U is the orthogonal factor
    of A, and ``up`` turns by U. Mirrors are allowed.

    Args:
        cloud: the splats.
        matrix: the map.
        origin: (3,) float64, of the result; None: A times that of the cloud, so that ``means`` become A
            times them plus t.

    Raises:
        ValueError: the matrix is not finite or is singular.
    """
    matrix = np.asarray(matrix, np.float64)
    a, shift = matrix[:3, :3], matrix[:3, 3:].reshape(-1)
    reverses_axes = (np.abs(a) == np.eye(3)).all()
    moved = _mirrored(cloud, np.diag(a)) if reverses_axes else _mapped(cloud, a)
    mapped = a @ cloud.origin + 0.0
    if origin is not None:
        away = mapped - origin
        away[: len(shift)] += shift
        means = (cloud.means.astype(np.float64) @ a.T + away).astype(np.float32)
        return replace(moved, means=means, origin=origin)
    if shift.any():
        moved = replace(moved, means=moved.means + shift.astype(np.float32))
    return moved if (mapped == moved.origin).all() else replace(moved, origin=mapped)


def _mirrored(cloud: GaussianCloud, signs: np.ndarray) -> GaussianCloud:
    """Reverses axes: only signs change, nothing is rounded."""
    if (signs > 0).all():
        return cloud
    sign = dict(zip("xyz", signs, strict=True))
    # M R M is a rotation again, with quaternion (w, yz x, xz y, xy z); the splat's own axes may change sign
    # freely.
    turn = [1, sign["y"] * sign["z"], sign["x"] * sign["z"], sign["x"] * sign["y"]]
    harmonics = np.ones((cloud.sh.shape[1], 1), np.float32)
    for i in range(1, len(harmonics)):
        harmonics[i] = np.prod([sign[axis] for axis in _ODD[i - 1]])
    return replace(
        cloud,
        means=cloud.means * signs.astype(np.float32),
        quaternions=cloud.quaternions * np.array(turn, np.float32),
        sh=cloud.sh * harmonics,
        up=None if cloud.up is None else cloud.up * signs.astype(np.float32),
    )


def _mapped(cloud: GaussianCloud, a: np.ndarray) -> GaussianCloud:
    if not np.isfinite(a).all():
        raise ValueError("the transform is not finite")
    u, stretch, vt = np.linalg.svd(a)
    if stretch[2] <= 1e-12 * stretch[0]:
        raise ValueError("the transform flattens space (a singular matrix)")
    orthogonal = u @ vt
    proper = orthogonal * np.sign(np.linalg.det(orthogonal))  # a Gaussian is symmetric: x and -x are the same
    if stretch[0] <= stretch[2] * (1 + 1e-6):
        quaternions = _product(quaternions_of(proper[None])[0], cloud.quaternions.astype(np.float64))
        scales = cloud.scales * np.float32(stretch.mean())
    else:
        # A R S = U D V^T: the new axes are the columns of U, the new scales D, largest first.
        axes, scales, _ = np.linalg.svd(a @ (cloud.rotations.astype(np.float64) * cloud.scales[:, None]))
        axes[:, :, 2] *= np.linalg.det(axes)[:, None]
        quaternions = quaternions_of(axes)
    sh = cloud.sh
    if sh.shape[1] > 1:
        sh = np.concatenate([sh[:, :1], harmonics_map(orthogonal, cloud.sh_degree) @ sh[:, 1:]], axis=1)
    means = cloud.means.astype(np.float64) @ a.T
    up = None if cloud.up is None else orthogonal @ cloud.up
    return replace(cloud, means=means, quaternions=quaternions, scales=scales, sh=sh, up=up)


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


def _product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(n, 4) Hamilton products of the quaternion ``p`` with each of ``q``; w, x, y, z."""
    a, b, c, d = p
    left = np.array([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]])
    return q @ left.T
