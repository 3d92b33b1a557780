"""FaceSplats: which triangles and which vertices of a mesh belong to which splat."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

_CLEAR = 1e-6
"""Weight of a corner of opacity 0, so that splats of nothing else have a centre, too."""
_OPEN = 1e-10
"""Share of the identity in the moments of a splat's motion."""


def check_ascending(face_splat: np.ndarray | None) -> None:
    """Raises ValueError unless ``face_splat`` (f,) are indices of splats, ascending, or None."""
    if (
        face_splat is not None
        and len(face_splat)
        and (face_splat[0] < 0 or (face_splat[1:] < face_splat[:-1]).any())
    ):
        raise ValueError("face_splat must be ascending indices >= 0")


def check_harmonics(blending: str, splats: FaceSplats) -> None:
    """Raises ValueError unless ``splats`` that are blended so can have harmonics."""
    if blending != "display":
        raise ValueError(
            "harmonics are display colours, but the mesh is blended in linear light: give harmonics=None"
        )
    if splats.share_vertices:
        raise ValueError(
            "harmonics are of splats, but two splats share a vertex: give every splat its own vertices, or"
            " harmonics=None"
        )


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
    def shared(self) -> np.ndarray:
        """(v,) bool: the vertices that several splats use."""
        first = np.full(self.vertex_count, -1)
        # Flat copies: through a view of reversed rows, NumPy may go forwards.
        first[self.faces[::-1].ravel()] = np.repeat(self.of_face[::-1], 3)
        return first != self.of_vertex

    @property
    def share_vertices(self) -> bool:
        """Whether two splats use the same vertex."""
        if not len(self):
            return False
        a, b, c = self.faces.T
        low = np.minimum.reduceat(np.minimum(np.minimum(a, b), c), self.starts)
        high = np.maximum.reduceat(np.maximum(np.maximum(a, b), c), self.starts)
        if (high[:-1] < low[1:]).all():
            return False  # as in what ``convert`` makes: found in a fifth of the time
        return bool((self.of_vertex[self.faces] != self.of_face[:, None]).any())

    def part(self, splats: slice) -> FaceSplats:
        """The splats of a slice with step 1, counted from 0, and their triangles."""
        start, stop, _ = splats.indices(len(self))
        own = slice(self.starts[start], self.ends[stop - 1]) if start < stop else slice(0)
        numbers = None if self.face_splat is None else self.face_splat[own]
        return FaceSplats(self.faces[own], numbers, self.vertex_count)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """(s, ...) sums of ``values`` (f, ...) over the triangles of each splat."""
        return np.add.reduceat(values, self.starts) if len(self) else values[:0]

    def centers(self, vertices: np.ndarray, opacities: np.ndarray) -> np.ndarray:
        """(s, 3) float64 means of the corners of each splat, weighted by their opacity.

        Concretely, a corner with ``opacities[i]`` at ``vertices[i]`` has the weight ``opacities[i] + 1e-6``.
        """
        corner, owner = self.faces.ravel(), np.repeat(self.of_face, 3)
        weight = opacities[corner].astype(np.float64) + _CLEAR
        total = np.bincount(owner, weight, len(self))
        sums = [np.bincount(owner, weight * vertices[corner, axis], len(self)) for axis in range(3)]
        return np.stack([column / total for column in sums], axis=1)

    def rotations(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """(s, 3, 3) float64 rotation of each splat that fits best how its corners have moved, from positions
        ``before`` (v, 3) to ``after`` (v, 3), besides a shift; least squares (Kabsch 1976).

        Of rotations that fit as well as each other, as where all corners lie on a line, the smallest.
        """
        old, new = (points[self.faces].astype(np.float64) for points in (before, after))
        old -= (self.sums(old.sum(axis=1)) / (3 * self.counts)[:, None])[self.of_face][:, None]
        moments = self.sums(np.einsum("fki,fkj->fij", old, new))
        size = np.linalg.norm(moments, axis=(1, 2))
        # A little of the identity decides what the corners leave open.
        moments += np.where(size > 0, _OPEN * size, 1)[:, None, None] * np.eye(3)
        u, _, vt = np.linalg.svd(moments)
        v = vt.transpose(0, 2, 1)
        v[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(v))[:, None]
        return np.asarray(v @ u.transpose(0, 2, 1))

    def turned(self, vectors: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """(v, 3) float32 ``vectors`` (v, 3) of vertices, turned as the triangles around each vertex turn by
        the (s, 3, 3) ``rotations`` of their splats; of their lengths."""
        corner, owner = self.faces.ravel(), np.repeat(self.of_face, 3)
        turned = np.einsum("cij,cj->ci", rotations[owner], vectors[corner])
        sums = np.stack([np.bincount(corner, column, len(vectors)) for column in turned.T], axis=1)
        length = np.linalg.norm(sums, axis=1, keepdims=True)
        wanted = np.linalg.norm(vectors.astype(np.float64), axis=1, keepdims=True)
        # A vertex of no triangle keeps its vector, and one whose triangles turn against each other.
        kept = length <= 1e-6 * wanted
        return np.where(kept, vectors, sums * (wanted / np.where(kept, 1, length))).astype(np.float32)
