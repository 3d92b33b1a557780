"""Whether a splat mesh is still what its file gave, and the splats that it consists of if it is not."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from meshsplats.blender.inside import frame, levels, meshes, priors, stand_ins
from meshsplats.blender.inside.host import bpy
from meshsplats.conversion.recovery import recover_splats
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

MADE = "meshsplats_made"
"""Property of an object: what ``_state`` was when its mesh was made from its file."""
UP = "meshsplats_file_up"
"""And which way was up in the file then."""
_UP, _ORIGIN = "meshsplats_up", "meshsplats_origin"
"""Properties of the mesh data; ``objects`` sets them."""


def mark(obj: Any) -> None:
    """Remembers that the mesh of ``obj`` is what its file gave."""
    if MADE not in obj:  # its import
        obj[UP] = list(obj.data[_UP])
    obj[MADE] = _state(obj)


def turn(obj: Any, up: np.ndarray, foot: np.ndarray) -> None:
    """Stands ``obj`` upright again where its file was read with another ``up`` (3,) than before, and with its
    ``foot`` (3,), in the frame of the file, where its origin was. Coarser levels follow the finest."""
    from mathutils import Matrix, Vector

    before = np.array(obj.get(UP, up))
    obj[UP] = up.tolist()
    if np.allclose(before, up, atol=1e-6) or obj != levels.with_levels(obj)[0]:
        return
    bpy.context.view_layer.update()
    world, place = obj.matrix_world, obj.matrix_world.translation.copy()
    turned = world.to_3x3() @ Matrix((frame.to_blender(before).T @ frame.to_blender(up)).tolist())
    away = turned @ Vector((foot - np.array(obj.data[_ORIGIN])).tolist())
    obj.matrix_world = Matrix.Translation(place - away) @ turned.to_4x4()


def is_as_made(obj: Any) -> bool:
    """Whether the mesh of ``obj`` is what its file gave, and was not cut, joined with others, reshaped or
    painted since."""
    return MADE in obj and bool(obj[MADE] == _state(obj))


def _state(obj: Any) -> str:
    """Shape and colours; of a mesh prior, whose base moves it, the counts alone."""
    data = obj.data
    if priors.base_of(obj) is not None:
        return f"{len(data.vertices)} {len(data.polygons)}"
    colors = np.empty(0, np.float32)
    attribute = data.color_attributes.get(meshes.COLOR)  # which edits may have moved to another domain
    if attribute is not None:
        colors = np.empty(4 * len(attribute.data), np.float32)
        attribute.data.foreach_get("color", colors)
    return f"{stand_ins.shape(data)} {zlib.crc32(colors.tobytes()):08x}"


def check_own(obj: Any) -> None:
    """Raises ValueError if the splats of ``obj`` cannot be converted instead of its file."""
    if priors.base_of(obj) is not None:
        raise ValueError(_refusal(obj.name, "its splats are bound to a base, which converting would lose"))


def own_splats(mesh: SplatMesh, name: str) -> GaussianCloud:
    """The splats of ``mesh``, all of them, for another conversion; ``name`` is that of its object.

    Raises:
        ValueError: some of it is no whole splat, which would be lost.
    """
    try:
        cloud, whole = recover_splats(mesh)
    except ValueError as error:
        raise ValueError(_refusal(name, str(error))) from None
    cut = int((~whole).sum())
    if cut:
        parts = "a splat in it is" if cut == 1 else f"{cut:,} splats in it are"
        raise ValueError(_refusal(name, f"{parts} incomplete, which another conversion would lose"))
    return cloud


def _refusal(name: str, reason: str) -> str:
    return (
        f"{name} was edited or joined since its import, and {reason}."
        " Import its files again with these settings, and edit or join them then"
    )
