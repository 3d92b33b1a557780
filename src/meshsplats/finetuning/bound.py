"""Positions that stay on the faces of a base mesh: optimised as convex combinations of the corners."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from meshsplats.binding import Binding
from meshsplats.finetuning.initial import means_at_vertices
from meshsplats.mesh import SplatMesh

_ROWS = 1 << 15
"""Vertices that are worked on at a time: what they need fits a processor's cache."""


class BoundPositions:
    """The weights of a binding while they are optimised, and their gradients.

    Attributes:
        weights: (v, 3) float32, changed in place by the optimiser and then put back by ``settle`` to where a
            binding's weights may lie.
    """

    def __init__(self, binding: Binding) -> None:
        self._binding = binding
        self.weights = binding.weights.copy()
        self._gradient = np.zeros_like(self.weights)
        self._corners = np.empty((len(self.weights), 3, 3), np.float32)
        for start in range(0, len(self._corners), _ROWS):
            part = slice(start, start + _ROWS)
            self._corners[part] = binding.corners(part)

    def gradient(self, positions: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """(v, 3) float32 gradient of the weights from that of the ``positions`` (v, 3), for the chosen rows
        only; valid until the next call.

        With x = sum_k w_k c_k it is g . c_k. Of this the part counts that leaves the sum of the weights as it
        is, and those at 0 there, which is g . (c_k - c) with c the mean of the corners with a weight; it is
        the same wherever the origin lies.
        """
        for part in _portions(rows):
            corners, along, free = self._corners[part], positions[part], self.weights[part] > 0
            shares = free / np.maximum(free.sum(axis=1, keepdims=True), 1).astype(np.float32)
            middle = sum(shares[:, k, None] * corners[:, k] for k in range(3))
            for k in range(3):
                slope = ((corners[:, k] - middle) * along).sum(axis=1)
                self._gradient[part, k] = np.where(free[:, k], slope, 0)
        return self._gradient

    def settle(self, before: np.ndarray, rows: np.ndarray, positions: np.ndarray) -> None:
        """Moves the weights of the chosen rows to the nearest ones that are not negative and have the sum 1,
        and ``positions`` (v, 3) with them. ``before`` (r, 3) are their weights before the step.

        What was 0 stays 0: a vertex on an edge of its face slides along it, and one in a corner stays there,
        so that no gap opens between neighbours. Nothing in a picture's gradient would close it again.
        """
        for start in range(0, len(rows), _ROWS):
            part, held = rows[start : start + _ROWS], before[start : start + _ROWS] == 0
            settled = nearest_convex(np.where(held, np.float32(-10), self.weights[part]))
            self.weights[part] = settled
            corners, exact = self._corners[part], settled.astype(np.float64)
            positions[part] = sum(exact[:, k, None] * corners[:, k] for k in range(3))

    def binding(self) -> Binding:
        """The binding as it is now."""
        return replace(self._binding, weights=self.weights.copy())


def _portions(rows: np.ndarray) -> Iterator[np.ndarray]:
    return (rows[start : start + _ROWS] for start in range(0, len(rows), _ROWS))


def nearest_convex(weights: np.ndarray) -> np.ndarray:
    """(r, 3) float32: for each row of ``weights`` the nearest one with no number below 0 and the sum 1.

    The projection onto the simplex (Held, Wolfe, Crowder 1974): a number is taken from all, and what falls
    below 0 becomes 0. Corners and edges are reached exactly, which no softmax does. Rounding to float32
    leaves sums within 6e-8 of 1.
    """
    a, b, c = weights.T.astype(np.float64)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    total = a + b + c
    middle = total - low - high
    # What has to be taken if three, two or one of the numbers stay above 0.
    three, two = (total - 1) / 3, (high + middle - 1) / 2
    taken = np.where(low > three, three, np.where(middle > two, two, high - 1))
    return np.maximum(weights - taken[:, None], 0).astype(np.float32)


def weight_units(mesh: SplatMesh, per_scene_unit: bool) -> np.ndarray:
    """(v,) float32 unit of each vertex' weights, so that rates mean what they do for free positions.

    The size of the vertex' triangles as a share of its base face's, sides of squares of their areas, measured
    in the weights themselves: it is the same however the base is bent. ``per_scene_unit``: by how much the
    weights change along a scene unit, 0 on faces without area.
    """
    binding = mesh.binding
    assert binding is not None
    if per_scene_unit:
        a, b, c = (binding.base_vertices[binding.base_faces[:, k]].astype(np.float64) for k in range(3))
        side = np.sqrt(np.linalg.norm(np.cross(b - a, c - a), axis=1))
        unit = np.divide(1, side, out=np.zeros_like(side), where=side > 0)
        return unit[binding.vertex_face].astype(np.float32)
    # Of a triangle with weights a, b, c in its corners, |det (a b c)| is the share of its face that it fills.
    share = np.sqrt(np.abs(np.linalg.det(binding.weights[mesh.faces].astype(np.float64))))
    return means_at_vertices(mesh, share)
