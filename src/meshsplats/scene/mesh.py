"""SplatMesh: translucent vertex-coloured triangles, the representation that all steps share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np

from meshsplats._common.arrays import check_faces, checked_array, checked_attributes, chosen_rows, guarded
from meshsplats._common.kinds import need_all, need_choice
from meshsplats.errors import warn_of_data
from meshsplats.scene.binding import ArrayField, Binding, check_fields
from meshsplats.scene.face_splats import FaceSplats, check_ascending, check_harmonics
from meshsplats.scene.joining import joined_meshes
from meshsplats.scene.moving import moved_mesh, transformed_mesh
from meshsplats.scene.order import Order, checked_order
from meshsplats.scene.origin import in_words, lost_by_rounding, relative, zero_origin
from meshsplats.scene.spherical_harmonics import TERMS, degree_of

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Blending = Literal["display", "linear"]

MAX_FILTER_PX2 = 100.0
"""Largest ``filter_px2``."""

MAX_COLOR = 16
"""Largest display colour of a vertex. White is 1."""

MIN_TRANSMITTANCE = 1e-6
"""Early termination: a sample stops once its transmittance is below this. The error stays below it, too."""


class Triangles(NamedTuple):
    """What renderers take of a mesh, as one record: arrays as in ``SplatMesh``, C-contiguous. None is
    checked, because a step of an optimisation must not look at every triangle."""

    vertices: np.ndarray
    """(v, 3) float32"""
    faces: np.ndarray
    """(f, 3) int32"""
    colors: np.ndarray
    """(v, 4) float32"""
    values: np.ndarray | None = None
    """(v, k) float32 further values to interpolate and blend as colours are."""
    normals: np.ndarray | None = None
    """(v, 3) float32"""
    face_splat: np.ndarray | None = None
    """(f,) int32"""
    depth_group: np.ndarray | None = None
    """(f,) int32"""
    harmonics: np.ndarray | None = None
    """(s, k, 3) float32"""
    filter_px2: float = 0.0
    order: Order = "fragment"


@guarded
@dataclass(frozen=True, eq=False)
class SplatMesh:
    """V vertices and F triangles. The constructor checks and converts the arrays (C-contiguous). Those that
    need no conversion are kept, not copied: what is written into them later is in the mesh, unchecked, and in
    all that share them. ``dataclasses.replace(mesh, colors=...)`` is another mesh with other colours. float64
    vertices whose detail float32 would lose are told of by a DataWarning: give ``origin``.

    Concretely, ``colors[faces[j, k]]`` is the straight (not premultiplied) RGBA at corner k of triangle j;
    inside a triangle RGBA is interpolated with perspective-correct barycentric weights.
    """

    vertices: np.ndarray
    """(v, 3) float32 positions relative to ``origin``, along the axes of the world frame, scene units."""
    faces: np.ndarray
    """(f, 3) int32 vertex indices. Triangles are visible from both sides."""
    colors: np.ndarray
    """(v, 4) float32 straight RGBA, opacity in [0, 1]. RGB is at least 0 and may be above 1: what is brighter
    than white shows through faint layers."""
    face_splat: np.ndarray | None = None
    """(f,) int32 index of the splat that each triangle was made from, ascending; None for a mesh of other
    origin."""
    normals: np.ndarray | None = None
    """(v, 3) float32 unit shading normals, or None."""
    depth_group: np.ndarray | None = None
    """(f,) int32: triangles with the same value >= 0 are coplanar layers that share one depth, that of their
    common plane, and are ordered by face index; -1 keeps a triangle's own depth."""
    harmonics: np.ndarray | None = None
    """(s, k, 3) float32 spherical harmonics of each splat, which make its colour depend on the view: k is 3,
    8 or 15, for degree 1, 2 or 3. Row i belongs to splat i of ``splats``, whose vertices have the colour
    ``max(0, colors[:, :3] + sh_basis(d, degree)[:, 1:] @ harmonics[i])`` along the direction d from the
    camera. None: colours are the same from everywhere."""
    plain_colors: np.ndarray | None = None
    """(v, 3) float32 RGB in [0, 1] for programs that draw no harmonics: the mean of what views show. None:
    ``colors``."""
    up: np.ndarray = field(default_factory=lambda: np.array([0, -1, 0], np.float32))
    """(3,) float32 direction that points up in the world frame, normalised by the constructor; splats trained
    from COLMAP cameras have y down."""
    blending: Blending = "display"
    """Colour space for blending: 'display' (sRGB-encoded, as splats are) or 'linear'."""
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Further float32 arrays (v,) or (v, c) by name, one row for each vertex."""
    filter_px2: float = 0.0
    """Variance in square pixels, 0 to 100, of the low-pass filter that ``render`` applies to the triangles of
    each splat, as splat renderers do; 0: none. Needs ``face_splat``."""
    order: Order = "fragment"
    """What is sorted: 'fragment', triangles at every sample, or 'splat', whole splats by their centres, as
    splat renderers do. 'splat' needs ``face_splat``."""
    binding: Binding | None = None
    """For a mesh prior: where the vertices lie on the faces of its base mesh, each triangle on one face."""
    origin: np.ndarray = field(default_factory=zero_origin)
    """(3,) float64 point of the world that ``vertices`` are relative to: world = origin + vertices."""

    FIELDS: ClassVar[tuple[ArrayField, ...]] = (
        ArrayField("vertices", np.float32, "vertex", 3),
        ArrayField("faces", np.int32, "face", 3),
        ArrayField("colors", np.float32, "vertex", 4),
        ArrayField("up", np.float32, "mesh", 3),
        ArrayField("normals", np.float32, "vertex", 3, optional=True),
        ArrayField("face_splat", np.int32, "face", optional=True),
        ArrayField("depth_group", np.int32, "face", optional=True),
        ArrayField("harmonics", np.float32, "splat", (None, 3), optional=True),
        ArrayField("plain_colors", np.float32, "vertex", 3, optional=True),
    )
    EXTRAS: ClassVar[tuple[ArrayField, ...]] = tuple(f for f in FIELDS if f.optional and f.name != "normals")
    """The optional arrays that formats of other programs have no place for. Those of vertices and splats are
    float32, those of faces single integers."""

    def __post_init__(self) -> None:
        given = self.vertices
        counts = check_fields(self)
        warn_of_data(lost_by_rounding("vertices", given))
        v, f, faces = counts["vertex"], counts["face"], self.faces
        check_faces(faces, v)
        if v and (self.colors.min() < 0 or self.colors.max() > MAX_COLOR):
            low, high = self.colors.min(), self.colors.max()
            todo = "; divide bytes by 255" if high > MAX_COLOR else ""
            raise ValueError(f"colors must lie in [0, {MAX_COLOR}], got {low:.4g} to {high:.4g}{todo}")
        if v and (opacity := self.colors[:, 3].max()) > 1:
            raise ValueError(f"opacities, the last column of colors, must lie in [0, 1], got {opacity:.4g}")
        if self.harmonics is not None:
            if self.harmonics.shape[1] not in TERMS:
                raise ValueError(
                    "harmonics must have 3, 8 or 15 coefficients for degree 1, 2 or 3, without the constant"
                    f" one, got shape {self.harmonics.shape}"
                )
            check_harmonics(self.blending, self.splats)
        plain = self.plain_colors
        if plain is not None and v and (plain.min() < 0 or plain.max() > 1):
            raise ValueError(f"plain_colors must lie in [0, 1], got {plain.min():.4g} to {plain.max():.4g}")

        def set_(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        set_("origin", checked_array("origin", self.origin, np.float64, (3,)))
        check_ascending(self.face_splat)
        group = self.depth_group
        if group is not None and f and group.min() < -1:
            raise ValueError(f"depth_group must be >= 0, or -1 for none, got {group.min()}")
        length = float(np.linalg.norm(self.up.astype(np.float64)))
        if length == 0:
            raise ValueError("up must not be the zero vector")
        # Not rescaled within 1e-6 of unit length: files round-trip bit for bit.
        set_("up", self.up if abs(length - 1) <= 1e-6 else (self.up / length).astype(np.float32))
        need_choice(Blending, blending=self.blending)
        set_("filter_px2", checked_filter(self.filter_px2, self.face_splat))
        checked_order(self.order, self.face_splat)
        set_("attributes", MappingProxyType(checked_attributes(self.attributes, v)))
        if self.binding is not None:
            if len(self.binding.vertex_face) != v:
                raise ValueError(f"binding must bind {v} vertices, it binds {len(self.binding.vertex_face)}")
            face = self.binding.vertex_face[faces]
            if (face != face[:, :1]).any():
                raise ValueError("all corners of a triangle must be bound to one face of the base")

    def count_splats(self, name: str) -> int:
        """Count of splats, for the array ``name`` that has a row for each. ValueError without splats."""
        if self.face_splat is None:
            raise ValueError(f"{name} has a row for each splat: give face_splat, too")
        check_ascending(self.face_splat)
        return len(self.splats)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"attributes": dict(self.attributes)}  # a view of a dictionary cannot be copied

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, attributes=MappingProxyType(state["attributes"]))

    def __repr__(self) -> str:
        parts = [f"{len(self.vertices):,} vertices", f"{len(self.faces):,} triangles"]
        if self.splat_count is not None:
            parts.append(f"{self.splat_count:,} splats")
        parts += [f"blending {self.blending!r}", *(f"attribute {name!r}" for name in self.attributes)]
        parts += [f"colours of degree {self.sh_degree}"] if self.sh_degree else []
        parts += ["normals"] if self.normals is not None else []
        parts += ["bound to a base"] if self.binding is not None else []
        parts += [f"order {self.order!r}"] if self.order != "fragment" else []
        parts += [f"origin {in_words(self.origin)}"] if self.origin.any() else []
        return f"SplatMesh({', '.join(parts)})"

    @property
    def triangles(self) -> Triangles:
        """What renderers take; without ``attributes``."""
        return Triangles(
            self.vertices,
            self.faces,
            self.colors,
            normals=self.normals,
            face_splat=self.face_splat,
            depth_group=self.depth_group,
            harmonics=self.harmonics,
            filter_px2=self.filter_px2,
            order=self.order,
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """The contents of the mesh by name: its fields, ``attribute.NAME`` and ``binding.NAME``.

        ``blending`` and ``order`` (texts) and ``filter_px2`` are arrays without dimensions. Optional arrays
        that are None, a filter of 0, the order by the fragment and an origin of zeros are left out.
        """
        arrays = {f.name: getattr(self, f.name) for f in self.FIELDS if not f.optional}
        arrays["blending"] = np.array(self.blending)
        arrays |= {} if self.order == "fragment" else {"order": np.array(self.order)}
        optional = {f.name: getattr(self, f.name) for f in self.FIELDS if f.optional}
        arrays |= {name: value for name, value in optional.items() if value is not None}
        if self.filter_px2:
            arrays["filter_px2"] = np.array(self.filter_px2)
        if self.origin.any():
            arrays["origin"] = self.origin
        arrays |= {f"attribute.{name}": value for name, value in self.attributes.items()}
        if self.binding is not None:
            arrays |= {f"binding.{name}": value for name, value in self.binding.arrays().items()}
        return arrays

    def extras(self) -> dict[ArrayField, np.ndarray]:
        """Those of ``EXTRAS`` that are not None."""
        return {f: value for f in self.EXTRAS if (value := getattr(self, f.name)) is not None}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> SplatMesh:
        """The inverse of ``arrays``; unknown names are ignored.

        Raises:
            KeyError: an array is missing; a binding with some of its arrays needs all.
            ValueError, TypeError: as the constructor.
        """
        bound = any(name.startswith("binding.") for name in arrays)
        prefix = "attribute."
        return cls(
            **{f.name: arrays[f.name] for f in cls.FIELDS if f.name in arrays or not f.optional},
            blending=str(arrays["blending"]),  # type: ignore[arg-type]
            filter_px2=float(arrays.get("filter_px2", 0.0)),
            order=str(arrays.get("order", "fragment")),  # type: ignore[arg-type]
            origin=arrays.get("origin", zero_origin()),
            attributes={name[len(prefix) :]: a for name, a in arrays.items() if name.startswith(prefix)},
            binding=Binding.from_arrays(arrays, "binding.") if bound else None,
        )

    @property
    def splat_count(self) -> int | None:
        """Count of splats with at least one triangle; None without ``face_splat``."""
        if self.face_splat is None:
            return None
        return len(self.splats)

    @property
    def sh_degree(self) -> int:
        """Degree of ``harmonics``, 1 to 3; 0: colours are the same from everywhere."""
        return 0 if self.harmonics is None else degree_of(self.harmonics)

    def of_degree(self, degree: int) -> SplatMesh:
        """The mesh with its harmonics up to ``degree``, 0 to 3. Without any, colours are limited to 1, as
        those of splats are."""
        if not 0 <= degree <= 3:
            raise ValueError(f"degree must be 0, 1, 2 or 3, got {degree}")
        if self.harmonics is None or degree >= self.sh_degree:
            return self
        if degree:
            return replace(self, harmonics=self.harmonics[:, : TERMS[degree - 1]])
        return replace(self, harmonics=None, plain_colors=None, colors=np.minimum(self.colors, 1))

    @property
    def plain(self) -> SplatMesh:
        """The mesh as programs that draw no harmonics should show it: with ``plain_colors`` and opacities, in
        [0, 1]."""
        if self.harmonics is None and self.plain_colors is None:
            bright = len(self.colors) and self.colors.max() > 1
            return replace(self, colors=np.minimum(self.colors, 1)) if bright else self
        rgb = self.colors[:, :3] if self.plain_colors is None else self.plain_colors
        colors = np.concatenate([np.minimum(rgb, 1), self.colors[:, 3:]], axis=1)
        return replace(self, colors=colors, harmonics=None, plain_colors=None)

    @property
    def splats(self) -> FaceSplats:
        """Which triangles and vertices belong to which splat; without ``face_splat``, each triangle counts as
        one. Found anew at each access, and as large as the mesh: hold it while it is used."""
        return FaceSplats(self.faces, self.face_splat, len(self.vertices))

    def relative_to(self, origin: ArrayLike) -> SplatMesh:
        """The same mesh in the world, with coordinates relative to ``origin`` (3,), also of its base. A
        DataWarning says where that is too far for their detail."""
        point = checked_array("origin", origin, np.float64, (3,))
        if (point == self.origin).all():
            return self
        binding = self.binding
        if binding is not None:
            binding = binding.moved(relative(binding.base_vertices, self.origin, point), binding.lift)
        vertices = relative(self.vertices, self.origin, point)
        return replace(self, vertices=vertices, binding=binding, origin=point)

    def take(self, faces: ArrayLike | slice) -> SplatMesh:
        """The chosen triangles with everything that belongs to them, and without vertices that none uses.

        Args:
            faces: a mask (f,) bool, indices in any order, or a slice; ``slice(None)`` drops unused vertices.

        Raises ValueError where ``face_splat`` would no longer ascend: an order of triangles that mixes splats
        needs a mesh without it.
        """
        rows = chosen_rows(faces, len(self.faces), "triangles")
        return self.with_faces(np.take(self.faces, rows, axis=0), rows)

    def with_faces(self, faces: np.ndarray, source: np.ndarray) -> SplatMesh:
        """The mesh with other triangles on its vertices, without vertices that none of them uses.

        Args:
            faces: (n, 3) int vertex indices.
            source: (n,) triangles of this mesh whose splat and depth group they take over.
        """
        used = np.zeros(len(self.vertices), bool)
        used[faces.ravel()] = True
        renumber = np.cumsum(used, dtype=np.int32) - 1
        rows = {"vertex": np.flatnonzero(used), "face": source}
        if any(f.per == "splat" and getattr(self, f.name) is not None for f in self.FIELDS):
            rows["splat"] = (own := self.splats.of_face[source])[np.diff(own, prepend=-1) > 0]
        return replace(self, **self.rows(**rows), faces=np.take(renumber, faces))

    def vertices_of(self, faces: np.ndarray) -> np.ndarray:
        """(v,) bool: the vertices that any of the triangles ``faces`` uses, a mask or indices."""
        used = np.zeros(len(self.vertices), bool)
        used[self.faces[faces].ravel()] = True
        return used

    def rows(self, **rows: np.ndarray) -> dict[str, Any]:
        """Arguments for ``replace``: those rows, by index, of every array that has one for each ``vertex``,
        ``face`` or ``splat``, but ``faces``, which number vertices anew where these change."""
        # np.take is several times as fast as indexing on rows as short as these.
        found: dict[str, Any] = {
            f.name: np.take(value, rows[f.per], axis=0)
            for f in self.FIELDS
            if f.per in rows and f.name != "faces" and (value := getattr(self, f.name)) is not None
        }
        if "vertex" in rows:
            own = rows["vertex"]
            found["attributes"] = {name: np.take(a, own, axis=0) for name, a in self.attributes.items()}
            found["binding"] = None if self.binding is None else self.binding.take(own)
        return found

    @staticmethod
    def joined(parts: Sequence[SplatMesh], *, same_splats: bool = False) -> SplatMesh:
        """One mesh of all ``parts``, at least one, vertices and triangles one part behind the other.

        The parts must agree in ``blending``, ``filter_px2``, ``order``, their base, and in which optional
        arrays and attributes they have; only ``depth_group`` and ``plain_colors`` may be missing in some, and
        harmonics, which are 0 then. ``up`` is the first's, from which others differ by less than 45 degrees.
        Positions are relative to the first ``origin`` that is not zero; a DataWarning says where that is too
        far for the detail of a part. Depth groups stay apart.

        Args:
            parts: the meshes.
            same_splats: ``face_splat`` of all parts are indices of one scene, which are kept; triangles are
                sorted by them. By default each part has splats of its own, and all are counted from 0.

        Raises ValueError, which names the part, where they do not agree, for bases that differ, and for more
        vertices or triangles than int32 can number.
        """
        need_all(SplatMesh, parts=parts)
        return joined_meshes(parts, same_splats=same_splats)

    def moved(
        self, vertices: ArrayLike, *, normals: ArrayLike | None = None, binding: Binding | None = None
    ) -> SplatMesh:
        """The mesh with its vertices at (v, 3) ``vertices``, as after an edit, a pose or a simulation.

        What has a direction turns with the splats (without ``face_splat``, with the triangles): normals and
        harmonics, by the rotation that fits best how the corners of a splat have moved. So this is for
        motions; ``transformed`` mirrors.

        Args:
            vertices: the new positions, relative to ``origin``.
            normals: (v, 3) those of the moved surface, where they are known.
            binding: where the new positions lie on a base; None: on none.

        Raises ValueError for another number of vertices, or positions that are not finite.
        """
        return moved_mesh(self, vertices, normals, binding)

    def transformed(self, matrix: ArrayLike, *, origin: ArrayLike | None = None) -> SplatMesh:
        """The mesh after the affine map ``matrix`` of the world: moved, turned, scaled, mirrored.

        Concretely, a vertex v of the world goes to A v + t. Colours seen from direction d become
        those seen from U^T d, where U is the orthogonal factor of A, and ``up`` turns by U. A mirror reverses
        the order of the corners, so that normals stay outside. A binding to a base stays, but for one with
        layers above it and a map that is no similarity; a DataWarning says so.

        Args:
            matrix: (4, 4) [[A, t], [0, 1]], (3, 4) [A, t], or (3, 3) A.
            origin: (3,) float64, of the result; None: A times that of the mesh. Where t is so large that
                float32 would lose the detail of the vertices, it goes to the origin instead.

        Raises ValueError for another shape or last row, and for a matrix that is singular or not finite.
        """
        return transformed_mesh(self, matrix, origin)

    def prune(self, min_opacity: float) -> SplatMesh:
        """The mesh without triangles all of whose corners have less than ``min_opacity``, and without the
        vertices that no triangle then uses."""
        return self.take((self.colors[self.faces, 3] >= min_opacity).any(axis=1))


def checked_filter(px2: float, face_splat: np.ndarray | None) -> float:
    """``px2`` as the filter variance of a mesh with that ``face_splat``.

    Raises ValueError if it is out of range, or above 0 without ``face_splat``.
    """
    number = isinstance(px2, (int, float, np.integer, np.floating)) and not isinstance(px2, bool)
    if not number or not 0 <= px2 <= MAX_FILTER_PX2:
        raise ValueError(
            f"filter_px2 must be a variance in square pixels, 0 to {MAX_FILTER_PX2:g}, got {px2!r}"
        )
    if px2 > 0 and face_splat is None:
        raise ValueError(
            f"a filter of {px2:g} px^2 widens the triangles of each splat together, but the mesh has no"
            " face_splat: give it one, or filter_px2=0"
        )
    return float(px2)


def solid_faces(mesh: SplatMesh) -> np.ndarray:
    """(f,) bool: the triangles with three opaque corners, which a depth buffer draws exactly."""
    return (mesh.colors[mesh.faces, 3] == 1).all(axis=1)


def checked_cutoff(cutoff: float) -> float:
    """``cutoff`` as the least opacity that is drawn as opaque. Raises ValueError unless it lies in [0, 1]."""
    if not 0 <= cutoff <= 1:
        raise ValueError(f"cutoff must be an opacity from 0 to 1, got {cutoff}")
    return float(cutoff)
