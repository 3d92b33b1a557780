"""Surfaces as files want them: a vertex for each pair of a place and its texture coordinates."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from meshsplats._common.geometry import vertex_normals
from meshsplats.errors import DataWarning
from meshsplats.formats.surfaces.tangents import corner_frames
from meshsplats.images.writing import encode_image
from meshsplats.scene.base_mesh import BaseMesh, Texture, Wrap
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.scene.mesh import SplatMesh

LARGE_PNG = 1 << 20
"""Textures whose PNG is larger than this, in bytes, are written as JPEG where nothing else is asked for."""
_ROUNDING = 1e-6
"""Of texture coordinates at the edges of a texture."""


class Corners(NamedTuple):
    """A surface whose vertices have one texture coordinate each."""

    vertices: np.ndarray
    """(w, 3) float32."""
    normals: np.ndarray
    """(w, 3) float32 unit."""
    faces: np.ndarray
    """(f, 3) int32."""
    uv: np.ndarray | None
    """(w, 2) float32, v down."""
    colors: np.ndarray | None
    """(w, 4) float32 display RGBA."""
    tangents: np.ndarray | None = None
    """(w, 4) float32, for a normal map: unit vectors along u, and the sign of the bitangent."""
    tints: np.ndarray | None = None
    """(w, 4) float32 linear RGBA by which the texture is multiplied."""


def corners_of(base: BaseMesh) -> Corners:
    """The vertices of ``base``, several where charts of its texture meet, with smooth normals."""
    normals = smooth_normals(base)
    if not base.textured:
        return Corners(base.vertices, normals, base.faces, None, base.colors)
    assert base.uv is not None
    place = base.faces.ravel()
    key = np.empty((len(place), 3), np.int32)
    key[:, 0] = place
    key[:, 1:] = base.uv.reshape(-1, 2).view(np.int32)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")  # as they come, for caches of vertices
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order))
    rows = place[first[order]]
    tangents = None
    if base.normal_map is not None:
        frames = corner_frames(base.vertices, base.faces, base.uv, base.up)
        tangents = frames.signed.reshape(-1, 4)[first[order]]
    return Corners(
        base.vertices[rows],
        normals[rows],
        rank[inverse.reshape(-1)].reshape(-1, 3),
        base.uv.reshape(-1, 2)[first[order]],
        None if base.colors is None else base.colors[rows],
        tangents,
        None if base.tints is None else base.tints[rows],
    )


def smooth_normals(base: BaseMesh) -> np.ndarray:
    """(v, 3) float32 unit normals: area-weighted means of those of the triangles around each vertex."""
    return vertex_normals(base.vertices, base.faces, fallback=base.up).astype(np.float32)


def texture_file(base: BaseMesh, suffix: str | None = None) -> tuple[str, bytes]:
    """The suffix and the content of the file of the texture of ``base``: `.png`, `.jpg` or `.webp`; by
    default PNG, or JPEG of quality 95 where that is large. Alpha is left out, as surfaces are opaque."""
    pixels = opaque_pixels(base.textures[0])
    if suffix is None:
        content = encode_image("a.png", pixels)
        if len(content) <= LARGE_PNG:
            return ".png", content
        suffix = ".jpg"
    return suffix, encode_image(f"a{suffix}", pixels)


def opaque_pixels(texture: Texture) -> np.ndarray:
    """(h, w, 3) float32 display RGB of ``texture``, with its factor."""
    pixels = texture.pixels[..., :3].astype(np.float32) / 255
    if texture.factor == (1.0, 1.0, 1.0, 1.0):
        return pixels
    shown = np.clip(srgb_to_linear(pixels) * np.array(texture.factor[:3], np.float32), 0, 1)
    return linear_to_srgb(shown)


def normal_file(base: BaseMesh, suffix: str | None = None) -> tuple[str, bytes]:
    """The suffix and the content of the file of the normal map of ``base``, beside a texture of the kind
    ``suffix``: WebP with WebP, else PNG, as the errors of JPEG would be relief."""
    assert base.normal_map is not None
    suffix = suffix if suffix == ".webp" else ".png"
    return suffix, encode_image(f"a{suffix}", base.normal_map.astype(np.float32) / 255)


def has_whole_texture(base: BaseMesh) -> bool:
    """Whether one texture is on all faces."""
    return len(base.textures) == 1 and bool(base.textured_faces().all())


def check_texture(base: BaseMesh) -> None:
    """ValueError for a mesh that is not textured as a surface is: with one texture on all faces, or none."""
    if base.textured and not has_whole_texture(base):
        raise ValueError(
            f"a surface has one texture on all faces, this mesh has {len(base.textures)}, on"
            f" {int(base.textured_faces().sum()):,} of {len(base.faces):,} faces"
        )


def warn_of_tints(base: BaseMesh, target: Path) -> None:
    """DataWarning where the texture of ``base`` has tints, which the format of ``target`` does not keep."""
    if base.textured and base.tints is not None:
        warnings.warn(
            f"{target.name}: left out are the vertex colours by which the texture is multiplied, which"
            " only .glb keeps beside a texture",
            DataWarning,
            stacklevel=3,
        )


def wraps_beyond_edges(base: BaseMesh) -> set[Wrap]:
    """How the texture of ``base`` wraps along those of its sides beyond which coordinates lie."""
    assert base.uv is not None
    sides = zip(base.textures[0].wrap, base.uv.reshape(-1, 2).T, strict=True)
    return {wrap for wrap, at in sides if at.min() < -_ROUNDING or at.max() > 1 + _ROUNDING}


def plain_mesh(base: BaseMesh) -> SplatMesh:
    """``base`` as a mesh without texture: with its vertex colours, else grey."""
    colors = base.colors
    if colors is None:
        colors = np.tile(np.array([0.5, 0.5, 0.5, 1], np.float32), (len(base.vertices), 1))
    normals = smooth_normals(base)
    return SplatMesh(base.vertices, base.faces, colors, normals=normals, up=base.up, origin=base.origin)
