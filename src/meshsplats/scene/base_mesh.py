"""BaseMesh: the classical mesh under a mesh prior, with vertex colours and textures if it has them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from meshsplats._common.arrays import checked_array, guarded
from meshsplats.errors import warn_of_data
from meshsplats.scene.binding import check_indices
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.scene.origin import in_words, lost_by_rounding, relative, zero_origin

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Wrap = Literal["repeat", "mirror", "clamp"]


@dataclass(frozen=True, eq=False)
class Texture:
    """An image that is mapped onto a mesh."""

    pixels: np.ndarray
    """(h, w, 4) uint8 display RGBA; row 0 lies at v = 0."""
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    """Behaviour beyond 0 and 1 along u and v."""
    factor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Linear RGBA, multiplied with the pixels."""

    def __post_init__(self) -> None:
        shape = np.shape(self.pixels)
        if len(shape) != 3 or shape[2] != 4 or 0 in shape or self.pixels.dtype != np.uint8:
            raise ValueError(f"pixels must be (h, w, 4) uint8, got {shape} {self.pixels.dtype}")
        if any(mode not in get_args(Wrap) for mode in self.wrap):
            raise ValueError(f"wrap must be two of {', '.join(get_args(Wrap))}, got {self.wrap}")

    def at(self, uv: np.ndarray) -> np.ndarray:
        """(k, 4) float32 display RGBA at ``uv`` (k, 2), bilinear between the centres of pixels."""
        sides = self.pixels.shape[1], self.pixels.shape[0]
        places, shares = [], []
        for axis, side in enumerate(sides):
            at = np.asarray(uv[:, axis], np.float64) * side - 0.5
            first = np.floor(at)
            shares.append((at - first)[:, None])
            places.append([self.wrapped(first + step, side, self.wrap[axis]) for step in (0, 1)])
        rows = [
            self.pixels[places[1][j], places[0][0]] * (1 - shares[0])
            + self.pixels[places[1][j], places[0][1]] * shares[0]
            for j in (0, 1)
        ]
        color = ((rows[0] * (1 - shares[1]) + rows[1] * shares[1]) / 255).astype(np.float32)
        if self.factor != (1.0, 1.0, 1.0, 1.0):
            factor = np.array(self.factor, np.float32)
            color[:, :3] = linear_to_srgb(srgb_to_linear(color[:, :3]) * factor[:3])
            color[:, 3] *= factor[3]
        return np.clip(color, 0, 1)

    @staticmethod
    def wrapped(index: np.ndarray, side: int, mode: Wrap) -> np.ndarray:
        """int64 pixels that whole numbers ``index`` stand for along a side of ``side`` pixels."""
        if mode == "clamp":
            return np.clip(index, 0, side - 1).astype(np.int64)
        if mode == "mirror":
            inside = np.mod(index, 2 * side)
            return np.minimum(inside, 2 * side - 1 - inside).astype(np.int64)
        return np.mod(index, side).astype(np.int64)


