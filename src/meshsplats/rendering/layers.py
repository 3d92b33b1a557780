"""How many layers an image has, without drawing it: what it would cost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._core.library import processors
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

SAMPLE = 20_000
"""Triangles or splats that are looked at, evenly spread."""
_REACH = 3.0
"""Standard deviations within which a splat is drawn."""
FRAGMENTS_A_SECOND = 1.5e8
"""Of one thread, where layers are many. Nine scenes of 4 to 70 layers have 0.2 to 0.9 of it, a scene of
51,000 layers 1.2."""
MANY_LAYERS = 1000
"""More layers than real scenes have: 4 to 70 of triangles, up to 230 of splats."""
SMALLEST = 1 / 8
"""How far an image is made smaller at most, to cost less."""


def layers(scene: SplatMesh | GaussianCloud, camera: Camera) -> float:
    """Mean number of triangles, or of splats, that lie over each other at a pixel of an image.

    It is estimated from the size on the image of some of them. Layers behind opaque ones count, too, though
    early termination leaves many of those out.
    """
    if isinstance(scene, SplatMesh):
        count = len(scene.faces)
        places, corners = scene.vertices, scene.vertices[subsample(scene.faces, SAMPLE)]
        reach = np.zeros(corners.shape[:2])
    else:
        count = len(scene)
        places, corners = scene.means, subsample(scene.means, SAMPLE)[:, None]
        # The two largest axes are what is seen on average.
        ordered = np.sort(subsample(scene.scales, SAMPLE).astype(np.float64), axis=1)
        reach = _REACH * np.sqrt(ordered[:, 1:].prod(axis=1))[:, None]
    if not count:
        return 0.0
    near = camera.near_plane(places)
    with np.errstate(over="ignore", invalid="ignore"):
        points = corners.astype(np.float64) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        depth = np.maximum(points[..., 2], near)
        sides, at, areas = [], [], np.full(len(points), np.inf)
        for axis, (focal, center, size) in enumerate(
            [(camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height)]
        ):
            middle, around = focal * points[..., axis] / depth + center, focal * reach / depth
            at.append(middle)
            low, high = (middle - around).min(axis=1), (middle + around).max(axis=1)
            sides.append(np.clip(high, 0, size) - np.clip(low, 0, size))
        if isinstance(scene, SplatMesh):
            u, v = at
            areas = 0.5 * np.abs(
                (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
            )
        shown = (points[..., 2] > near).any(axis=1)
        covered = np.where(shown, np.fmin(areas, sides[0] * sides[1]), 0)
    return float(covered.mean()) * count / (camera.width * camera.height)


def fragments(scene: SplatMesh | GaussianCloud, camera: Camera, samples: int) -> float:
    """Number of fragments of an image, with ``samples`` x ``samples`` in each pixel."""
    return layers(scene, camera) * camera.width * camera.height * samples**2


def estimated_seconds(
    scene: SplatMesh | GaussianCloud, cameras: Sequence[Camera], samples: int, threads: int | None = None
) -> float:
    """Time that images from ``cameras`` take where layers are many, by up to eight of them."""
    each = float(np.mean([fragments(scene, camera, samples) for camera in subsample(cameras, 8)]))
    return each * len(cameras) / FRAGMENTS_A_SECOND / (threads or processors())


def affordable(scene: SplatMesh | GaussianCloud, camera: Camera, samples: int, most: float) -> Camera | None:
    """``camera``, or the same of a half, a quarter or an eighth of the size, whose image has at most ``most``
    fragments; None if none has."""
    share, whole = 1.0, fragments(scene, camera, samples)
    while share >= SMALLEST:
        if share * share * whole <= most:
            return camera if share == 1 else camera.scaled(share)
        share /= 2
    return None
