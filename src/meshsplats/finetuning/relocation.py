"""Densification with a fixed number of triangles: splats that are almost invisible are relocated.

Each of them takes over half of a splat that is needed more. Both are found from gradients that every step
computes anyway, summed over the steps since the last relocation. The gradients of a splat's colours are large
where it is visible and the image is wrong. Those of its positions, in units of its size, are large where the
views pull it in different directions, because one splat cannot be right in all of them. 3DGS clones and
splits its Gaussians by such a sum (Kerbl et al. 2023, section 5.2); here the number of triangles stays the
same, as that of Gaussians does in 3DGS-MCMC (Kheradmand et al. 2024).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshsplats.mesh import SplatMesh

IDLE = 0.2
"""A splat is idle, that is almost invisible, if its colour sum is below this share of the median."""

OVERLAP = 0.2
"""The halves of a splat of length 2 along its longest axis reach from -OVERLAP to 1, and back."""

HALF = (1 + OVERLAP) / 2
"""Share of the splat's area that each half fills."""


class GradientSums:
    """Sums of gradient magnitudes, one per vertex.

    Attributes:
        color: (v,) float32, absolute gradients of the colours, over their four channels.
        position: (v,) float32, norms of the positions' gradients times the vertex' size.
    """

    def __init__(self, color: np.ndarray, position: np.ndarray) -> None:
        self.color, self.position = color, position

    @classmethod
    def zeros(cls, vertices: int) -> GradientSums:
        return cls(np.zeros(vertices, np.float32), np.zeros(vertices, np.float32))

    def add(self, colors: np.ndarray, positions: np.ndarray, sizes: np.ndarray, reached: np.ndarray) -> None:
        """Adds one step's gradients of ``colors`` (v, 4) and ``positions`` (v, 3) where ``reached`` (v,)."""
        rows = np.flatnonzero(reached)
        self.color[rows] += np.abs(colors[rows]).sum(axis=1)
        self.position[rows] += np.sqrt(np.square(positions[rows]).sum(axis=1)) * sizes[rows]

    def arrays(self) -> dict[str, np.ndarray]:
        """Copies of both arrays, for a checkpoint."""
        return {"usage.color": self.color.copy(), "usage.position": self.position.copy()}

    def clear(self) -> None:
        self.color[:] = 0
        self.position[:] = 0


class Relocation(NamedTuple):
    """Pairs of splats, n of k vertices each: an idle splat replaces half of a needed one."""

    idle: np.ndarray
    """(n, k) vertex indices of the splats that are relocated."""
    needed: np.ndarray
    """(n, k) vertex indices of the splats that are halved, corner by corner."""


def plan_relocation(mesh: SplatMesh, sums: GradientSums, in_view: np.ndarray, share: float) -> Relocation:
    """The idlest splats, at most ``share`` of all, paired with the splats that are needed most.

    An idle splat is relocated only if one of its vertices is ``in_view``, (v,) bool: a splat outside every
    view may be the only one in its region. Only splats of the most common topology take part: the same number
    of triangles, with the same relative indices, on vertices that no other splat uses.
    """
    none = np.zeros((0, 0), np.int64)
    if mesh.face_splat is None or not len(mesh.faces):
        return Relocation(none, none)
    starts, ends = mesh.splats.starts, mesh.splats.ends
    low = np.minimum.reduceat(mesh.faces.min(axis=1), starts)
    high = np.maximum.reduceat(mesh.faces.max(axis=1), starts)
    topology = (ends - starts).astype(np.int64) * (len(mesh.vertices) + 1) + (high - low)
    values, counts = np.unique(topology, return_counts=True)
    common = np.flatnonzero(topology == values[counts.argmax()])
    triangles, corners = ends[common[0]] - starts[common[0]], high[common[0]] - low[common[0]] + 1
    relative = mesh.faces[starts[common][:, None] + np.arange(triangles)] - low[common][:, None, None]
    common = common[(relative == relative[0]).all(axis=(1, 2))]
    # A vertex between the lowest and the highest may belong to another splat, too: then neither takes part.
    owners = np.zeros(len(mesh.vertices) + 1, np.int64)
    np.add.at(owners, low, 1)
    np.add.at(owners, high + 1, -1)
    owners = np.cumsum(owners)[:-1]
    rows = low[common].astype(np.int64)[:, None] + np.arange(corners)
    rows = rows[(owners[rows] == 1).all(axis=1)]
    if not len(rows):
        return Relocation(none, none)
    visible, pull = sums.color[rows].sum(axis=1), sums.position[rows].sum(axis=1)
    median = np.median(visible)
    idle = np.flatnonzero((visible < IDLE * median) & in_view[rows].any(axis=1))
    idle = idle[np.argsort(visible[idle], kind="stable")][: int(share * len(starts))]
    needed = np.flatnonzero((visible >= median) & (pull > 0))
    needed = needed[np.argsort(-pull[needed], kind="stable")][: len(idle)]
    return Relocation(rows[idle[: len(needed)]], rows[needed])


def split_in_halves(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of two halves, (n, k, 3) float32 each, of every splat with vertices ``positions``.

    ``positions`` is (n, k, 3). The halves lie side by side along the splat's longest axis and overlap a
    little.
    """
    exact = positions.astype(np.float64)
    offset = exact - exact.mean(axis=1, keepdims=True)
    axis = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 2]
    along = np.einsum("nki,ni->nk", offset, axis)
    narrower = exact - (1 - HALF) * along[..., None] * axis[:, None]
    shift = (1 - HALF) * np.abs(along).max(axis=1)[:, None, None] * axis[:, None]
    return (narrower + shift).astype(np.float32), (narrower - shift).astype(np.float32)
