"""Base meshes, with their textures: any mesh file is read, and surfaces are written."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from meshsplats._common.kinds import need, need_all, need_choice, need_path
from meshsplats._common.words import legible
from meshsplats._files.atomic import atomic_path, together
from meshsplats.errors import FileFormatError, NoColorsWarning, NoTextureWarning
from meshsplats.formats.content import Content
from meshsplats.formats.gltf.textures import gltf_textures
from meshsplats.formats.meshes import load_mesh
from meshsplats.formats.npz import write_npz
from meshsplats.formats.obj.textures import obj_coordinates, obj_textures
from meshsplats.formats.ply.textures import ply_textures
from meshsplats.formats.surfaces.corners import check_texture, plain_mesh, warn_of_tints
from meshsplats.formats.surfaces.glb import write_surface_glb
from meshsplats.formats.surfaces.solids import write_3mf, write_stl
from meshsplats.formats.surfaces.text import write_surface_obj, write_surface_ply
from meshsplats.formats.surfaces.usd import write_surface_usd
from meshsplats.formats.surfaces.vertex_colors import texture_to_vertex_colors
from meshsplats.formats.usd.textures import usd_textures
from meshsplats.scene.base_mesh import BaseMesh, Texture
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh

TextureImage = Literal["png", "jpg", "webp"]
"""Kinds of image files of textures."""
Collision = Literal["drawn", "only", "convex"]
"""Whether a surface that things collide with is drawn, too; or convex parts of it collide instead."""
_BESIDE = (".obj", ".ply", ".usdc", ".usda", ".usd")
"""Formats whose texture is a file of its own."""
SHADED = (".glb", ".usdc", ".usda", ".usd", ".usdz")
"""Formats that say whether lights shade a surface, and hold cameras."""
PRINTED = (".stl", ".3mf")
"""Formats of shapes without colour."""
UNTEXTURED = (*PRINTED, ".npz")
"""Formats without a texture."""
BASE_SUFFIXES = (".glb", ".obj", ".ply", ".usdc", ".usda", ".usd", ".usdz", ".npz", *PRINTED)
"""Suffixes that ``save_base`` knows."""


def load_base(
    path: str | os.PathLike[str],
    *,
    texture: str | os.PathLike[str] | None = None,
    textures: bool = True,
    origin: Sequence[float] | np.ndarray | None = None,
) -> BaseMesh:
    """The mesh in a file that ``load_mesh`` reads, with its vertex colours, if it has any, and textures.

    Vertices and triangles are those of ``load_mesh``. Textures are read from glTF (base colour, with the
    vertex colours that multiply it), from USD (``diffuseColor`` of UsdPreviewSurface), from the material
    library beside an `.obj` (``map_Kd``), and as a `.ply` names them (comment TextureFile); image files must
    lie in the folder of the mesh or below, or in the same `.usdz`.
    Faces whose texture is missing or of an unknown kind count as untextured, with a DataWarning.

    Args:
        path: the mesh.
        texture: an image to use for the whole mesh instead, by its texture coordinates (`.obj`, `.ply`,
            glTF, USD).
        textures: False leaves textures unread.
        origin: as for ``load_mesh``.

    Raises:
        FileFormatError: as ``load_mesh``, for a mesh prior, and for broken images and materials.
        ValueError: ``texture`` is given, but the mesh has no texture coordinates.
    """
    need_path(path=path)
    source = Path(path)
    mesh, hints = _read(source, origin)
    if mesh.binding is not None:
        raise FileFormatError(
            f"{source}: splats that are bound to a mesh, not the mesh that carries them: give that one"
        )
    if not textures:
        return _base(source, mesh, hints, None)
    override = None if texture is None else Texture(read_texture(Path(texture)))
    base = _base(source, mesh, hints, _textured(source, hints, override))
    if override is not None and not base.textured:
        raise ValueError(f"{source}: has no texture coordinates, so {texture} cannot be put on it")
    return base


def load_textured(path: str | os.PathLike[str]) -> SplatMesh | BaseMesh:
    """What ``load_mesh`` reads from ``path``; of a mesh with textures, what ``load_base`` does. Raises what
    these raise."""
    need_path(path=path)
    source = Path(path)
    mesh, hints = _read(source, None)
    if hints and mesh.binding is None:
        base = _base(source, mesh, hints, _textured(source, hints, None))
        if base.textured:
            return base
    for each in hints:
        warnings.warn(each.message, stacklevel=2)
    return mesh


def load_vertex_colored(path: str | os.PathLike[str]) -> SplatMesh:
    """The mesh at ``path``, its textures, if it has any, as vertex colours (``texture_to_vertex_colors``),
    which a NoTextureWarning says. Raises what ``load_base`` raises, but for a mesh prior."""
    return vertex_colored(load_textured(path), path)


def vertex_colored(mesh: SplatMesh | BaseMesh, path: str | os.PathLike[str]) -> SplatMesh:
    """``load_vertex_colored``, of the ``mesh`` that was read from ``path``."""
    if isinstance(mesh, SplatMesh):
        return mesh
    colored = texture_to_vertex_colors(mesh)
    warnings.warn(
        f"{path}: its texture counts as the colours of {len(colored.vertices):,} vertices",
        NoTextureWarning,
        stacklevel=3,
    )
    return colored


def save_base(
    base: BaseMesh,
    path: str | os.PathLike[str],
    *,
    unlit: bool = False,
    image: TextureImage | None = None,
    collision: Collision | None = None,
    cameras: Sequence[Camera] = (),
) -> None:
    """Writes a surface, opaque, with its texture or else its vertex colours, whole or not at all.

    - `.glb`: texture and smooth normals inside, a rough material without metal.
    - `.usdz`: a package with the texture inside. `.usdc`, `.usda`, `.usd`: the texture is a file beside. They
      need the extra ``usd``.
    - `.obj`: with a material library and a texture beside, of the same name. `.ply`: with a texture beside,
      as MeshLab has it.
    - `.npz`: of this project; without the texture.
    - A normal map is in `.glb`, with tangents, and USD unless they are unlit, and in `.obj` as ``norm``, a
      file NAME_normal.png beside; other formats leave it out. So do all but `.glb` with tints of the texture,
      which a DataWarning says.
    - `.stl`, `.3mf`: the shape alone, for printing: z up, from 0 on, a scene unit is a millimetre. A
      DataWarning says where it is no solid, as one whose edges do not have two triangles.

    Args:
        base: the surface; all of its faces have the first of its textures, or none has one.
        path: the file; its suffix decides the format.
        unlit: (`.glb`, USD) a material that shows the texture as it is, without lights.
        image: how the texture is stored; by default as PNG, or where that takes more than a megabyte, not in
            USD, as JPEG of quality 95. WebP keeps every byte, but not all programs read it in `.glb`.
        collision: (`.glb`, USD) marks the surface as a static collider. In `.glb` its name ends in ``-col``
            or ``-colonly``, by which Godot imports one; USD: UsdPhysics' CollisionAPI and MeshCollisionAPI.
            ``drawn``: it is drawn, too. ``only``: Godot and renderers of USD (purpose 'guide') leave it out,
            and it has neither texture nor colours. ``convex``: (`.glb`) it is drawn, and at most 32 convex
            hulls of its parts are colliders, meshes that nobody draws and that are named ``UCX_surface_00``
            and so on, by which Unreal makes them the collision of the surface; needs scipy.
        cameras: (`.glb`, USD) views of a place, the first one to open with, relative to the surface's origin.

    Raises:
        ValueError: the suffix is unknown, the format does not have an option, the mesh is empty, has
            several textures, or one that wraps at its edges as the format does not say (`.obj`, `.ply`).
        MissingDependencyError: a package is missing.
        OSError: a file cannot be written.
    """
    need(BaseMesh, base=base, instead={"SplatMesh": "save_mesh writes meshes of splats"})
    need_path(path=path)
    target = Path(path)
    suffix = target.suffix.lower()
    check_writing(target, unlit=unlit, image=image, collision=collision)
    need_all(Camera, cameras=cameras)
    if cameras and suffix not in SHADED:
        raise ValueError(f"cameras are for {', '.join(SHADED)}, not for {suffix}")
    if collision == "only":
        base = BaseMesh(base.vertices, base.faces, up=base.up, origin=base.origin)
    if image is not None and (suffix in UNTEXTURED or not base.textured):
        raise ValueError(f"image is for surfaces with a texture, and formats that keep it, not for {suffix}")
    if not len(base.faces):
        raise ValueError("the surface has no faces")
    check_texture(base)
    if suffix in (*_BESIDE, ".usdz"):
        warn_of_tints(base, target)
    own = None if image is None else f".{image}"
    writers: dict[str, Callable[[Path], None]] = {
        ".glb": lambda to: write_surface_glb(
            base, to, unlit=unlit, image=own, collision=collision, cameras=cameras
        ),
        ".obj": lambda to: write_surface_obj(base, to, target, own),
        ".ply": lambda to: write_surface_ply(base, to, target, own),
        ".npz": lambda to: write_npz(plain_mesh(base), to, colored=base.colors is not None),
        ".stl": lambda to: write_stl(base, to),
        ".3mf": lambda to: write_3mf(base, to),
    }

    def usd(to: Path) -> None:
        write_surface_usd(base, to, target, unlit=unlit, image=own, collision=collision, cameras=cameras)

    with together(), atomic_path(target) as temporary:
        writers.get(suffix, usd)(temporary)


def check_writing(
    target: Path,
    *,
    unlit: bool = False,
    image: TextureImage | None = None,
    collision: Collision | None = None,
) -> None:
    """ValueError where the format of ``target`` is unknown or does not have one of the options of
    ``save_base``, or would name a file beside that is not in UTF-8."""
    suffix = target.suffix.lower()
    if suffix not in BASE_SUFFIXES:
        known = ", ".join(BASE_SUFFIXES)
        raise ValueError(f"{target.name!r} does not name a format; choose a name that ends in {known}")
    if suffix in (*_BESIDE, ".usdz") and (name := legible(target.name)) != target.name:
        raise ValueError(f"{name!r} is not UTF-8, as names of textures in {suffix} are: choose another name")
    if unlit and suffix not in SHADED:
        raise ValueError(f"unlit applies to {', '.join(SHADED)} only, not to {suffix}")
    need_choice(TextureImage, optional=True, image=image)
    if image == "webp" and suffix == ".usdz":
        raise ValueError("a .usdz holds no WebP: leave out image, which makes it png, or save as .usdc")
    need_choice(Collision, optional=True, collision=collision)
    if collision is not None and suffix not in SHADED:
        raise ValueError(f"collision applies to {', '.join(SHADED)} only, not to {suffix}")
    if collision == "convex" and suffix != ".glb":
        raise ValueError(f"collision 'convex' is for .glb, not for {suffix}")


def level_files(path: Path, count: int) -> list[Path]:
    """The files of ``count`` levels of detail, the first of which is ``path``."""
    return [path, *(path.with_name(f"{path.stem}_lod{k}{path.suffix}") for k in range(1, count))]


def companions(path: Path, image: TextureImage | None = None) -> list[Path]:
    """The files that ``save_base`` may write beside ``path`` for a surface with a texture."""
    suffix = path.suffix.lower()
    kinds = ("png",) if suffix in SHADED else ("png", "jpg")
    pictures = [path.with_suffix(f".{kind}") for kind in ((image,) if image else kinds)]
    if suffix != ".ply":
        pictures.append(path.with_name(f"{path.stem}_normal.{'webp' if image == 'webp' else 'png'}"))
    return ([path.with_suffix(".mtl")] if suffix == ".obj" else []) + (pictures if suffix in _BESIDE else [])


def read_texture(path: Path, data: bytes | None = None) -> np.ndarray:
    """(h, w, 4) uint8 RGBA of an image file, or of ``data`` inside the file ``path``."""
    from meshsplats.images.reading import load_image

    pixels = load_image(path, data)
    opaque = np.full((*pixels.shape[:2], 4 - pixels.shape[2]), 255, np.uint8)
    return np.concatenate([pixels, opaque], axis=2)


class _Textured(NamedTuple):
    """The textures of a file."""

    uv: np.ndarray
    """(m, 3, 2) float32 coordinates of the corners of each face, v down."""
    of_face: np.ndarray
    """(m,) int32 texture of each face; -1: none."""
    images: tuple[Texture, ...]
    tints: np.ndarray | None = None
    """As ``BaseMesh.tints``."""


def _read(
    source: Path, origin: Sequence[float] | np.ndarray | None
) -> tuple[SplatMesh, list[warnings.WarningMessage]]:
    """``load_mesh``, and those of its warnings that hint at textures, which it does not read."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = load_mesh(source, origin=origin)
    hints = [each for each in caught if issubclass(each.category, (NoColorsWarning, NoTextureWarning))]
    for each in caught:
        if each not in hints:
            warnings.warn(each.message, stacklevel=3)
    return mesh, hints


