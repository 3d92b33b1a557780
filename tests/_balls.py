"""Photographs of a textured ball, computed without any renderer, and cameras around it."""

from __future__ import annotations

import numpy as np

from meshsplats.datasets.views import View, ViewImage
from meshsplats.scene.camera import Camera


def cameras_around(
    count: int, distance: float = 3.0, side: int = 64, scale: float = 1.0, seed: int = 0
) -> list[Camera]:
    """Cameras evenly around the origin at ``distance`` times ``scale``, looking at it."""
    i = np.arange(count) + 0.5
    z = 0.8 * (1 - 2 * i / count)
    turn = np.pi * (1 + np.sqrt(5)) * i + seed
    ring = np.sqrt(1 - z * z)
    places = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
    cameras = []
    for n, place in enumerate(places):
        forward = -place / np.linalg.norm(place)
        right = np.cross([0, 0, -1.0], forward)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, :3] = [right, np.cross(forward, right), forward]
        matrix[:3, 3] = -matrix[:3, :3] @ (place * distance * scale)
        cameras.append(
            Camera(matrix, 1.2 * side, 1.2 * side, side / 2, side / 2, side, side, name=f"{n:03d}")
        )
    return cameras


def texture(points: np.ndarray) -> np.ndarray:
    """(..., 3) RGB of points (..., 3) of the unit sphere: waves in all directions."""
    rng = np.random.default_rng(3)
    waves = rng.normal(0, 4, (3, 24))
    mix = rng.normal(0, 0.11, (24, 3))
    return np.clip(0.5 + np.sin(points @ waves) @ mix, 0, 1)


def ball_view(camera: Camera, scale: float = 1.0, backdrop: bool = False) -> View:
    """The unit ball times ``scale`` from ``camera``, at 3 x 3 samples a pixel, with alpha; ``backdrop``: in
    front of a textured sphere 8 times as large, without alpha."""
    s = 3
    at = (np.arange(s * camera.width) + 0.5) / s
    x, y = np.meshgrid((at - camera.cx) / camera.fx, (at - camera.cy) / camera.fy)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ camera.world_to_camera[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    center = camera.center / scale
    along = -rays @ center
    miss = center @ center - along**2
    hit = miss < 1
    near = along - np.sqrt(np.where(hit, 1 - miss, 0))
    color = np.where(hit[..., None], texture(center + near[..., None] * rays), 0)
    if backdrop:
        far = along + np.sqrt(64 - miss)
        color = np.where(hit[..., None], color, texture((center + far[..., None] * rays) / 8))

    def mean(values: np.ndarray) -> np.ndarray:
        shape = (camera.height, s, camera.width, s, *values.shape[2:])
        return values.reshape(shape).mean(axis=(1, 3)).astype(np.float32)

    return View(camera, ViewImage(mean(color), None if backdrop else mean(hit.astype(float))))
