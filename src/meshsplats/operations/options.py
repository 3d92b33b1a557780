"""Options of what is done with files: splats that are simplified, meshes that are baked, chains of levels,
scores."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from meshsplats._common.choices import Look
from meshsplats._common.options import changed, check_options
from meshsplats._common.words import optional_color
from meshsplats.conversion.options import Preset
from meshsplats.datasets.scene_files import SceneReading
from meshsplats.datasets.scene_views import MasksOfData, MissingOfData, SceneViews, check_photographs
from meshsplats.errors import OptionsError, OptionValueError
from meshsplats.finetuning.config import FinetuneConfig, make_config
from meshsplats.formats.mesh_formats import takes
from meshsplats.formats.outputs import MeshEnding
from meshsplats.scene.order import Order

if TYPE_CHECKING:
    import numpy as np

    Direction = Sequence[float] | np.ndarray
else:
    Direction = Sequence[float]  # whoever asks for the types of fields needs no NumPy


MINUTES = 2.0
"""Default length of the fine-tuning of a level."""


@dataclass(frozen=True)
class SimplifyOptions:
    """How many splats are left, and from where they will be seen."""

    count: int | None = None
    """Number of splats to keep."""
    share: float | None = None
    """Share of the splats to keep, above 0 to 1: 0.25 keeps a quarter."""
    cameras: Path | None = None
    """Cameras that the splats will be seen from: a JSON list, a cameras.json of a 3DGS trainer, or the model
    folder that has one. What they do not see, and detail finer than their pixels, goes first. Default: those
    of the input if it is a model folder, else found ones of a place, and some all around an object."""
    data: Path | None = None
    """Data set of photographs, in place of ``cameras``: the cameras of its training views."""
    missing: MissingOfData = "few"
    no_preview: bool = False
    """Write no preview."""

    def check(self) -> None:
        """OptionsError for options that contradict each other or are out of range."""
        if (self.count is None) == (self.share is None):
            raise OptionsError("give ``count`` or ``share``, one of them")
        if self.count is not None and self.count < 1:
            raise OptionsError(f"``count`` must be at least 1, got {self.count}")
        if self.share is not None and not 0 < self.share <= 1:
            raise OptionsError(f"``share`` must be above 0 and at most 1, got {self.share}")
        check_photographs(self.data, self.missing, self.cameras)

    def wanted(self, splats: int) -> int:
        """How many of so many ``splats``."""
        return self.count or max(1, round((self.share or 0) * splats))


@dataclass(frozen=True)
class BakingOptions:
    """For which views a mesh is baked, and what."""

    views: SceneViews = field(default_factory=SceneViews)
    colors: bool = False
    """Replace view-dependent colours by their mean over these views, for programs that show them the
    same from everywhere."""
    filter_px2: float | None = None
    """Variance of the filter in square pixels, 0 to 100. Default: the mesh's own."""


@dataclass(frozen=True)
class ChainOptions:
    """The meshes of a chain and their files."""

    levels: int = 4
    """Number of meshes."""
    factor: Literal[2, 4] = 4
    """Splats of each level per splat of the next: 4, for half the size on the screen, or 2."""
    width: int = 800
    """Screen size of the finest level: side in pixels of images that just hold the subject."""
    max_splats: int | None = None
    """Maximum number of splats of the finest level. Default: all."""
    format: MeshEnding = "glb"
    """File format of the meshes."""
    alpha: Literal["auto", "blend", "mask", "opaque", "ordered"] = "auto"
    """.glb: auto: blend or mask for all levels, whichever brings the first one nearer to the sorted image in
    viewers that do not sort; mask: viewers draw as solid what is at least 20 % opaque. opaque (any format):
    solid triangles, cut at 20 %. ordered: triangles in a fixed blending order, with which the levels are
    tuned, for web viewers and engines with back-face culling."""
    order: Order | None = None
    """In which triangles are blended and tuned; None: that of the meshes and of the configuration."""
    sh_degree: int | None = None
    """Render the splats with spherical harmonics up to this degree. Default: all that are stored."""
    up: Direction | None = None
    """Direction that points up in the world; None: that of the splats."""
    threads: int | None = None
    """Maximum number of threads; None: all processors."""

    def check(self) -> None:
        """OptionsError for options that are out of range or have no effect."""
        check_options(self)
        if self.levels < 1:
            raise OptionsError(f"``levels`` must be at least 1, got {self.levels}")
        if self.max_splats is not None and self.max_splats < 1:
            raise OptionsError(f"``max_splats`` must be at least 1, got {self.max_splats}")
        if self.alpha not in ("auto", "opaque") and not takes(f"level.{self.format}", "alpha"):
            raise OptionsError(f"``alpha`` {self.alpha} is for .glb files, not .{self.format}")


@dataclass(frozen=True)
class LevelTuning:
    """How long each level is fine-tuned."""

    no_tune: bool = False
    """Convert only: seconds in place of minutes."""
    minutes: float | None = None
    """Length of the fine-tuning of each level. Default: 2."""
    steps: int | None = None
    """Length of the fine-tuning of each level, in place of ``minutes``."""

    def config(self) -> FinetuneConfig | None:
        """The configuration for ``make_chain``. OptionsError for lengths that contradict each other."""
        if self.no_tune and (self.minutes is not None or self.steps is not None):
            raise OptionsError("``minutes`` and ``steps`` have no effect with ``no_tune``")
        if self.minutes is not None and self.steps is not None:
            raise OptionsError("give ``minutes`` or ``steps``, not both")
        if self.no_tune:
            return None
        if self.steps is not None:
            return make_config("default", steps=self.steps)
        return make_config("default", minutes=MINUTES if self.minutes is None else self.minutes)


