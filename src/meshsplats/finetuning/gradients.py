"""What goes into a step of an optimisation: gradients, learning rates, the image of a step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshsplats.rendering.backward import TapeOptions
from meshsplats.scene.camera import Camera


class Rates(NamedTuple):
    """Learning rates of a step."""

    colors: float
    positions: float
    """0: positions are fixed."""


class StepImage(NamedTuple):
    """The image of a fused step, and what it is compared with."""

    camera: Camera
    options: TapeOptions
    target: np.ndarray
    """(h, w, 3) float32 RGB."""
    mask: np.ndarray | None
    """(h, w) bool, True where pixels count; None: all do."""


class Gradients(NamedTuple):
    """Gradients of the loss of one image; float32, C-contiguous."""

    vertices: np.ndarray
    """(v, 3)."""
    colors: np.ndarray
    """(v, 4)."""
    harmonics: np.ndarray | None = None
    """(s, k, 3); None for a mesh without harmonics."""
    exposure: np.ndarray | None = None
    """(6,): gain and offset of this view's exposure; None if exposures are not fitted."""

    def finite(self) -> bool:
        """Whether all values are finite."""
        # A sum of finite numbers may overflow, but such a run has diverged, too.
        with np.errstate(over="ignore", invalid="ignore"):
            return all(bool(np.isfinite(part.sum())) for part in self if part is not None)
