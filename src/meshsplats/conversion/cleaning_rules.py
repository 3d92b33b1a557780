"""Which splats are cleaned away, as options."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from meshsplats._common.options import Range, check_options


@dataclass(frozen=True)
class CleaningRules:
    """Which splats are removed: those that any of these rules names. None: no such rule."""

    crop: tuple[float, float, float, float, float, float] | None = None
    """Centre outside the box x0 y0 z0 x1 y1 z1, in coordinates of the world, as ``info`` prints them."""
    min_opacity: Annotated[float | None, Range(0, 1)] = None
    """Opacity below this."""
    max_distance: Annotated[float | None, Range(0, math.inf)] = None
    """Farther from the middle than this many radii of the subject. Within one radius lie nine tenths of its
    opacity."""
    max_size: Annotated[float | None, Range(0, math.inf)] = None
    """Longer, from its middle to an end, than this many radii of the subject. 1000 removes what no camera can
    have seen whole."""
    sparse: Annotated[float | None, Range(0, 1)] = None
    """Fewer neighbours than this share of the median. 0.05 removes single floaters and thin
    clouds."""
    min_part: Annotated[float | None, Range(0, 1)] = None
    """In a connected component with less than this share of all opacity. 0.01 removes clumps in the
    air."""

    def __post_init__(self) -> None:
        check_options(self)
        if self.crop is not None:
            import numpy as np

            low, high = np.array(self.crop[:3]), np.array(self.crop[3:])
            if not (np.isfinite(self.crop).all() and (low < high).all()):
                raise ValueError(f"crop must be x0 y0 z0 x1 y1 z1 with x0 < x1 and so on, got {self.crop}")


FLOATERS = CleaningRules(max_size=1000, sparse=0.05, min_part=0.01)
"""The default rules."""
