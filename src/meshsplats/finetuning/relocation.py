"""Splats that show next to nothing are put to use: each takes over half of one that is needed more.

What a splat shows, and how much it is needed, is read off the gradients that a step has anyway, summed over
the steps since the last time: of its colours, which are large where it shows and the picture is wrong; and of
its positions in units of its size, which are large where it is pushed about, for it cannot be right in all
views as it is. 3DGS clones and splits its Gaussians by such a sum (Kerbl et al. 2023, section 5.2); here the
number of triangles stays the same, as that of Gaussians does in 3DGS-MCMC (Kheradmand et al. 2024).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshsplats.mesh import SplatMesh, splat_starts

IDLE = 0.2
"""A splat whose sum over its colours is below this share of the median counts as showing next to nothing."""

OVERLAP = 0.2
"""The halves of a splat of length 2 along its longest axis reach from -OVERLAP to 1, and back."""

HALF = (1 + OVERLAP) / 2
"""Share of its area that each of them fills."""


class Usage:
    """Sums of the gradients' sizes, a number a vertex.

    Attributes:
        color: (v,) float32, over the four channels of the colours.
        position: (v,) float32, lengths of the positions' gradients times the vertex' size.
    """

    def __init__(self, color: np.ndarray, position: np.ndarray) -> None:
        self.color, self.position = color, position

    @classmethod
    def none(cls, vertices: int) -> Usage:
        return cls(np.zeros(vertices, np.float32), np.zeros(vertices, np.float32))

    def add(self, colors: np.ndarray, positions: np.ndarray, sizes: np.ndarray, reached: np.ndarray) -> None:
        """Adds the gradients (v, 4) and (v, 3) of one step, where ``reached`` (v,) bool."""
        rows = np.flatnonzero(reached)
        self.color[rows] += np.abs(colors[rows]).sum(axis=1)
        self.position[rows] += np.sqrt(np.square(positions[rows]).sum(axis=1)) * sizes[rows]

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint, copied."""
        return {"usage.color": self.color.copy(), "usage.position": self.position.copy()}

    def clear(self) -> None:
        self.color[:] = 0
        self.position[:] = 0


class Moves(NamedTuple):
    """What takes the place of what: n splats of k vertices each."""

    idle: np.ndarray
    """(n, k) vertex numbers of the splats that are given up."""
    needed: np.ndarray
    """(n, k) those of the splats that are halved, corner by corner."""


def find_moves(mesh: SplatMesh, usage: Usage, looked_at: np.ndarray, share: float) -> Moves:
    """At most ``share`` of all splats, the idlest first, with as many of those that are needed most.

    Idle ones are given up only if they have a vertex that is ``looked_at``, (v,) bool: what no view has
    before it may be all there is of its place. Only splats of the commonest form take part: as many
    triangles, numbered alike, on vertices of their own.
    """
    none = np.zeros((0, 0), np.int64)
    if mesh.face_splat is None or not len(mesh.faces):
        return Moves(none, none)
    starts = splat_starts(mesh.face_splat)
    ends = np.append(starts[1:], len(mesh.faces))
    low = np.minimum.reduceat(mesh.faces.min(axis=1), starts)
    high = np.maximum.reduceat(mesh.faces.max(axis=1), starts)
    forms = (ends - starts).astype(np.int64) * (len(mesh.vertices) + 1) + (high - low)
    values, counts = np.unique(forms, return_counts=True)
    common = np.flatnonzero(forms == values[counts.argmax()])
    triangles, corners = ends[common[0]] - starts[common[0]], high[common[0]] - low[common[0]] + 1
    numbered = mesh.faces[starts[common][:, None] + np.arange(triangles)] - low[common][:, None, None]
    common = common[(numbered == numbered[0]).all(axis=(1, 2))]
    # Vertices between the lowest and the highest may also belong to other splats: then neither moves.
    owners = np.zeros(len(mesh.vertices) + 1, np.int64)
    np.add.at(owners, low, 1)
    np.add.at(owners, high + 1, -1)
    owners = np.cumsum(owners)[:-1]
    rows = low[common].astype(np.int64)[:, None] + np.arange(corners)
    rows = rows[(owners[rows] == 1).all(axis=1)]
    if not len(rows):
        return Moves(none, none)
    shown, pushed = usage.color[rows].sum(axis=1), usage.position[rows].sum(axis=1)
    median = np.median(shown)
    idle = np.flatnonzero((shown < IDLE * median) & looked_at[rows].any(axis=1))
    idle = idle[np.argsort(shown[idle], kind="stable")][: int(share * len(starts))]
    needed = np.flatnonzero((shown >= median) & (pushed > 0))
    needed = needed[np.argsort(-pushed[needed], kind="stable")][: len(idle)]
    return Moves(rows[idle[: len(needed)]], rows[needed])


def halves(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two sets of vertices (n, k, 3) float32 in place of each of ``positions`` (n, k, 3), side by side along
    its longest axis and overlapping a little."""
    exact = positions.astype(np.float64)
    away = exact - exact.mean(axis=1, keepdims=True)
    axis = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away))[1][:, :, 2]
    along = np.einsum("nki,ni->nk", away, axis)
    narrower = exact - (1 - HALF) * along[..., None] * axis[:, None]
    apart = (1 - HALF) * np.abs(along).max(axis=1)[:, None, None] * axis[:, None]
    return (narrower + apart).astype(np.float32), (narrower - apart).astype(np.float32)
