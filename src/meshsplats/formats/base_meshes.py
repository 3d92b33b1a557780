"""Base meshes for a mesh prior: any mesh file, with the textures that ``load_mesh`` leaves out."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshsplats._kinds import need_path
from meshsplats.base_mesh import BaseMesh, Texture
from meshsplats.errors import FileFormatError, NoColorsWarning, NoTextureWarning
from meshsplats.formats.content import Content
from meshsplats.formats.gltf.textures import gltf_textures
from meshsplats.formats.meshes import load_mesh
from meshsplats.formats.obj.textures import obj_coordinates, obj_textures
from meshsplats.mesh import SplatMesh


def load_base(
    path: str | os.PathLike[str],
    *,
    texture: str | os.PathLike[str] | None = None,
    textures: bool = True,
    origin: Sequence[float] | np.ndarray | None = None,
) -> BaseMesh:
    """The mesh in a file that ``load_mesh`` reads, with its vertex colours, if it has any, and textures.

    Vertices and triangles are those of ``load_mesh``. Textures are read from glTF (base colour) and from the
    material library beside an `.obj` (``map_Kd``); image files must lie in the folder of the mesh or below.
    Faces whose texture is missing or of an unknown kind count as untextured, with a DataWarning.

    Args:
        path: the mesh.
        texture: an image to use for the whole mesh instead, by its texture coordinates (`.obj`, glTF).
        textures: False leaves textures unread.
        origin: as for ``load_mesh``.

    Raises:
        FileFormatError: as ``load_mesh``, for a mesh prior, and for broken images and materials.
        ValueError: ``texture`` is given, but the mesh has no texture coordinates.
    """
    need_path(path=path)
    source = Path(path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = load_mesh(source, origin=origin)
    if mesh.binding is not None:
        raise FileFormatError(
            f"{source}: splats that are bound to a mesh, not the mesh that carries them: give that one"
        )
    uncolored = False
    for warning in caught:
        uncolored |= issubclass(warning.category, NoColorsWarning)
        if not issubclass(warning.category, (NoColorsWarning, NoTextureWarning)):
            warnings.warn(warning.message, stacklevel=2)
    colors = None if uncolored else _display(mesh)
    base = BaseMesh(mesh.vertices, mesh.faces, colors, up=mesh.up, origin=mesh.origin)
    if not textures:
        return base
    override = None if texture is None else Texture(read_texture(Path(texture)))
    found = _textured(source, override)
    if found is None or not (found[1] >= 0).any():
        if override is not None:
            raise ValueError(f"{source}: has no texture coordinates, so {texture} cannot be put on it")
        return base
    uv, index, images = found
    if len(uv) != len(base.faces):
        raise FileFormatError(
            f"{source}: {len(uv):,} faces with texture coordinates, {len(base.faces):,} in all"
        )
    return replace(base, uv=uv, face_texture=index, textures=images)


def read_texture(path: Path, data: bytes | None = None) -> np.ndarray:
    """(h, w, 4) uint8 RGBA of an image file, or of ``data`` inside the file ``path``."""
    from meshsplats.images.reading import load_image

    pixels = load_image(path, data)
    opaque = np.full((*pixels.shape[:2], 4 - pixels.shape[2]), 255, np.uint8)
    return np.concatenate([pixels, opaque], axis=2)


def _display(mesh: SplatMesh) -> np.ndarray:
    """(n, 4) display RGBA of a SplatMesh."""
    from meshsplats.colors import linear_to_srgb

    if mesh.blending == "display":
        return mesh.colors
    return np.column_stack([np.clip(linear_to_srgb(mesh.colors[:, :3]), 0, 1), mesh.colors[:, 3]])


def _textured(
    path: Path, override: Texture | None
) -> tuple[np.ndarray, np.ndarray, tuple[Texture, ...]] | None:
    """Coordinates (m, 3, 2), v down, texture index (m,) of each face, and textures; None without any."""
    content = Content(path)
    if content.container in ("glb", "json"):
        return gltf_textures(path, read_texture, override)
    if content.container in ("ply", "usd") or not content.is_obj:
        return None
    found = obj_coordinates(path)
    if found is None:
        return None
    uv, complete, material, libraries = found
    if override is not None:
        return uv, np.where(complete, 0, -1).astype(np.int32), (override,)
    index, images = obj_textures(path, libraries, material, read_texture)
    return uv, np.where(complete, index, -1).astype(np.int32), images
