"""Base meshes made up for tests."""

from __future__ import annotations

import numpy as np

from meshsplats.prior import BaseMesh

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) - np.float32(0.5)
CUBE_FACES = np.array(
    [
        *[[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]],
        *[[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]],
    ],
    np.int32,
)


def cube(seed: int = 0) -> BaseMesh:
    """Twelve triangles that face out, each vertex of another opaque colour; z is up."""
    rng = np.random.default_rng(seed)
    colors = np.ones((8, 4), np.float32)
    colors[:, :3] = rng.random((8, 3))
    return BaseMesh(CUBE, CUBE_FACES, colors, up=np.array([0, 0, 1]))


def bumpy(n: int = 8, seed: int = 0) -> BaseMesh:
    """A square of 2 n^2 triangles with hills, coloured; z is up."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij")
    z = 0.2 * np.sin(3 * x) * np.cos(2 * y) + 0.02 * rng.normal(size=x.shape)
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    corners = [np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]
    colors = np.ones(((n + 1) ** 2, 4), np.float32)
    colors[:, :3] = rng.random(((n + 1) ** 2, 3))
    return BaseMesh(
        np.stack([x, y, z], -1).reshape(-1, 3), np.concatenate(corners), colors, up=np.array([0, 0, 1])
    )


def rotation(rng: np.random.Generator) -> np.ndarray:
    """(3, 3) a random rotation."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q[:, [1, 0, 2]]
