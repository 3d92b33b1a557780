"""DrawOrder: the order in which a file lists the triangles of a mesh, for viewers that do not sort them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshsplats._common.arrays import checked_array


@dataclass(frozen=True, eq=False)
class DrawOrder:
    """Every triangle twice, once with each winding, from the first that is blended to the last.

    Viewers that cull show of each triangle the copy that faces them, at its own place in the list. Of several
    nodes, each is such a list, and viewers sort the nodes by the middles of their bounds.
    """

    copies: np.ndarray
    """(2 f,) int32: j for triangle j as it is, f + j for the one with the opposite winding; the nodes one
    after another."""
    starts: np.ndarray
    """(n + 1,) int64 first copy of each node, and the end. Both copies of a triangle lie in one node."""

    def __post_init__(self) -> None:
        copies = checked_array("copies", self.copies, np.int32, (None,))
        starts = checked_array("starts", self.starts, np.int64, (None,))
        if len(copies) % 2 or (np.sort(copies) != np.arange(len(copies))).any():
            raise ValueError("copies must hold each index from 0 to 2 f - 1 once, for f triangles")
        if len(starts) < 2 or starts[0] or starts[-1] != len(copies) or (np.diff(starts) <= 0).any():
            raise ValueError(f"starts must ascend from 0 to {len(copies)}, got {starts.tolist()[:8]}")
        object.__setattr__(self, "copies", copies)
        object.__setattr__(self, "starts", starts)
        place = np.empty(len(copies), np.int32)
        place[copies] = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        half = len(copies) // 2
        if (place[:half] != place[half:]).any():
            raise ValueError("both copies of a triangle must lie in one node")

    @property
    def node_count(self) -> int:
        return len(self.starts) - 1

    def take(self, keep: np.ndarray) -> DrawOrder:
        """The order of the triangles of a mesh that ``keep`` marks, (f,) bool: at least one."""
        left = self.copies[np.tile(keep, 2)[self.copies]]
        renumber = np.cumsum(np.tile(keep, 2)) - 1
        ends = np.concatenate([[0], np.cumsum(np.tile(keep, 2)[self.copies])])[self.starts]
        return DrawOrder(renumber[left], np.unique(ends))

    def listed(self, faces: np.ndarray) -> np.ndarray:
        """(2 f, 3) the copies of ``faces``, the (f, 3) vertex indices of the mesh. Raises ValueError for
        another number of triangles."""
        if 2 * len(faces) != len(self.copies):
            raise ValueError(
                f"the order is of {len(self.copies) // 2:,} triangles, the mesh has {len(faces):,}"
            )
        return np.concatenate([faces, faces[:, [0, 2, 1]]])[self.copies]
