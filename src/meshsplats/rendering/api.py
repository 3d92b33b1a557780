"""render and render_splats: exact pictures of meshes and splats from the compiled core."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, eq=False)
class Rendering:
    """A picture. Rows run from top to bottom."""

    color: np.ndarray
    """(h, w, 3) float32 RGB composited over the background, in the space of the colours given (display RGB)."""
    alpha: np.ndarray
    """(h, w) float32 opacity in [0, 1]: 1 minus the light that still comes from the background."""
    depth: np.ndarray | None = None
    """(h, w) float32 camera depth z summed with the same weights as colour; divide by ``alpha`` for the mean depth."""
    normals: np.ndarray | None = None
    """(h, w, 3) float32 world-frame normals turned to the camera, summed with the same weights."""
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Per-vertex attributes asked for, (h, w) or (h, w, c) float32, summed with the same weights."""
    fragments: int = 0
    """How many triangle (or splat) samples were blended."""


def render(mesh, camera, *, background: Sequence[float] | np.ndarray = (1, 1, 1), samples: int = 1,
           max_layers: int | None = None, threads: int | None = None, depth: bool = False, normals: bool = False,
           attributes: Sequence[str] = ()) -> Rendering:
    raise NotImplementedError


def render_splats(cloud, camera, *, background: Sequence[float] | np.ndarray = (1, 1, 1), samples: int = 1,
                  sh_degree: int | None = None, dilation: float = 0.3, threads: int | None = None) -> Rendering:
    raise NotImplementedError
