"""Scenes: splats, their mesh, a textured surface and a collider together in one file, in their places."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshsplats._common.kinds import need, need_path
from meshsplats._files.atomic import atomic_path
from meshsplats.formats._scene import SceneParts
from meshsplats.formats.meshes import expected_bytes
from meshsplats.formats.surfaces.corners import warn_of_tints
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

SUFFIXES = (".glb", ".usdc", ".usda", ".usd", ".usdz")
_SAME = 1e-3


def save_scene(
    path: str | os.PathLike[str],
    *,
    splats: GaussianCloud | None = None,
    mesh: SplatMesh | None = None,
    surface: BaseMesh | None = None,
    collider: BaseMesh | SplatMesh | None = None,
    lit: bool = False,
) -> None:
    """Writes one file with all that is given, whole or not at all: `.glb`, `.usdc`, `.usda`, `.usd` or
    `.usdz`, in metres and with y up.

    Each part is as ``save_gaussians`` and ``save_mesh`` write it, on a node of its own that puts it in its
    place, so that parts of one world with different origins fit together. ``load_gaussians`` reads the splats
    of the file, ``load_mesh`` the mesh and the surface; the collider is left out by both.

    Args:
        path: the file; its suffix decides the format.
        splats: the splats themselves, for programs that draw them. Where they do not say which direction is
            up, it is that of ``mesh``, else -y.
        mesh: a mesh of splats, for those that do not.
        surface: a mesh with vertex colours or textures, such as one of photogrammetry. Textures go into
            `.glb` and `.usdz`; their tints into `.glb` only, which a DataWarning says.
        collider: triangles that physics engines collide with, and nobody draws. USD: a mesh of the purpose
            'guide' with UsdPhysics' CollisionAPI and MeshCollisionAPI. glTF, which has no such thing: an
            invisible mesh whose node is named ``collider-colonly``, as Godot imports colliders.
        lit: materials of ``mesh`` and ``surface`` that take light, not ones that show colours as they are;
            the surface with smooth normals and its normal map.

    Raises:
        ValueError: nothing is given, a part is empty, the suffix is unknown, textures do not go into the
            format, or parts disagree which direction is up.
        MissingDependencyError: USD without the extra ``usd``, textures without Pillow.
        OSError: the file cannot be written.
    """
    need_path(path=path)
    need(GaussianCloud, optional=True, splats=splats)
    need(SplatMesh, optional=True, mesh=mesh)
    need(BaseMesh, optional=True, surface=surface)
    if isinstance(collider, SplatMesh):
        collider = BaseMesh(collider.vertices, collider.faces, up=collider.up, origin=collider.origin)
    need(BaseMesh, optional=True, collider=collider)
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{target.name!r} names no scene; choose a name that ends in {', '.join(SUFFIXES)}")
    parts = SceneParts(splats, mesh, surface, collider)
    given = {name: part for name, part in vars(parts).items() if part is not None}
    if not given:
        raise ValueError("nothing to write: give splats, a mesh, a surface or a collider")
    for name, part in given.items():
        if not len(part.means if isinstance(part, GaussianCloud) else part.faces):
            raise ValueError(f"{name} is empty: leave it out")
    if splats is not None and splats.up is None:
        up = np.array([0, -1, 0]) if mesh is None else mesh.up
        parts = replace(parts, splats=replace(splats, up=up))
    _check_up(parts)
    if surface is not None and surface.textured and suffix not in (".glb", ".usdz"):
        raise ValueError(f"{target.name!r} has no place for the textures of the surface: write .glb or .usdz")
    if surface is not None and suffix != ".glb":
        warn_of_tints(surface, target)
    with atomic_path(target, needs=_bytes(parts, suffix)) as temporary:
        if suffix == ".glb":
            from meshsplats.formats.gltf.scene_writer import write_scene_glb

            write_scene_glb(parts, temporary, lit=lit)
        else:
            from meshsplats.formats.usd.scene_writer import write_scene_usd

            write_scene_usd(parts, temporary, target, lit=lit)


def _check_up(parts: SceneParts) -> None:
    """ValueError unless all parts say the same direction is up."""
    ups = {name: part.up for name, part in vars(parts).items() if part is not None}
    first, wanted = next(iter(ups.items()))
    for name, up in ups.items():
        if np.abs(up / np.linalg.norm(up) - wanted / np.linalg.norm(wanted)).max() > _SAME:
            raise ValueError(
                f"{first} has up {_words(wanted)}, {name} {_words(up)}: parts of one world have one; if they"
                f" are, give dataclasses.replace({name}, up={first}.up)"
            )


def _words(up: np.ndarray) -> str:
    return " ".join(f"{x:.3g}" for x in up)


def _bytes(parts: SceneParts, suffix: str) -> int:
    """Estimated, for the message about a full disk."""
    total = 0 if parts.mesh is None else expected_bytes(parts.mesh, ".usdc" if suffix == ".usdz" else suffix)
    if parts.splats is not None:
        total += (48 + 12 * parts.splats.sh.shape[1]) * len(parts.splats)
    return total + sum(28 * len(p.faces) for p in (parts.surface, parts.collider) if p is not None)
