"""convert: a splat cloud as a mesh of translucent triangle fans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats.camera import Camera
from meshsplats.conversion.fans import build, pattern
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

__all__ = ["convert"]


def kept_axes(cloud: GaussianCloud, mode: str) -> np.ndarray:
    """(n, 2) or (n, 3): the numbers of the axes that the ellipses span.

    A flat fan drops the smallest axis of each splat, or the third of a '2dgs' cloud; the two kept follow the dropped
    one cyclically, so that first x second points along it.
    """
    if mode == "3d":
        return np.broadcast_to(np.arange(3), (len(cloud), 3))
    dropped = np.full(len(cloud), 2) if cloud.kernel == "2dgs" else np.argmin(cloud.scales, axis=1)
    return (dropped[:, None] + [1, 2]) % 3


def convert(cloud: GaussianCloud, *, preset: str = "default", cameras: Sequence[Camera] | None = None,
            mode="flat", scale_mul=2.7, no_triag=8, opac_mul=0.2) -> SplatMesh:
    axes = kept_axes(cloud, mode)
    n = len(cloud)
    scales = np.take_along_axis(cloud.scales, axes, axis=1)
    directions = np.take_along_axis(cloud.rotations.transpose(0, 2, 1), axes[:, :, None], axis=1)
    alpha = np.stack([cloud.opacities, opac_mul * cloud.opacities], axis=1)
    vertices, faces, colors, owner = build(
        [pattern(no_triag, 1, mode)],
        np.zeros(n, np.int64),
        cloud.means,
        scales[:, :, None] * directions,
        np.full((n, 1), scale_mul, np.float32),
        cloud.colors,
        alpha,
    )
    return SplatMesh(vertices, faces, colors, face_splat=owner)
