"""The side of an object to show first: that on which there is most to see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats._common.geometry import quaternions_of
from meshsplats.cameras.trajectories import orbit
from meshsplats.rendering.api import render, render_splats
from meshsplats.rendering.layers import fragments
from meshsplats.rendering.previews import USUAL, preview_camera
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import SH_C0, GaussianCloud
from meshsplats.scene.mesh import SplatMesh

DIRECTIONS = 12
"""Directions around the object that are looked from."""
SIDE, PART = 128, 2
"""Pixels along the sides of these images, and of the parts whose means are compared: gaps between splats are
finer than those."""
SPLATS = 40_000
"""Splats, at most, that are drawn in them."""
AREA = 0.5
"""Weight of the area."""
MARGIN = 1.05
"""How much more than from the usual direction another side must show."""
MOST_FRAGMENTS = 2e7
"""Fragments of one of the images above which nothing is looked at."""
SOLID = 0.5
"""Least alpha of pixels that count."""
WIDTH = 0.65
"""Standard deviation of a splat, as a share of the root mean square of the corners of its triangles."""
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
    """``preview_camera`` from the side that shows most."""
    return preview_camera(scene, opening_azimuth(scene, threads=threads))


def _sample(scene: SplatMesh | GaussianCloud) -> SplatMesh | GaussianCloud:
    """Some of its splats, evenly spread and larger for it; all of a mesh that has none."""
    if isinstance(scene, GaussianCloud):
        step = max(1, -(-len(scene) // SPLATS))
        some = scene.take(slice(None, None, step)).of_degree(0)
    elif scene.face_splat is None or not len(scene.faces):
        return scene.plain
    else:
        splats = scene.splats
        step = -(-len(splats) // SPLATS)
        some = _splats_like(scene.take(splats.of_face % step == 0).plain)
    return replace(some, scales=some.scales * np.float32(step**0.5))


def _splats_like(mesh: SplatMesh) -> GaussianCloud:
    """Splats about where those of ``mesh`` are, so that it is seen as the splats that it was made of."""
    splats, corner = mesh.splats, mesh.faces.ravel()
    owner, count = np.repeat(splats.of_face, 3), len(splats)
    opacity = mesh.colors[:, 3].astype(np.float64)
    centers = splats.centers(mesh.vertices, opacity)
    away = mesh.vertices[corner] - centers[owner]
    moments = np.empty((count, 3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        moments[:, i, j] = moments[:, j, i] = np.bincount(owner, away[:, i] * away[:, j], count)
    squares, axes = np.linalg.eigh(moments / (3 * splats.counts)[:, None, None])
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    weight = opacity[corner] + 1e-6
    tints = [np.bincount(owner, weight * mesh.colors[corner, k], count) for k in range(3)]
    colors = np.stack(tints, axis=1) / np.bincount(owner, weight, count)[:, None]
    peaks = np.maximum.reduceat(opacity[corner], 3 * splats.starts)
    return GaussianCloud(
        centers,
        quaternions_of(axes),
        WIDTH * np.sqrt(np.maximum(squares, 0)),
        np.clip(peaks, 0, 1),
        ((colors - 0.5) / SH_C0)[:, None],
        up=mesh.up,
    )


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
