"""The module bpy, or an error that says how to install it."""

from __future__ import annotations

from meshsplats.blender.inside import MISSING
from meshsplats.errors import MissingDependencyError

try:
    import bpy
except ModuleNotFoundError as error:
    if error.name != "bpy":
        raise
    raise MissingDependencyError(MISSING) from None

__all__ = ["bpy"]
