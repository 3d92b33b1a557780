"""Options of the commands that make images: cameras, sizes, how images are rendered."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from meshsplats.camera import Camera
from meshsplats.cli.arguments import as_cli_options
from meshsplats.cli.messages import say
from meshsplats.datasets.scene_views import SceneViews
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.drawing import DrawingOptions


@as_cli_options(presets=False)
class ViewOptions(SceneViews):
    """Cameras and image size. Orbit, dome, look-around, cameras and data exclude each other."""


@as_cli_options(presets=False)
class DrawOptions(DrawingOptions):
    """How images are rendered."""


def views_of_a_place(
    scene: GaussianCloud | SplatMesh, source: Path, count: int, **options: Any
) -> list[Camera] | None:
    """``default_views``; says where they come from."""
    from meshsplats.viewpoints.showing import default_views

    if (shown := default_views(scene, source, count, **options)) is None:
        return None
    say(shown[1])
    return shown[0]
