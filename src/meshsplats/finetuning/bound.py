"""Vertices that stay on the faces of a base mesh: optimised as barycentric weights of the face's corners."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from meshsplats.finetuning.initial import vertex_means
from meshsplats.scene.binding import Binding
from meshsplats.scene.mesh import SplatMesh

_CHUNK = 1 << 15
"""Vertices processed at a time: the working set fits a processor's cache."""


class BoundPositions:
    """The barycentric weights of a binding during optimisation, and their gradients.

    Attributes:
        weights: (v, 3) float32, changed in place by the optimiser and then projected back onto the simplex by
            ``project``.
    """

    def __init__(self, binding: Binding) -> None:
        self._binding = binding
        self.weights = binding.weights.copy()
        self._gradient = np.zeros_like(self.weights)
        self._corners = np.empty((len(self.weights), 3, 3), np.float32)
        for start in range(0, len(self._corners), _CHUNK):
            part = slice(start, start + _CHUNK)
            self._corners[part] = binding.corners(part)

    def gradient(self, positions: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Gradient of the weights, (v, 3) float32, from the gradient of the ``positions``, (v, 3).

        Only the rows with indices ``rows`` are computed; the result is valid until the next call.

        With x = sum_k w_k c_k the gradient is g . c_k. It is projected onto the directions that keep the sum
        of the weights and the weights that are 0: g . (c_k - c), with c the mean of the corners of nonzero
        weight. This does not depend on the origin.
        """
        for part in _chunks(rows):
            corners, grad, free = self._corners[part], positions[part], self.weights[part] > 0
            shares = free / np.maximum(free.sum(axis=1, keepdims=True), 1).astype(np.float32)
            mean = sum(shares[:, k, None] * corners[:, k] for k in range(3))
            for k in range(3):
                slope = ((corners[:, k] - mean) * grad).sum(axis=1)
                self._gradient[part, k] = np.where(free[:, k], slope, 0)
        return self._gradient

    def project(self, before: np.ndarray, rows: np.ndarray, positions: np.ndarray) -> None:
        """Projects the weights of ``rows`` onto the simplex and updates their ``positions`` (v, 3) in place.

        ``before`` (r, 3) are their weights before the step. Weights that were 0 stay 0: a vertex on an edge
        of its face slides along the edge, and one in a corner stays there, so that no gap opens between
        neighbouring faces. No image gradient would close it again.
        """
        for start in range(0, len(rows), _CHUNK):
            part, fixed = rows[start : start + _CHUNK], before[start : start + _CHUNK] == 0
            projected = project_to_simplex(np.where(fixed, np.float32(-10), self.weights[part]))
            self.weights[part] = projected
            corners, exact = self._corners[part], projected.astype(np.float64)
            positions[part] = sum(exact[:, k, None] * corners[:, k] for k in range(3))

    def binding(self) -> Binding:
        """The binding with the current weights."""
        return replace(self._binding, weights=self.weights.copy())


def _chunks(rows: np.ndarray) -> Iterator[np.ndarray]:
    return (rows[start : start + _CHUNK] for start in range(0, len(rows), _CHUNK))


def project_to_simplex(weights: np.ndarray) -> np.ndarray:
    """(r, 3) float32: for each row of ``weights`` the nearest non-negative one with the sum 1.

    The Euclidean projection onto the simplex (Held, Wolfe, Crowder 1974): one threshold is subtracted from
    all three and negative results become 0. Unlike a softmax it reaches corners and edges exactly. Rounding
    to float32 leaves sums within 6e-8 of 1.
    """
    a, b, c = weights.T.astype(np.float64)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    total = a + b + c
    middle = total - low - high
    # The thresholds if three, two or one of the weights stay positive.
    three, two = (total - 1) / 3, (high + middle - 1) / 2
    threshold = np.where(low > three, three, np.where(middle > two, two, high - 1))
    return np.maximum(weights - threshold[:, None], 0).astype(np.float32)


def weight_units(mesh: SplatMesh, per_scene_unit: bool) -> np.ndarray:
    """(v,) float32 unit of each vertex' weights, so that learning rates mean what they do for free positions.

    The size of the vertex' triangles relative to that of its base face, both as square roots of areas. It is
    computed from the weights alone, so bending the base does not change it. ``per_scene_unit``: the change of
    the weights along one scene unit instead, 0 on faces without area.
    """
    binding = mesh.binding
    assert binding is not None
    if per_scene_unit:
        a, b, c = (binding.base_vertices[binding.base_faces[:, k]].astype(np.float64) for k in range(3))
        side = np.sqrt(np.linalg.norm(np.cross(b - a, c - a), axis=1))
        unit = np.divide(1, side, out=np.zeros_like(side), where=side > 0)
        return unit[binding.vertex_face].astype(np.float32)
    # A triangle whose corners have the weights a, b, c fills |det (a b c)| of its face's area.
    share = np.sqrt(np.abs(np.linalg.det(binding.weights[mesh.faces].astype(np.float64))))
    return vertex_means(mesh, share)
