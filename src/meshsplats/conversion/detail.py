"""More triangles for splats that show large, fewer for those that show little, and as many in all.

In pictures that just hold a scene, most splats show less than a pixel, where no one can tell an octagon from
a square, and most of the difference to the splats' own picture lies on the few that show large.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats.camera import Camera, a_few
from meshsplats.mesh import SplatMesh

LEVELS = ((4, 1), (6, 1), (8, 1), (8, 2), (12, 2), (12, 3), (16, 3))
"""Sides and rings of the ellipses to choose from, by their number of triangles."""

TRIANGLES = np.array([(2 * rings - 1) * sides for sides, rings in LEVELS])
"""Their numbers of triangles, ascending."""

LEAST = int(TRIANGLES[0])

POWER = 0.5
"""A splat gets triangles in proportion to this power of the pixels that it shows. If the error that is left
on a splat falls as ``triangles^-p``, ``1 / (1 + p)`` leaves the least in all. Measured after fine-tuning, 0.5
is at least as good as 0.7."""

PICTURES = 16
"""Most cameras, evenly spread, whose pictures are looked at."""

SIDE = 400
"""Greatest side of these pictures: it is ratios that count."""


def shown_pixels(mesh: SplatMesh, splats: int, cameras: Sequence[Camera]) -> np.ndarray:
    """(splats,) float64 pixels that ``cameras`` show of each splat, a picture: sums of blending weights.

    A weight is the derivative of a picture of an attribute by that attribute.
    """
    from meshsplats.rendering.recorded import RecordedPicture

    assert mesh.face_splat is not None
    attribute = np.zeros((len(mesh.vertices), 1), np.float32)
    weights = np.zeros_like(attribute)
    positions, colors = np.zeros_like(mesh.vertices), np.zeros_like(mesh.colors)
    chosen = a_few(cameras, PICTURES, SIDE)
    for camera in chosen:
        picture = RecordedPicture(
            mesh.vertices, mesh.faces, mesh.colors, attribute, camera, face_splat=mesh.face_splat
        )
        h, w = picture.alpha.shape
        picture.back(
            np.zeros((h, w, 3), np.float32),
            None,
            np.ones((h, w, 1), np.float32),
            vertices=positions,
            colors=colors,
            vertex_attributes=weights,
        )
    owner = np.zeros(len(weights), np.int64)
    owner[mesh.faces.ravel()] = np.repeat(mesh.face_splat, 3)
    return np.bincount(owner, weights[:, 0], splats) / len(chosen)


def choose_levels(shown: np.ndarray, budget: int) -> np.ndarray:
    """(n,) int8 numbers of LEVELS for splats that show so many pixels; at most ``budget`` triangles in all.

    ValueError if not even the least fit.
    """
    if len(shown) * LEAST > budget:
        raise ValueError(f"{len(shown)} splats need at least {len(shown) * LEAST} triangles, not {budget}")
    # The level rises with the factor of proportionality, from one to the next half way on a scale of ratios.
    half_way = np.sqrt(TRIANGLES[1:] * TRIANGLES[:-1].astype(np.float64))
    with np.errstate(divide="ignore"):
        factors = half_way / np.maximum(shown, 0)[:, None] ** POWER
    steps = len(half_way)
    order = np.argsort(factors, axis=None, kind="stable")
    order = order[np.isfinite(factors.ravel()[order])]
    spent = len(shown) * LEAST + np.cumsum(np.diff(TRIANGLES)[order % steps])
    taken = order[: np.searchsorted(spent, budget, side="right")]
    return np.bincount(taken // steps, minlength=len(shown)).astype(np.int8)
