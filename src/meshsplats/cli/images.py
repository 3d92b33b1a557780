"""Options of the commands that make images: cameras, sizes, how images are rendered."""

from __future__ import annotations

from meshsplats.cli.arguments import as_cli_options
from meshsplats.datasets.scene_views import SceneViews
from meshsplats.rendering.drawing import DrawingOptions


@as_cli_options(presets=False)
class ViewOptions(SceneViews):
    """Cameras and image size. Orbit, dome, look-around, cameras and data exclude each other."""


@as_cli_options(presets=False)
class DrawOptions(DrawingOptions):
    """How images are rendered."""
