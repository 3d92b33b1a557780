"""Images of meshes and of splats. See :mod:`meshsplats.rendering.api`."""

from meshsplats.rendering.api import Rendering, render, render_splats

__all__ = ["Rendering", "render", "render_splats"]
