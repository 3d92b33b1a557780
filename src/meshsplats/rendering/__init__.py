"""Images of meshes and of splats. See :mod:`meshsplats.rendering.api`."""

from typing import TYPE_CHECKING

from meshsplats._common.lazy import lazy_names

__all__ = ["Rendering", "render", "render_splats"]

if TYPE_CHECKING:
    from meshsplats.rendering.api import Rendering, render, render_splats
else:
    __getattr__ = lazy_names(__name__, {"meshsplats.rendering.api": __all__})
