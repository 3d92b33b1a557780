"""FaceSplats: which triangles and which vertices of a mesh belong to which splat."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True, eq=False)
class FaceSplats:
    """The splats of a mesh, counted 0 to s - 1 in the order of their triangles, which lie side by side.

    Where the triangles have no splats, each counts as one.
    """

    faces: np.ndarray
    """(f, 3) int32 vertex indices."""
    face_splat: np.ndarray | None
    """(f,) int32, ascending and with gaps, or None, as in ``SplatMesh``."""
    vertex_count: int

    def __len__(self) -> int:
        return len(self.starts)

    @cached_property
    def starts(self) -> np.ndarray:
        """(s,) int64 first triangle of each splat."""
        if self.face_splat is None or not len(self.faces):
            return np.arange(len(self.faces))
        return np.flatnonzero(np.concatenate([[True], np.diff(self.face_splat) > 0]))

    @cached_property
    def ends(self) -> np.ndarray:
        """(s,) int64 triangle behind the last one of each splat."""
        return np.append(self.starts[1:], len(self.faces))[: len(self)]

    @property
    def counts(self) -> np.ndarray:
        """(s,) int64 triangles of each splat."""
        return self.ends - self.starts

    @property
    def numbers(self) -> np.ndarray:
        """(s,) values of the splats in ``face_splat``; without it, those of the triangles."""
        return self.starts if self.face_splat is None else self.face_splat[self.starts]

    @cached_property
    def of_face(self) -> np.ndarray:
        """(f,) int64 splat of each triangle."""
        return np.repeat(np.arange(len(self)), self.counts)

    @cached_property
    def of_vertex(self) -> np.ndarray:
        """(v,) int64 splat of each vertex: the last one that uses it, -1 for none."""
        owner = np.full(self.vertex_count, -1)
        owner[self.faces] = self.of_face[:, None]
        return owner

    @property
    def share_vertices(self) -> bool:
        """Whether two splats use the same vertex."""
        return bool((self.of_vertex[self.faces] != self.of_face[:, None]).any())

    def sums(self, values: np.ndarray) -> np.ndarray:
        """(s, ...) sums of ``values`` (f, ...) over the triangles of each splat."""
        return np.add.reduceat(values, self.starts) if len(self) else values[:0]
