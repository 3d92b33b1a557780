"""Binding: the face of a base mesh that each vertex of a splat mesh lies on, and its place on it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from meshsplats._common.arrays import checked_array
from meshsplats._common.geometry import vertex_normals

_ROWS = 1 << 15
_MOST_STRETCH = 8.0
"""Largest factor by which a face sets layers apart, beyond that of most of the base, or 1: a vertex that
flies off in a simulation must not take the layers around it along."""
_EVEN = 1e-4
"""Largest difference between the stretches of a base that counts as scaled as a whole."""
_ANY = (0.0, 0.0, 1.0)
"""The normal where there is none."""
SUM_TOLERANCE = 1e-6
"""Largest error of the sum of a vertex's weights, 1: a few roundings of float32."""


class ArrayField(NamedTuple):
    """Declares an array of ``SplatMesh`` or ``Binding``; constructors, readers and writers follow it."""

    name: str
    dtype: type[np.generic]
    per: Literal["vertex", "face", "splat", "mesh", "base vertex", "base face"]
    """The element that each row belongs to. "splat": row i belongs to splat i of ``SplatMesh.splats``, which
    have no gaps; declare it behind ``face_splat``. "mesh": the array has no rows."""
    columns: int | tuple[int | None, ...] | None = None
    """Length of a row, or its shape, where None is any number; None for a single number."""
    optional: bool = False

    def shape(self, counts: Mapping[str, int]) -> tuple[Any, ...]:
        """Shape with ``counts`` rows by ``per``; None (any number) where that count is missing."""
        rows = () if self.per == "mesh" else (counts.get(self.per),)
        if self.columns is None:
            return rows
        return (*rows, *self.columns) if isinstance(self.columns, tuple) else (*rows, self.columns)


