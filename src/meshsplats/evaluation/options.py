"""Options of a comparison of splats with a mesh."""

from __future__ import annotations

from dataclasses import dataclass, field

from meshsplats._common.choices import Look
from meshsplats._common.options import check_options
from meshsplats.conversion.options import Preset
from meshsplats.datasets.scene_files import PartOfScene, SceneReading
from meshsplats.datasets.scene_views import SceneViews
from meshsplats.errors import OptionValueError
from meshsplats.rendering.drawing import DrawingOptions


@dataclass(frozen=True)
class ComparisonOptions:
    """How splats and a mesh are compared."""

    preset: Preset = "default"
    """Preset of the conversion, without a mesh."""
    look: Look | None = None
    """Ground truth. area: the mean over each pixel's area, as in photographs, Blender, MSAA and ray tracers.
    splats: the image of a 3DGS viewer at this size. Default: area, without the gaps between splats that are
    smaller than these."""
    views: SceneViews = field(default_factory=SceneViews)
    """Default: 8 views of an orbit, 400 pixels wide."""
    draw: DrawingOptions = field(default_factory=DrawingOptions)
    reading: SceneReading = field(default_factory=SceneReading)
    part: PartOfScene = field(default_factory=PartOfScene)
    """Of the splats and of the mesh."""
    amplify: float = 4.0
    """Factor of the error in the strips."""

    def check(self) -> None:
        """OptionsError for options that contradict each other or have no effect, ValueError for values out of
        range, DeviceError or MissingDependencyError for a device that is not there."""
        check_options(self)
        if not self.amplify > 0:
            raise OptionValueError(f"``amplify`` must be positive, got {self.amplify}")
        _ = self.draw.color  # which is checked
        self.views.check()
        self.draw.check_device()
