"""Options of the mesh from which a fine-tuning starts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from meshsplats._common.options import Advanced
from meshsplats.conversion.options import ConversionOptions, Preset


@dataclass(frozen=True)
class StartOptions:
    """From which mesh a fine-tuning starts."""

    preset: Preset = "default"
    """default: best quality at equal time. paper: the text of the MeshSplats paper."""
    start: Annotated[Literal["same", "default", "paper"], Advanced] = "same"
    """Conversion of splats; same: that of ``preset``. default: an ellipse of 5 to 32 triangles a splat.
    paper: the paper's conversion."""
    conversion: ConversionOptions = field(default_factory=ConversionOptions)
    cell_splats: int | None = None
    """Tune splats in cells of at most N, in the memory of a cell, one after the other or by ``cluster``."""

    @property
    def of_start(self) -> Preset:
        """The preset of the conversion."""
        return self.preset if self.start == "same" else self.start
