"""Tangent spaces of textured surfaces, as MikkTSpace has them, by which glTF defines its normal maps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshsplats._common.geometry import vertex_normals


class Frames(NamedTuple):
    """Tangent spaces; the bitangent is sign * cross(normal, tangent), without making it a unit again."""

    normals: np.ndarray
    """(..., 3) float64 unit."""
    tangents: np.ndarray
    """(..., 3) float64 unit, along u and across the normal."""
    signs: np.ndarray
    """(...) float64: 1, or -1 in charts that are mirror images."""

    @property
    def signed(self) -> np.ndarray:
        """(..., 4) float32 tangents with their signs, as glTF has them."""
        return np.concatenate([self.tangents, self.signs[..., None]], axis=-1, dtype=np.float32)


def corner_frames(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, fallback: np.ndarray | None = None
) -> Frames:
    """The tangent spaces (f, 3) of the corners of triangles: those of one vertex and one texture coordinate
    share theirs, the mean of their triangles' by angle (Mikkelsen 2008).

    Args:
        vertices: (v, 3).
        faces: (f, 3) vertex indices.
        uv: (f, 3, 2) float32 texture coordinates of the corners, v down.
        fallback: (3,) normal of vertices whose triangles have no area.
    """
    more = {} if fallback is None else {"fallback": fallback}
    normals = vertex_normals(vertices, faces, **more)[faces]
    points, flat = vertices[faces].astype(np.float64), uv.astype(np.float64)
    flat[..., 1] *= -1
    edges = [points[:, k] - points[:, 0] for k in (1, 2)]
    steps = [flat[:, k] - flat[:, 0] for k in (1, 2)]
    area = steps[0][:, 0] * steps[1][:, 1] - steps[0][:, 1] * steps[1][:, 0]
    signs = np.where(area < 0, -1.0, 1.0)
    along = (edges[0] * steps[1][:, 1:] - edges[1] * steps[0][:, 1:]) * signs[:, None]
    tangents = unit(_across(np.repeat(along[:, None], 3, axis=1), normals))
    ahead, back = (unit(_across(np.roll(points, k, axis=1) - points, normals)) for k in (-1, 1))
    angle = np.arccos(np.clip((ahead * back).sum(axis=2), -1, 1))
    key = np.empty((faces.size, 4), np.int32)
    key[:, 0], key[:, 1] = faces.ravel(), np.repeat(signs, 3)
    key[:, 2:] = np.ascontiguousarray(uv, np.float32).reshape(-1, 2).view(np.int32)
    group = np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)
    each = (tangents * angle[..., None]).reshape(-1, 3)
    sums = np.stack([np.bincount(group, each[:, k]) for k in range(3)], axis=1)[group].reshape(-1, 3, 3)
    mean = unit(sums)
    lost = ~mean.any(axis=2)  # triangles without an area in the texture: any direction across the normal
    axis = np.eye(3)[np.abs(normals[lost]).argmin(axis=1)]
    mean[lost] = unit(_across(axis, normals[lost]))
    return Frames(normals, mean, np.repeat(signs[:, None], 3, axis=1))


def _across(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The parts of ``vectors`` that are perpendicular to unit ``normals``."""
    return vectors - (vectors * normals).sum(axis=-1, keepdims=True) * normals


def unit(vectors: np.ndarray) -> np.ndarray:
    """``vectors`` (..., 3) of length 1; those without length stay."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)
