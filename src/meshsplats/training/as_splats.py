"""Fans as splats: for each fan the flat Gaussian whose own fan would be the nearest."""

from __future__ import annotations

import numpy as np

from meshsplats._geometry import quaternions_of
from meshsplats.conversion.profiles import fit_profile
from meshsplats.gaussians import SH_C0, GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.training.growth import corners_of, fan_count

THICKNESS = 0.02
"""Standard deviation across a fan, as a share of the smaller one in it: viewers need one above 0."""


def splats_of_fans(mesh: SplatMesh) -> GaussianCloud:
    """Splats with the place, extent, colour and opacity of the fans of ``mesh``.

    A fan of s sides around a splat with covariance C has a rim with sum_j (r_j - c) (r_j - c)^T = s / 2 R^2
    C, where R is the radius of the rim in standard deviations; C is found from that of the rim. Positions and
    colours are means weighted by opacity, which falls linearly to the rim: half of the weight is the
    centre's. A fan has more freedom than an ellipse of one colour, so the splats look coarser than the mesh.

    Raises ValueError unless ``mesh`` is one of equal fans, centre first, as ``train`` makes them.
    """
    check_fans(mesh)
    corners, n = corners_of(mesh), fan_count(mesh)
    sides = corners - 1
    profile = fit_profile(sides, conserve=True)
    positions = mesh.vertices.reshape(n, corners, 3).astype(np.float64)
    colors = mesh.colors.reshape(n, corners, 4).astype(np.float64)
    center, rim = positions[:, 0], positions[:, 1:]
    middle = (center + rim.mean(axis=1)) / 2
    offset = rim - rim.mean(axis=1, keepdims=True)
    moments = np.einsum("nki,nkj->nij", offset, offset) * (2 / (sides * profile.radii[-1] ** 2))
    values, axes = np.linalg.eigh(moments)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    sigma = np.sqrt(np.maximum(values, 0))
    sigma[:, 1] = np.maximum(sigma[:, 1], 1e-3 * sigma[:, 2])
    sigma[:, 0] = THICKNESS * sigma[:, 1]
    rgb = (colors[:, 0, :3] + colors[:, 1:, :3].mean(axis=1)) / 2
    opacity = np.clip(colors[:, 0, 3] / profile.opacities[0], 0, 1)
    sh = (rgb[:, None] - 0.5) / SH_C0
    if mesh.harmonics is not None:
        sh = np.concatenate([sh, mesh.harmonics], axis=1)
    return GaussianCloud(middle, quaternions_of(axes), sigma, opacity, sh, origin=mesh.origin)


def check_fans(mesh: SplatMesh) -> None:
    """ValueError unless all splats of ``mesh`` are fans of one count of sides, one after the other, each with
    its centre first."""
    if mesh.face_splat is not None and len(mesh.faces):
        first = mesh.faces[mesh.face_splat == mesh.face_splat[0]]
        corners = int(first.max()) + 1
        n = len(mesh.vertices) // corners
        if len(mesh.vertices) == n * corners and len(mesh.faces) == n * len(first):
            expected = first + corners * np.arange(n)[:, None, None]
            if (first[:, 0] == 0).all() and (mesh.faces.reshape(n, -1, 3) == expected).all():
                return
    raise ValueError("not a mesh of equal fans: only the result of a training, unedited, becomes splats")
