"""Surfaces: light, connected, textured meshes of what splats show."""

from __future__ import annotations

from meshsplats.surfaces.images import draw_surface
from meshsplats.surfaces.making import make_surface
from meshsplats.surfaces.options import SurfaceOptions

__all__ = ["SurfaceOptions", "draw_surface", "make_surface"]
