"""Scenes for the tests of the Blender part."""

from __future__ import annotations

import numpy as np

from meshsplats.cameras.trajectories import look_at
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh


def random_mesh(count: int = 300, seed: int = 0, **fields) -> SplatMesh:
    """Translucent triangles in a ball of radius 1, y down."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(0, 0.4, (count, 1, 3)) + rng.normal(0, 0.2, (count, 3, 3))
    colors = rng.uniform(0, 1, (3 * count, 4))
    faces = np.arange(3 * count).reshape(-1, 3)
    return SplatMesh(corners.reshape(-1, 3), faces, colors, face_splat=np.arange(count), **fields)


def sheets(count: int, opacity: float) -> SplatMesh:
    """``count`` large squares behind each other, facing along z."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    vertices = np.concatenate([square + np.array([0, 0, 0.01 * i]) for i in range(count)])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(count)])
    return SplatMesh(vertices, faces, np.tile([0.8, 0.5, 0.2, opacity], (len(vertices), 1)))


def ball_splats(count: int = 3000, *, noise: float = 0.0, seed: int = 0) -> tuple[GaussianCloud, np.ndarray]:
    """Flat splats on a ball of radius 1, grey with a red cap, and their true normals (n, 3).

    ``noise`` tilts them (radians) and moves them along the normal (in spacings).
    """
    rng = np.random.default_rng(seed)
    heights = 1 - 2 * (np.arange(count) + 0.5) / count
    angles = np.pi * (3 - 5**0.5) * np.arange(count)
    rings = np.sqrt(1 - heights**2)
    normals = np.stack([rings * np.cos(angles), heights, rings * np.sin(angles)], axis=1)
    spacing = np.sqrt(4 * np.pi / count)
    axes = normals + rng.normal(0, noise, normals.shape)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    # The rotation from +z to the axis, as a quaternion: (1 + z, z x axis), normalised.
    quaternions = np.stack([1 + axes[:, 2], -axes[:, 1], axes[:, 0], np.zeros(count)], axis=1)
    quaternions[axes[:, 2] < -0.999999] = [0, 1, 0, 0]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    colors = np.where(normals[:, 1:2] < -0.5, [0.8, 0.2, 0.1], [0.7, 0.7, 0.7])
    cloud = GaussianCloud(
        normals * (1 + noise * spacing * rng.normal(0, 1, (count, 1))),
        quaternions,
        np.tile([0.8 * spacing, 0.8 * spacing, 0.03 * spacing], (count, 1)),
        np.full(count, 0.9),
        ((colors - 0.5) / 0.28209479177387814)[:, None],
    )
    return cloud, normals


def cameras() -> list[Camera]:
    """Four ways to see the unit ball: plain; wide with fx > fy and the principal point off the centre; tall
    with fx < fy; near, with triangles across the near plane."""
    plain = look_at((0.3, -1, -3), (0, 0, 0), width=64, height=48)
    matrix = plain.world_to_camera
    return [
        plain,
        Camera(matrix, 80.3, 61.1, 20.7, 30.2, 72, 40, name="wide"),
        Camera(matrix, 50.2, 77.7, 30.1, 20.4, 40, 56, name="tall"),
        look_at((0, 0, -0.7), (0, 0, 1), width=50, height=50, near=0.4, name="near"),
    ]
