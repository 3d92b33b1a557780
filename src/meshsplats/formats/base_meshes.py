"""Base meshes for a mesh prior: any mesh file, with the textures that ``load_mesh`` leaves out."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np

from meshsplats.base_mesh import BaseMesh, Texture
from meshsplats.errors import FileFormatError, NoColorsWarning, NoTextureWarning
from meshsplats.formats.gltf.textures import gltf_textures
from meshsplats.formats.meshes import load_mesh
from meshsplats.formats.obj.textures import obj_coordinates, obj_textures
from meshsplats.formats.sniff import Content


def load_base(
    path: str | os.PathLike[str],
    *,
    texture: str | os.PathLike[str] | None = None,
    textures: bool = True,
) -> BaseMesh:
    """The mesh in a file that ``load_mesh`` reads, with its vertex colours, if it has any, and textures.

    Vertices and triangles are those of ``load_mesh``. Textures are read from glTF (base colour) and, by the
    material library beside it, from `.obj` (``map_Kd``); picture files must lie in the folder of the mesh or
    below.

    Args:
        path: the mesh.
        texture: a picture that is laid on the whole mesh instead, by its texture coordinates (`.obj`, glTF).
        textures: False leaves them unread.

    Raises what ``load_mesh`` raises, FileFormatError for a mesh prior and for broken pictures and materials,
    and ValueError where ``texture`` is given and the mesh has no texture coordinates. Warns with a
    DataWarning where a texture is missing or of a kind that is not read: those faces count as untextured.
    """
    source = Path(path)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        mesh = load_mesh(source)
    if mesh.binding is not None:
        raise FileFormatError(
            f"{source}: splats that are bound to a mesh, not the mesh that carries them: give that one"
        )
    bare = False
    for warning in told:
        bare |= issubclass(warning.category, NoColorsWarning)
        if not issubclass(warning.category, (NoColorsWarning, NoTextureWarning)):
            warnings.warn(warning.message, stacklevel=2)
    base = BaseMesh(mesh.vertices, mesh.faces, None if bare else _display(mesh), up=mesh.up)
    if not textures:
        return base
    laid = None if texture is None else Texture(read_texture(Path(texture)))
    found = _textured(source, laid)
    if found is None or not (found[1] >= 0).any():
        if laid is not None:
            raise ValueError(f"{source}: has no texture coordinates by which to lay {texture} on it")
        return base
    uv, number, pictures = found
    if len(uv) != len(base.faces):
        raise FileFormatError(
            f"{source}: {len(uv):,} faces with texture coordinates, {len(base.faces):,} in all"
        )
    return BaseMesh(base.vertices, base.faces, base.colors, uv, number, pictures, base.up)


def read_texture(path: Path, data: bytes | None = None) -> np.ndarray:
    """(h, w, 4) uint8 RGBA of an image file, or of ``data`` inside the file ``path``."""
    from meshsplats.images.reading import load_image

    pixels = load_image(path, data)
    opaque = np.full((*pixels.shape[:2], 4 - pixels.shape[2]), 255, np.uint8)
    return np.concatenate([pixels, opaque], axis=2)


def _display(mesh) -> np.ndarray:
    """(n, 4) display RGBA of a SplatMesh."""
    from meshsplats.colors import linear_to_srgb

    if mesh.blending == "display":
        return mesh.colors
    return np.column_stack([np.clip(linear_to_srgb(mesh.colors[:, :3]), 0, 1), mesh.colors[:, 3]])


def _textured(path: Path, laid: Texture | None) -> tuple[np.ndarray, np.ndarray, tuple[Texture, ...]] | None:
    """Coordinates (m, 3, 2), v down, texture of each face (m,) and textures; None where there are none."""
    content = Content(path)
    if content.container in ("glb", "json"):
        return gltf_textures(path, read_texture, laid)
    if content.container in ("ply", "usd") or not content.is_obj:
        return None
    found = obj_coordinates(path)
    if found is None:
        return None
    uv, complete, material, libraries = found
    if laid is not None:
        return uv, np.where(complete, 0, -1).astype(np.int32), (laid,)
    number, pictures = obj_textures(path, libraries, material, read_texture)
    return uv, np.where(complete, number, -1).astype(np.int32), pictures
