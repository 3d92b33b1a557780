"""The view to show first: of an object, the side on which there is most to see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats.cameras.trajectories import orbit
from meshsplats.rendering.api import render, render_splats
from meshsplats.rendering.layers import fragments
from meshsplats.rendering.previews import USUAL, preview_camera
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewpoints.mesh_splats import splats_like
from meshsplats.viewpoints.showing import default_views

DIRECTIONS = 12
"""Directions around the object that are looked from."""
SIDE, PART = 128, 2
"""Pixels along the sides of these images, and of the parts whose means are compared: gaps between splats are
finer than those."""
SPLATS = 40_000
"""Splats, at most, that are drawn in them."""
SIDE_WITHIN = 800
"""Pixels along the sides of an image from within a place."""
AREA = 0.5
"""Weight of the area."""
MARGIN = 1.05
"""How much more than from the usual direction another side must show."""
MOST_FRAGMENTS = 2e7
"""Fragments of one of the images above which nothing is looked at."""
SOLID = 0.5
"""Least alpha of pixels that count."""
SHADES = 12
"""Steps from 0 to 1 in which colours are told apart."""


def opening_azimuth(
    scene: SplatMesh | GaussianCloud,
    *,
    up: Sequence[float] | np.ndarray | None = None,
    threads: int | None = None,
) -> float:
    """Degrees of azimuth, as those of ``orbit``, from which an object shows most: the edges in its image, the
    variety of colours and, by half, its area, each as a share of the most that a side has.

    Args:
        scene: splats or a mesh, of which a sample is drawn. Of one without anything to see: ``USUAL``.
        up: (3,) direction; None: that of the scene.
        threads: at most this many; all processors by default.
    """
    sample = _sample(scene)
    if not len(sample.faces if isinstance(sample, SplatMesh) else sample):
        return USUAL
    cameras = orbit(sample, DIRECTIONS, azimuth=USUAL, elevation=15, up=up, width=SIDE, height=SIDE)
    if fragments(sample, cameras[0], 1) > MOST_FRAGMENTS:
        return USUAL
    shown = np.array([_shown(sample, camera, threads) for camera in cameras])
    most = shown.max(axis=0)
    total = shown / np.where(most > 0, most, 1) @ (AREA, 1, 1)
    best = int(total.argmax())
    return (USUAL + 360 / DIRECTIONS * best) % 360 if total[best] > MARGIN * total[0] else USUAL


def opening_camera(scene: SplatMesh | GaussianCloud, threads: int | None = None) -> Camera:
    """``preview_camera`` from the side that shows most; of a mesh of a place, a view from within."""
    if isinstance(scene, SplatMesh):
        within = default_views(scene, None, 1, side=(SIDE_WITHIN, SIDE_WITHIN), threads=threads)
        if within is not None:
            return within[0][0]
    return preview_camera(scene, opening_azimuth(scene, threads=threads))


def _sample(scene: SplatMesh | GaussianCloud) -> SplatMesh | GaussianCloud:
    """Some of its splats, evenly spread and larger for it; all of a mesh that has none."""
    if isinstance(scene, SplatMesh):
        some = splats_like(scene, SPLATS)
        return scene.plain if some is None else some
    step = max(1, -(-len(scene) // SPLATS))
    some = scene.take(slice(None, None, step)).of_degree(0)
    return replace(some, scales=some.scales * np.float32(step**0.5))


def _shown(
    scene: SplatMesh | GaussianCloud, camera: Camera, threads: int | None
) -> tuple[float, float, float]:
    """The area of an image, the strength of its edges, and the entropy of its colours."""
    if isinstance(scene, SplatMesh):
        image = render(scene, camera, threads=threads)
    else:
        image = render_splats(scene, camera, threads=threads)
    layers = np.dstack([image.color, image.alpha]).astype(np.float64)
    parts = layers.reshape(SIDE // PART, PART, SIDE // PART, PART, 4).mean(axis=(1, 3))
    color, solid = parts[..., :3], parts[..., 3] >= SOLID
    red, green, blue = np.moveaxis(color, 2, 0)
    tones = np.stack([0.3 * red + 0.59 * green + 0.11 * blue, red - green, blue - (red + green) / 2], axis=2)
    right, down = np.abs(np.diff(tones, axis=1)).sum(axis=2), np.abs(np.diff(tones, axis=0)).sum(axis=2)
    edges = (right * (solid[:, 1:] & solid[:, :-1])).sum() + (down * (solid[1:] & solid[:-1])).sum()
    _, counts = np.unique(np.floor(tones[solid] * SHADES), axis=0, return_counts=True)
    share = counts / max(int(solid.sum()), 1)
    return float(solid.mean()), float(edges), float(-(share * np.log(share)).sum())