@guarded
@dataclass(frozen=True, eq=False)
class BaseMesh:
    """n vertices and m triangles. The constructor checks and converts the arrays. float64 vertices whose
    detail float32 would lose are told of by a DataWarning: give ``origin``."""

    vertices: np.ndarray
    """(n, 3) float32 positions relative to ``origin``."""
    faces: np.ndarray
    """(m, 3) int32 vertex indices."""
    colors: np.ndarray | None = None
    """(n, 4) float32 straight display RGBA in [0, 1]; None: the mesh has no vertex colours."""
    uv: np.ndarray | None = None
    """(m, 3, 2) float32 texture coordinates at the corners of each face, u to the right, v down."""
    face_texture: np.ndarray | None = None
    """(m,) int32 index of each face's texture; -1: none."""
    textures: tuple[Texture, ...] = field(default=())
    normal_map: np.ndarray | None = None
    """(h, w, 3) uint8 normals in the tangent space of ``uv``, for a mesh with one texture: -1 to 1 along u,
    against v and along the smooth normal as 0 to 255, as in glTF; None: the smooth normals alone."""
    up: np.ndarray = field(default_factory=lambda: np.array([0, 1, 0], np.float32))
    """(3,) float32 direction that points up."""
    origin: np.ndarray = field(default_factory=zero_origin)
    """(3,) float64 point of the world that ``vertices`` are relative to: world = origin + vertices."""
    tints: np.ndarray | None = None
    """(n, 4) float32 linear RGBA in [0, 1] of the vertices, by which the textures are multiplied, as COLOR_0
    of glTF; None: textures are as they are."""

    def __repr__(self) -> str:
        parts = [f"{len(self.vertices):,} vertices", f"{len(self.faces):,} faces"]
        parts += ["colours"] if self.colors is not None else []
        parts += [f"{len(self.textures)} textures"] if self.textures else []
        parts += ["tints"] if self.tints is not None else []
        parts += ["normal map"] if self.normal_map is not None else []
        parts += [f"origin {in_words(self.origin)}"] if self.origin.any() else []
        return f"BaseMesh({', '.join(parts)})"

    def __post_init__(self) -> None:
        vertices = checked_array("vertices", self.vertices, np.float32, (None, 3))
        warn_of_data(lost_by_rounding("vertices", self.vertices))
        faces = checked_array("faces", self.faces, np.int32, (None, 3))
        check_indices("faces", faces, len(vertices), "vertices")
        arrays = {"vertices": vertices, "faces": faces, "up": checked_array("up", self.up, np.float32, (3,))}
        if not arrays["up"].any():
            raise ValueError("up must not be the zero vector")
        arrays["origin"] = checked_array("origin", self.origin, np.float64, (3,))
        m = len(faces)
        for name, given in (("colors", self.colors), ("tints", self.tints)):
            if given is not None:
                colors = checked_array(name, given, np.float32, (len(vertices), 4))
                if len(colors) and (colors.min() < 0 or colors.max() > 1):
                    extent = f"{colors.min():.4g} to {colors.max():.4g}"
                    raise ValueError(f"{name} must lie in [0, 1], got {extent}")
                arrays[name] = colors
        if (self.uv is None) != (self.face_texture is None):
            raise ValueError("uv and face_texture must be given together")
        if self.uv is not None and self.face_texture is not None:
            arrays["uv"] = checked_array("uv", self.uv, np.float32, (m, 3, 2))
            index = checked_array("face_texture", self.face_texture, np.int32, (m,))
            if m and not (index.min() >= -1 and index.max() < len(self.textures)):
                raise ValueError(
                    f"face_texture must be indices of the {len(self.textures)} textures, from 0, or -1,"
                    f" got {index.min()} to {index.max()}"
                )
            arrays["face_texture"] = index
        for name in ("normal_map", "tints"):
            if getattr(self, name) is not None and self.uv is None:
                raise ValueError(f"{name} needs uv")
        if self.normal_map is not None:
            arrays["normal_map"] = checked_array("normal_map", self.normal_map, np.uint8, (None, None, 3))
        for name, value in arrays.items():
            object.__setattr__(self, name, value)

    def relative_to(self, origin: ArrayLike) -> BaseMesh:
        """The same mesh in the world, with coordinates relative to ``origin`` (3,). A DataWarning says where
        that is too far for their detail."""
        point = checked_array("origin", origin, np.float64, (3,))
        if (point == self.origin).all():
            return self
        return replace(self, vertices=relative(self.vertices, self.origin, point), origin=point)

    @property
    def textured(self) -> bool:
        """Whether any face has a texture."""
        return self.face_texture is not None and bool((self.face_texture >= 0).any())

    def textured_faces(self) -> np.ndarray:
        """(m,) bool."""
        return np.zeros(len(self.faces), bool) if self.face_texture is None else self.face_texture >= 0

    def vertex_colors_at(self, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(k, 4) float32 display RGBA of the vertex colours, interpolated at k points.

        Args:
            face: (k,) face indices.
            weights: (k, 3) barycentric coordinates there.

        Only for a mesh with vertex colours.
        """
        assert self.colors is not None
        mixed = np.einsum("kc,kcj->kj", weights.astype(np.float64), self.colors[self.faces[face]])
        return np.clip(mixed, 0, 1).astype(np.float32)

    def colors_at(self, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(k, 4) float32 display RGBA at points on ``face`` (k,) with barycentric ``weights`` (k, 3): of the
        textures, on faces without one of the vertex colours, else opaque mid grey."""
        rgba = self.texture_at(face, weights)
        untextured = ~self.textured_faces()[face]
        if self.colors is not None and untextured.any():
            rgba[untextured] = self.vertex_colors_at(face[untextured], weights[untextured])
        return rgba

    def texture_at(self, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(k, 4) float32 display RGBA of the textures, with their tints, at points on ``face`` (k,) with
        barycentric ``weights`` (k, 3); opaque mid grey on faces without a texture."""
        result = np.full((len(face), 4), 0.5, np.float32)
        result[:, 3] = 1
        if self.uv is None or self.face_texture is None:
            return result
        uv = np.einsum("kc,kcj->kj", weights.astype(np.float64), self.uv[face].astype(np.float64))
        for index, texture in enumerate(self.textures):
            here = self.face_texture[face] == index
            if here.any():
                result[here] = texture.at(uv[here])
        if self.tints is not None:
            corners = self.tints[self.faces[face]]
            # White changes nothing, not even by rounding.
            rows = np.flatnonzero(self.textured_faces()[face] & (corners != 1).any(axis=(1, 2)))
            tint = np.einsum("kc,kcj->kj", weights[rows].astype(np.float64), corners[rows])
            tint = np.clip(tint, 0, 1).astype(np.float32)
            result[rows, :3] = linear_to_srgb(srgb_to_linear(result[rows, :3]) * tint[:, :3])
            result[rows, 3] *= tint[:, 3]
        return result