_OF_SPLATS = ("cameras", "look", "sh_degree")
"""Options of scores against images of splats..."""
_OF_PHOTOGRAPHS = ("downscale", "test_every")
"""... and against photographs, beside those that ``check_photographs`` knows."""


@dataclass(frozen=True)
class ScoringOptions:
    """What is scored, against what, and how."""

    data: Path | None = None
    """Data set of photographs; with ``protocol`` the folder of its scenes. Default: images of the splats."""
    before: Path | None = None
    """Another mesh to score, such as the one before fine-tuning."""
    splats: Path | None = None
    """The splats. With ``data``: scored, too, at SH degree 0 and with all spherical harmonics. Without: their
    images are the ground truth (also scored at SH degree 0)."""
    images: Path | None = None
    """Images by other programs to score, such as Blender: a file for each view, by its name or in order."""
    cameras: Path | None = None
    """Without ``data``: cameras. Default: those that finetune holds out."""
    look: Look | None = None
    """Without ``data``: kind of ground truth. area: means over each pixel's area, as in programs that take
    several samples per pixel. splats: images of a 3DGS viewer at this size. Default: area, without the gaps
    between splats that are smaller than these."""
    sh_degree: int | None = None
    """Without ``data``: SH degree of the ground truth. Default: all that are stored."""
    lpips: tuple[Path, ...] = ()
    """Weights of LPIPS, files or a folder: torchvision's vgg16-397923af.pth and vgg.pth of the package lpips,
    or one file of both (see docs/finetuning.md). Default: no LPIPS."""
    network: Literal["vgg", "alex"] = "vgg"
    """Network of LPIPS; splatting papers use vgg."""
    lpips_convention: Literal["3dgs", "lpips"] | None = None
    """Colours that the network is given: from 0 to 1 as in the code of 3DGS, or from -1 to 1 as in the
    package lpips, with larger values. Default: as splatting papers have it, 3dgs for vgg, lpips for alex."""
    fit_exposure: bool = False
    """Also score with a gain and an offset per channel, fitted to each image."""
    samples: int | None = None
    """Side of the sample grid in each pixel, for meshes. Default: what the mesh needs at this size, 2 to 8; 1
    with ``look`` splats."""
    order: Order | None = None
    """Order in which the triangles of meshes are blended: exact at every sample, or whole splats by their
    centres. Default: that of each mesh."""
    background: str | None = None
    """Background: white, black, grey, #rrggbb, or r,g,b from 0 to 1. Default: white; for photographs without
    alpha that of the model folder, else black or white, the one that fits the splats best."""
    downscale: int | None = None
    """Factor by which images are smaller than the photographs. Default: 1, or that of the protocol."""
    test_every: int = 8
    """Every n-th view is held out, if the data set has no split; 0: none, and all are scored."""
    missing: MissingOfData = "few"
    masks: MasksOfData = "count"
    protocol: Literal["mipnerf360", "mipnerf360-9", "tanks-and-temples", "deep-blending"] | None = None
    """Score all scenes of a benchmark at its resolution and with its split. mipnerf360: the seven scenes in
    Table 1 of the MeshSplats paper; mipnerf360-9: all nine."""
    tune: Preset | None = None
    """With ``protocol``: first fine-tune each scene on its training views, with this preset."""
    strips: int = 8
    """Number of views, spread over all, for which strips and enlarged crops are written."""
    amplify: float = 4.0
    """Factor of the error in the strips."""
    reading: SceneReading = field(default_factory=SceneReading)

    def check(self, meshes: Sequence[Path]) -> None:
        """OptionsError for options that contradict each other or have no effect, ValueError for values out of
        range. ``meshes``: what is scored; with ``protocol``, the folder of the scenes."""
        check_options(self)
        optional_color(self.background)
        if self.amplify <= 0 or self.strips < 0:
            raise OptionValueError("``amplify`` must be positive and ``strips`` >= 0")
        given = changed(self)
        for name in ("network", "lpips_convention"):
            if name in given and not self.lpips:
                raise OptionsError(f"``{name}`` has no effect without ``lpips``")
        if self.protocol is not None:
            if self.data is None or len(meshes) != 1:
                raise OptionsError(
                    "``protocol`` needs a folder of meshes or models, and ``data`` with the scenes"
                )
            if "missing" in given:
                raise OptionsError("``missing`` has no effect with ``protocol``, which needs every image")
            for name in (*_OF_SPLATS, "before", "splats", "images", "order", "test_every", "masks"):
                if name in given:
                    raise OptionsError(f"``{name}`` has no effect with ``protocol``")
            return
        if self.tune is not None:
            raise OptionsError(
                "``tune`` is for ``protocol``; otherwise use meshsplats finetune, then evaluate"
            )
        if len(set(map(os.path.abspath, meshes))) < len(meshes):
            raise OptionsError("a mesh was given twice")
        if not meshes and self.images is None and (self.splats is None or self.data is None):
            raise OptionsError("nothing to score: give a mesh, ``images``, or ``splats`` with ``data``")
        if self.data is None and self.splats is None:
            raise OptionsError("nothing to compare with: give ``data``, or ``splats``")
        useless, how = (_OF_PHOTOGRAPHS, "without") if self.data is None else (_OF_SPLATS, "with")
        for name in useless:
            if name in given:
                raise OptionsError(f"``{name}`` has no effect {how} ``data``")
        check_photographs(self.data, self.missing, masks=self.masks)
