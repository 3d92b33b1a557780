"""The executable specification of ``render_splats``: slow, in float64, written to be read. See
:mod:`meshsplats.rendering.reference`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats.rendering.api import Rendering
from meshsplats.rendering.reference_samples import (
    checked_background,
    pixel_means,
    sample_positions,
    to_camera,
)
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import DILATION, LEAST_OPACITY, GaussianCloud

SPLAT_MAX_ALPHA = 0.99
"""No splat is more opaque than this at a sample, as in 3DGS."""
SPLAT_MIN_TRANSMITTANCE = 1e-4
"""A sample terminates before the splat that would leave less transmittance than this, as in 3DGS."""


def render_splats(
    cloud: GaussianCloud,
    camera: Camera,
    *,
    background: Sequence[float] | np.ndarray = (1, 1, 1),
    samples: int = 1,
    sh_degree: int | None = None,
    dilation: float = DILATION,
) -> Rendering:
    """The image of splats as 3D Gaussian Splatting draws it (Kerbl et al. 2023). Arrays are float64.

    Splats are blended front to back in the order of the depth z of their centres, equal depths by index;
    those with a centre nearer than the near plane are left out. ``dilation`` (square pixels for any
    ``samples``) widens every projected splat; for the kernel '2dgs', 5/3 of it is the least variance.
    ``sh_degree`` limits the degree of the view-dependent colour; None uses all that is stored.

    Unlike the published rasterisers this has no tiles and no cut at three standard deviations: a splat is
    drawn wherever its alpha reaches 1/255.

    Raises ValueError for options out of range or a background of another shape.
    """
    backdrop = checked_background(background, camera)
    if sh_degree is not None and not (sh_degree == int(sh_degree) and sh_degree >= 0):
        raise ValueError(f"sh_degree must be a whole number from 0 on, or None for all, got {sh_degree}")
    if not (np.isfinite(dilation) and dilation >= 0):
        raise ValueError(f"dilation must be >= 0, got {dilation}")
    camera = camera.with_near_plane(cloud.means)
    x, y = sample_positions(camera, samples)
    rgb = splat_colors(cloud, camera, cloud.sh_degree if sh_degree is None else int(sh_degree))
    opacities = cloud.opacities.astype(np.float64)
    centers = to_camera(cloud.means, camera)
    in_front = np.flatnonzero(centers[:, 2] >= (camera.near or 0))
    nearest_first = in_front[np.argsort(centers[in_front, 2], kind="stable")]
    # Columns are the splat's own axes in the camera's frame.
    axes = camera.world_to_camera[:3, :3] @ _rotations(cloud)
    scales = cloud.scales.astype(np.float64)

    color, transmittance = np.zeros((len(x), 3)), np.ones(len(x))
    unfinished = np.ones(len(x), bool)
    fragments = 0
    for i in nearest_first:
        if cloud.kernel == "2dgs":
            falloff = _flat_falloff(centers[i], axes[i], scales[i], camera, x, y, dilation)
        else:
            falloff = _projected_falloff(centers[i], axes[i], scales[i], camera, x, y, dilation, cloud.kernel)
        alpha = np.minimum(SPLAT_MAX_ALPHA, opacities[i] * falloff)
        drawn = unfinished & (alpha >= LEAST_OPACITY)
        after = transmittance * (1 - alpha)
        unfinished &= ~(drawn & (after < SPLAT_MIN_TRANSMITTANCE))
        drawn &= unfinished
        color[drawn] += (transmittance * alpha)[drawn, None] * rgb[i]
        transmittance[drawn] = after[drawn]
        fragments += int(drawn.sum())
    through = pixel_means(transmittance[:, None], camera, samples)
    mean = pixel_means(color, camera, samples)
    return Rendering(color=mean + through * backdrop, alpha=1 - through[..., 0], fragments=fragments)


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """(n, (degree + 1)^2) real spherical harmonics, degree 0 to 3, of unit ``directions`` (n, 3).

    Orthonormal on the sphere, ordered by degree l and then order m = -l .. l, with the Condon-Shortley sign
    (-1)^m: the convention of splat files.

    Raises ValueError for another degree.
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"degree must be 0, 1, 2 or 3, got {degree}")
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z

    def norm(numerator: int, denominator: int) -> float:
        return float(np.sqrt(numerator / (denominator * np.pi)))

    basis = [
        np.full(len(x), norm(1, 4)),
        -norm(3, 4) * y,
        norm(3, 4) * z,
        -norm(3, 4) * x,
        norm(15, 4) * x * y,
        -norm(15, 4) * y * z,
        norm(5, 16) * (2 * zz - xx - yy),
        -norm(15, 4) * x * z,
        norm(15, 16) * (xx - yy),
        -norm(35, 32) * y * (3 * xx - yy),
        norm(105, 4) * x * y * z,
        -norm(21, 32) * y * (4 * zz - xx - yy),
        norm(7, 16) * z * (2 * zz - 3 * xx - 3 * yy),
        -norm(21, 32) * x * (4 * zz - xx - yy),
        norm(105, 16) * z * (xx - yy),
        -norm(35, 32) * x * (xx - 3 * yy),
    ]
    return np.stack(basis[: (degree + 1) ** 2], axis=1)