def _base(
    source: Path,
    mesh: SplatMesh,
    hints: Sequence[warnings.WarningMessage],
    found: _Textured | None,
) -> BaseMesh:
    """The base of ``mesh`` and ``hints`` (of ``_read``), with the textures ``found`` (of ``_textured``)."""
    uncolored = any(issubclass(each.category, NoColorsWarning) for each in hints)
    colors = None if uncolored else _display(mesh)
    base = BaseMesh(mesh.vertices, mesh.faces, colors, up=mesh.up, origin=mesh.origin)
    if found is None or not (found.of_face >= 0).any():
        return base
    if len(found.uv) != len(base.faces):
        raise FileFormatError(
            f"{source}: {len(found.uv):,} faces with texture coordinates, {len(base.faces):,} in all"
        )
    return replace(base, uv=found.uv, face_texture=found.of_face, textures=found.images, tints=found.tints)


def _display(mesh: SplatMesh) -> np.ndarray:
    """(n, 4) display RGBA of a SplatMesh."""
    from meshsplats.scene.colors import linear_to_srgb

    if mesh.blending == "display":
        return mesh.colors
    return np.column_stack([np.clip(linear_to_srgb(mesh.colors[:, :3]), 0, 1), mesh.colors[:, 3]])


def _textured(
    path: Path, hints: Sequence[warnings.WarningMessage], override: Texture | None
) -> _Textured | None:
    """The textures of a file; None without any. ``hints``: of ``_read``."""
    with Content(path) as content:
        if content.is_usd:  # another process takes a while
            hinted = any(issubclass(each.category, NoTextureWarning) for each in hints)
            wanted = hinted or override is not None
            return _Textured(*usd_textures(path, read_texture, override)) if wanted else None
    if content.container in ("glb", "json"):
        in_gltf = gltf_textures(path, read_texture, override)
        return None if in_gltf is None else _Textured(*in_gltf)
    if content.container == "ply":
        in_ply = ply_textures(path, read_texture, override)
        return None if in_ply is None else _Textured(*in_ply)
    if not content.is_obj:
        return None
    found = obj_coordinates(path)
    if found is None:
        return None
    uv, complete, material, libraries = found
    if override is not None:
        return _Textured(uv, np.where(complete, 0, -1).astype(np.int32), (override,))
    index, images = obj_textures(path, libraries, material, read_texture)
    return _Textured(uv, np.where(complete, index, -1).astype(np.int32), images)