@dataclass(frozen=True, eq=False)
class Binding:
    """V vertices on the faces of a base mesh of n vertices and m triangles (a mesh prior).

    Concretely, vertex i stands at ``sum_k weights[i, k] * c_k``, where c_k is corner k of face
    ``vertex_face[i]``: ``base_vertices[base_faces[vertex_face[i], k]]``, moved by ``layers[i] * lift``, times
    the ``stretch`` there, along the base's normal at that corner. The constructor checks and converts the
    arrays (C-contiguous).
    """

    base_vertices: np.ndarray
    """(n, 3) float32 positions of the base, in the frame and units of the splat mesh."""
    base_faces: np.ndarray
    """(m, 3) int32 vertex indices of the base."""
    vertex_face: np.ndarray
    """(v,) int32 index of the base face that each vertex lies on."""
    weights: np.ndarray
    """(v, 3) float32 barycentric coordinates on that face, >= 0, with sum 1."""
    layers: np.ndarray
    """(v,) int32 layer of each vertex; layer 0 lies on the base."""
    lift: float = 0.0
    """Scene units from one layer to the next along the normals, negative inwards; 0: all lie in the base."""
    stretch: np.ndarray | None = None
    """(n,) float32 factors, >= 0, of ``lift`` at the vertices of the base; None: 1 everywhere."""

    FIELDS: ClassVar[tuple[ArrayField, ...]] = (
        ArrayField("base_vertices", np.float32, "base vertex", 3),
        ArrayField("base_faces", np.int32, "base face", 3),
        ArrayField("vertex_face", np.int32, "vertex"),
        ArrayField("weights", np.float32, "vertex", 3),
        ArrayField("layers", np.int32, "vertex"),
        ArrayField("stretch", np.float32, "base vertex", optional=True),
    )
    _OF_VERTICES: ClassVar[tuple[str, ...]] = tuple(f.name for f in FIELDS if f.per == "vertex")

    def __post_init__(self) -> None:
        check_fields(self)
        check_indices("base_faces", self.base_faces, len(self.base_vertices), "vertices of the base")
        check_indices("vertex_face", self.vertex_face, len(self.base_faces), "faces of the base")
        if len(self.vertex_face):
            if self.weights.min() < 0:
                raise ValueError(f"weights must not be negative, got {self.weights.min():.4g}")
            off = float(np.abs(self.weights.sum(axis=1, dtype=np.float64) - 1).max())
            if off > SUM_TOLERANCE:
                raise ValueError(f"the weights of a vertex must have the sum 1, one misses it by {off:.3g}")
            if self.layers.min() < 0:
                raise ValueError(f"layers must be >= 0, got {self.layers.min()}")
        if self.stretch is not None and len(self.stretch) and self.stretch.min() < 0:
            raise ValueError(f"stretch must not be negative, got {self.stretch.min():.4g}")
        if not np.isfinite(self.lift):
            raise ValueError(f"lift must be a finite length, got {self.lift}")
        object.__setattr__(self, "lift", float(self.lift))

    def arrays(self) -> dict[str, np.ndarray]:
        """``given_fields``, and ``lift`` as an array without dimensions."""
        return self.given_fields() | {"lift": np.array(self.lift)}

    def given_fields(self) -> dict[str, np.ndarray]:
        """The arrays ``FIELDS`` by name, but those that are None."""
        values = {f.name: getattr(self, f.name) for f in self.FIELDS}
        return {name: value for name, value in values.items() if value is not None}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], prefix: str = "") -> Binding:
        """The inverse of ``arrays``, whose names have a ``prefix`` now; other names are ignored.

        Raises:
            KeyError: an array is missing.
            ValueError: the arrays do not make a binding.
        """
        fields = [f.name for f in cls.FIELDS if not f.optional or prefix + f.name in arrays]
        parts = {name: arrays[prefix + name] for name in fields}
        lift = float(arrays[prefix + "lift"])
        try:
            return cls(**parts, lift=lift)
        except (ValueError, TypeError) as error:
            raise ValueError(f"the binding to a base: {error}") from None

    def positions(self) -> np.ndarray:
        """(v, 3) float32 positions of the vertices.

        Summed in float64: a vertex at a corner has that corner's position to the last bit.
        """
        result = np.empty((len(self.weights), 3), np.float32)
        for part in self._parts():
            result[part] = np.einsum("ik,ikc->ic", self.weights[part].astype(np.float64), self.corners(part))
        return result

    def corners(self, rows: np.ndarray | slice) -> np.ndarray:
        """(r, 3, 3) float64 corners of the face of each of the chosen vertices, moved to its layer."""
        return self.lifted(self.vertex_face[rows], self.layers[rows])

    def lifted(self, faces: np.ndarray, layers: np.ndarray) -> np.ndarray:
        """(r, 3, 3) float64 corners of ``faces`` (r,) of the base, moved to ``layers`` (r,). Where the base
        has no normal, faces have their own: those of a card with a face on either side move apart."""
        indices = self.base_faces[faces]
        result = self.base_vertices[indices].astype(np.float64)
        if self.lift:
            normals = self.base_normals[indices]
            lost = ~normals.any(axis=2)
            if lost.any():
                own = np.cross(result[:, 1] - result[:, 0], result[:, 2] - result[:, 0])
                length = np.linalg.norm(own, axis=1, keepdims=True)
                own /= np.where(length > 0, length, 1)
                normals = np.where(lost[:, :, None], own[:, None], normals)
            out = (layers * self.lift)[:, None, None] * normals
            result += out if self.stretch is None else out * self.stretch[indices][:, :, None]
        return result

    def normals(self) -> np.ndarray:
        """(v, 3) float32 unit normals of the base at the vertices: those of the corners, interpolated."""
        result = np.empty((len(self.weights), 3), np.float32)
        for part in self._parts():
            indices = self.base_faces[self.vertex_face[part]]
            mixed = np.einsum("ik,ikc->ic", self.weights[part].astype(np.float64), self.base_normals[indices])
            length = np.sqrt(np.einsum("ij,ij->i", mixed, mixed))
            # Where normals of the corners cancel out: the face's own normal, or else one corner's.
            lost = np.flatnonzero(length < 1e-6)
            if len(lost):
                a, b, c = (self.base_vertices[indices[lost, k]].astype(np.float64) for k in range(3))
                mixed[lost] = np.cross(b - a, c - a)
                length[lost] = np.linalg.norm(mixed[lost], axis=1)
                flat = np.flatnonzero(length == 0)
                corner = self.base_normals[indices[flat, 0]]
                mixed[flat] = np.where(corner.any(axis=1, keepdims=True), corner, _ANY)
                length[flat] = 1
            result[part] = mixed / length[:, None]
        return result

    @cached_property
    def base_normals(self) -> np.ndarray:
        """(n, 3) float64 unit normals of the base at its vertices, continuous across seams; 0 where the faces
        around have no area, or cancel out."""
        vertices = self.base_vertices.astype(np.float64)
        return vertex_normals(vertices, self.base_faces, same_place=self.places, fallback=(0, 0, 0))

    def _face_sides(self, base_vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Two sides of each of the base's faces, (m, 3) float64 vectors from its first corner."""
        a, b, c = (base_vertices[self.base_faces[:, k]].astype(np.float64) for k in range(3))
        return b - a, c - a

    def _parts(self) -> Iterator[slice]:
        """Slices of the vertices that fit the processor's cache."""
        return (slice(start, start + _ROWS) for start in range(0, len(self.weights), _ROWS))

    @cached_property
    def places(self) -> np.ndarray:
        """(n,) index of a place for each vertex of the base: vertices that a seam has split share one.

        Found in the stored base, as vertices of a moved one may coincide by chance.
        """
        points = self.base_vertices + np.float32(0)  # 0 and -0 are one place
        order = np.lexsort(points.T)
        new = (points[order[1:]] != points[order[:-1]]).any(axis=1)
        place = np.zeros(len(points), np.int64)
        place[order[1:]] = np.cumsum(new)
        return place

    def moved(self, base_vertices: np.ndarray, lift: float, stretch: np.ndarray | None = None) -> Binding:
        """The binding to the base with its vertices at (n, 3) ``base_vertices``. Seams stay as they were, and
        ``stretch`` (n,), unless given."""
        stretch = self.stretch if stretch is None else stretch
        made = replace(self, base_vertices=base_vertices, lift=lift, stretch=stretch)
        made.__dict__["places"] = self.places
        return made

    def posed(self, base_vertices: np.ndarray) -> Binding:
        """The binding to the base bent so that its vertices are at (n, 3) ``base_vertices``.

        The distance between layers follows the base: at each of its vertices, it is multiplied by the mean,
        weighted by area, of what the faces around it are stretched by: the square root of the product of
        their two principal stretches, of which the larger counts as twice the smaller at most. Where nothing
        is stretched the distance stays. A base that is scaled as a whole changes ``lift`` alone.
        """
        if not self.lift:
            return self.moved(base_vertices, self.lift)
        old, new = self._face_sides(self.base_vertices), self._face_sides(base_vertices)
        before, after = (np.linalg.norm(np.cross(*sides), axis=1) for sides in (old, new))
        whole = before.sum()
        if not whole:
            return self.moved(base_vertices, self.lift)
        factors = _stretches(old, new, before, after)
        order = np.argsort(factors)
        usual = factors[order[np.searchsorted(np.cumsum(before[order]), whole / 2)]]
        factors = np.minimum(factors, _MOST_STRETCH * max(usual, 1))
        corners, count = self.places[self.base_faces].ravel(), len(self.base_vertices)
        area, stretched = (
            np.bincount(corners, np.repeat(values, 3), minlength=count)
            for values in (before, before * factors)
        )
        local = np.divide(stretched, area, out=np.full(count, usual), where=area > 0)[self.places]
        if np.abs(local - usual).max() <= _EVEN * usual:
            return self.moved(base_vertices, self.lift * float((before * factors).sum() / whole))
        stretch = local if self.stretch is None else local * self.stretch
        return self.moved(base_vertices, self.lift, stretch.astype(np.float32))

    def take(self, rows: np.ndarray) -> Binding:
        """The binding of the vertices ``rows``, indices or a (v,) mask; the base stays whole."""
        return replace(self, **{name: getattr(self, name)[rows] for name in self._OF_VERTICES})

    def joined(self, others: Sequence[Binding]) -> Binding:
        """The binding of these vertices and then those of ``others`` to the base that all share.

        Raises ValueError for another base, or another distance between layers.
        """
        alike = [f.name for f in self.FIELDS if f.name not in self._OF_VERTICES]
        for other in others:
            same = all(np.array_equal(getattr(self, name), getattr(other, name)) for name in alike)
            if not same or other.lift != self.lift:
                raise ValueError(
                    "the meshes are bound to bases that differ: join them without (binding=None), or bind"
                    " them to one"
                )
        every = (self, *others)
        rows: dict[str, Any] = {}
        for name in self._OF_VERTICES:
            rows[name] = np.concatenate([getattr(one, name) for one in every])
        return replace(self, **rows)


def _stretches(
    old: tuple[np.ndarray, np.ndarray],
    new: tuple[np.ndarray, np.ndarray],
    before: np.ndarray,
    after: np.ndarray,
) -> np.ndarray:
    """(m,) what each of the triangles is stretched by whose two sides (m, 3) were ``old`` and are ``new``,
    with twice the areas ``before`` and ``after`` (m,): 1 for those that had no area."""

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.einsum("ij,ij->i", a, b)

    def ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.divide(a, b, out=np.ones_like(b), where=before > 0)

    # Along the first side and across it, not by the metrics of both: these cancel out in slivers.
    first = dot(old[0], old[0])
    across = new[1] - ratio(dot(*old), first)[:, None] * new[0]
    product = ratio(after, before)
    squares = ratio(dot(new[0], new[0]), first), ratio(ratio(dot(across, across), before) * first, before)
    half = np.maximum(sum(squares) / 2, product)  # it is, up to rounding
    larger = np.sqrt(half + np.sqrt((half - product) * (half + product)))
    smaller = np.divide(product, larger, out=np.zeros_like(larger), where=larger > 0)
    return np.minimum(np.sqrt(product), 2**0.5 * smaller)


def check_fields(owner: Any) -> dict[str, int]:
    """Checks and converts the arrays ``FIELDS`` of a frozen data class; returns the rows by ``per``."""
    counts: dict[str, int] = {}
    for field in owner.FIELDS:
        value = getattr(owner, field.name)
        if value is not None or not field.optional:
            if field.per == "splat" and "splat" not in counts:
                counts["splat"] = owner.count_splats(field.name)
            array = checked_array(field.name, value, field.dtype, field.shape(counts))
            object.__setattr__(owner, field.name, array)
            counts.setdefault(field.per, len(array))
    return counts


def check_indices(name: str, indices: np.ndarray, count: int, of: str) -> None:
    """ValueError unless all int32 ``indices`` lie in [0, count)."""
    if indices.size and (indices.min() < 0 or indices.max() >= count):
        raise ValueError(
            f"{name} must be indices of the {count:,} {of}, from 0, got {indices.min()} to {indices.max()}"
        )
