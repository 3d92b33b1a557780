"""Options of mesh priors: how splats are laid on a base, and how they are trained."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from meshsplats._common.options import check_options
from meshsplats.errors import OptionsError
from meshsplats.finetuning.config import FinetuneConfig, make_config

if TYPE_CHECKING:
    from meshsplats.scene.base_mesh import BaseMesh

Source = Literal["auto", "texture", "vertices", "views", "grey"]
LAYERS = 6
"""Default number of layers."""

CHOICES = {
    "color_rate": 0.05,
    "position_rate": 0.05,
    "rate_steps": 0,
    "ssim_weight": 0.0,
    "l2_weight": 5.0,
}
"""Differences from the preset 'default' of fine-tuning."""


def prior_config(**changes: Any) -> FinetuneConfig:
    """The default configuration of ``train_prior``, with ``changes`` as in ``make_config``."""
    return make_config("default", **{**CHOICES, **changes})


@dataclass(frozen=True)
class LayingOptions:
    """Splats on the base."""

    triangles: int = 1
    """Triangles on each face, in each layer: 1 to 256; square numbers avoid T-junctions."""
    by_area: bool = False
    """Take ``triangles`` as the mean, with more on larger faces."""
    layers: int = LAYERS
    """Layers of triangles on each face: 1 to 16."""
    spacing: float | None = None
    """Distance between layers along the base's normals, scene units; below 0 inwards; 0: all layers lie in
    the base. Default: inwards, all layers together 1/30 of the diagonal of the base's box."""
    colors: Source = "auto"
    """Initial colours: the base's texture, its vertex colours, or the images that see a point most squarely;
    auto: the first of these that exists."""
    texture: Path | None = None
    """Image for the base's texture coordinates, if its file names none."""

    def check(self) -> None:
        """OptionsError for options without effect, ValueError for values out of range."""
        check_options(self)
        if self.texture is not None and self.colors not in ("auto", "texture"):
            raise OptionsError(f"``texture`` has no effect with ``colors`` {self.colors}")
        if self.spacing and self.layers == 1:
            raise OptionsError("``spacing`` has no effect with one layer; give ``layers``")

    def load_base(self, path: Path) -> BaseMesh:
        """The base mesh at ``path``, with its textures where colours come from them."""
        from meshsplats.formats.base_meshes import load_base

        return load_base(path, texture=self.texture, textures=self.colors in ("auto", "texture"))
