"""Options of images of a scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from meshsplats._common.options import changed, check_options
from meshsplats.datasets.scene_files import PartOfScene, SceneReading
from meshsplats.datasets.scene_views import SceneViews
from meshsplats.errors import OptionsError
from meshsplats.rendering.drawing import DrawingOptions


@dataclass(frozen=True)
class ImageOptions:
    """Which images are made of a scene, and how."""

    as_splats: bool = False
    """Render the splats themselves, not the mesh that they become."""
    views: SceneViews = field(default_factory=SceneViews)
    draw: DrawingOptions = field(default_factory=DrawingOptions)
    reading: SceneReading = field(default_factory=SceneReading)
    part: PartOfScene = field(default_factory=PartOfScene)
    cutoff: float | None = None
    """Draw a mesh as a depth buffer does: opaque where its opacity is at least this, nothing elsewhere. 0 to
    1; default: blended."""
    max_error: float | None = None
    """Tileset: draw tiles whose geometric error is at most this many pixels; 0 draws the finest ones.
    Default: 1."""
    transparent: bool = False
    """No background: images with an alpha channel."""
    depth: Literal["none", "png", "npy"] = "none"
    """Also depth images of a mesh: 16-bit PNG (depth_unit in the configuration is its scale) or float arrays;
    0: empty."""
    animation: Literal["webp", "gif", "png", "none"] = "webp"
    """Format of the turntable of an orbit; png is an animated PNG."""
    fps: float = 15.0
    """Images per second of the turntable."""

    def check(self, output: Path) -> None:
        """OptionsError for options that contradict each other or have no effect, ValueError for values out of
        range, DeviceError or MissingDependencyError for a device that is not there."""
        check_options(self)
        self.views.check()
        color, draw = self.draw.color, self.draw
        if output.suffix.lower() != ".png" and output.suffix:
            raise OptionsError(
                f"``output`` must end in .png for one image, or name a folder, got {output.name!r}"
            )
        if self.transparent and color is not None:
            raise OptionsError("``transparent`` and ``background`` exclude each other")
        if self.transparent and self.animation == "gif":
            raise OptionsError(
                "GIF has no translucency: use ``animation`` webp, png or none with ``transparent``"
            )
        if self.as_splats and self.depth != "none":
            raise OptionsError("``depth`` is that of a mesh: leave out ``as_splats``")
        if self.cutoff is not None:
            from meshsplats.scene.mesh import checked_cutoff

            checked_cutoff(self.cutoff)
            if self.as_splats:
                raise OptionsError("``cutoff`` is for a mesh: leave out ``as_splats``")
            if draw.max_layers is not None:
                raise OptionsError(
                    "``max_layers`` has no effect with ``cutoff``, which draws one triangle a sample"
                )
        if self.as_splats and draw.max_layers is not None:
            raise OptionsError("``max_layers`` counts triangles: it has no effect with ``as_splats``")
        if self.as_splats and draw.order is not None:
            raise OptionsError("``order`` is that of a mesh: leave out ``as_splats``")
        if self.as_splats and "device" in changed(draw):
            raise OptionsError(f"``device`` {draw.device} draws meshes: leave out ``as_splats``")
        draw.check_device()