def splat_colors(cloud: GaussianCloud, camera: Camera, degree: int) -> np.ndarray:
    """(n, 3) RGB of every splat seen from the camera: max(0, 0.5 + SH), direction camera centre to splat.

    ``degree`` is limited to the stored one. As in 3DGS, there is no upper limit to colours, but for those of
    degree 0 alone: they are ``cloud.colors``, at most 1, as a vertex can hold them.
    """
    degree = min(degree, cloud.sh_degree)
    directions = cloud.means.astype(np.float64) - camera.center
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = np.divide(directions, length, out=np.zeros_like(directions), where=length > 0)
    basis = sh_basis(directions, degree)
    sh = cloud.sh[:, : basis.shape[1]].astype(np.float64)
    return np.clip(0.5 + np.einsum("nk,nkc->nc", basis, sh), 0, 1 if degree == 0 else None)


def _rotations(cloud: GaussianCloud) -> np.ndarray:
    """(n, 3, 3) rotation matrices; columns are the splat's own axes in the world frame."""
    w, x, y, z = cloud.quaternions.astype(np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _projected_falloff(
    center: np.ndarray,
    axes: np.ndarray,
    scales: np.ndarray,
    camera: Camera,
    x: np.ndarray,
    y: np.ndarray,
    dilation: float,
    kernel: str,
) -> np.ndarray:
    """exp(-d^T cov^-1 d / 2) of one splat at all samples, with its covariance in the image.

    The projection is linearised at the centre (EWA, Zwicker et al. 2001). Where that is far outside the
    image the Jacobian is taken at 1.3 times the half field of view, as in 3DGS; a principal point off the
    middle moves these limits with it: 0.3 times the half field of view beyond each side of the image. For the
    kernel 'antialiased' the values are scaled to keep the integral that they had before the dilation.
    """
    tan_x, tan_y = center[0] / center[2], center[1] / center[2]
    beyond_x, beyond_y = 0.3 * camera.width / (2 * camera.fx), 0.3 * camera.height / (2 * camera.fy)
    u = np.clip(tan_x, -camera.cx / camera.fx - beyond_x, (camera.width - camera.cx) / camera.fx + beyond_x)
    v = np.clip(tan_y, -camera.cy / camera.fy - beyond_y, (camera.height - camera.cy) / camera.fy + beyond_y)
    jacobian = np.array([[camera.fx, 0, -camera.fx * u], [0, camera.fy, -camera.fy * v]]) / center[2]
    projected_axes = jacobian @ (axes * scales)
    sharp = projected_axes @ projected_axes.T
    cov = sharp + dilation * np.eye(2)
    determinant = cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2
    if determinant <= 0:  # edge on and not widened
        return np.zeros_like(x)
    dx, dy = x - (camera.fx * tan_x + camera.cx), y - (camera.fy * tan_y + camera.cy)
    power = (cov[1, 1] * dx * dx - 2 * cov[0, 1] * dx * dy + cov[0, 0] * dy * dy) / determinant
    falloff = np.exp(-0.5 * np.maximum(0, power))  # below 0 by rounding only
    if kernel == "antialiased":
        falloff *= np.sqrt(max(0.0, sharp[0, 0] * sharp[1, 1] - sharp[0, 1] ** 2) / determinant)
    return falloff


def _flat_falloff(
    center: np.ndarray,
    axes: np.ndarray,
    scales: np.ndarray,
    camera: Camera,
    x: np.ndarray,
    y: np.ndarray,
    dilation: float,
) -> np.ndarray:
    """exp(-rho / 2) of one flat splat at all samples, rho = min(rho3d, rho2d) (2DGS, Huang et al. 2024).

    rho3d is the squared distance, in standard deviations, from the centre to where the ray meets the plane of
    the splat's first two axes; it is infinite where that is nearer than the near plane, behind the camera or
    nowhere, and beside the line that a splat with a scale of 0 is. rho2d = 0.6 / dilation |p - c|^2 (2 in the
    2DGS code), with p the sample and c the projected centre in pixels, keeps splats that are tiny or seen
    edge on from falling between the samples.
    """
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=1)
    normal = np.cross(axes[:, 0], axes[:, 1])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        z = (normal @ center) / (rays @ normal)
        local = (z[:, None] * rays - center) @ axes[:, :2] / scales[:2]
        rho3d = (local**2).sum(axis=1)
    rho3d = np.where((z >= (camera.near or 0)) & np.isfinite(rho3d), rho3d, np.inf)
    dx = x - (camera.fx * center[0] / center[2] + camera.cx)
    dy = y - (camera.fy * center[1] / center[2] + camera.cy)
    return np.exp(-0.5 * np.minimum(rho3d, 0.6 / max(dilation, 1e-6) * (dx * dx + dy * dy)))
