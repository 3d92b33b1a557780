"""The splats of an opened file, whatever its format."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np

from meshsplats.scene.gaussians import GaussianCloud, Kernel


class Splats(ABC):
    """The splats of an opened file, ready to be read once, as a whole or in blocks.

    Origins are in the frame of the file.
    """

    up: np.ndarray | None = None
    """(3,) direction that points up in the axes of the file, where it says so."""
    linear: bool = False
    """Whether its colours are linear, not display values."""
    instant: float | None = None
    """The time at which they are shown, of splats that move."""
    to_y_down: np.ndarray | None = None
    """(3, 3) map from its axes to x right, y down, z forward, where the file says so itself; a mirror where
    the file is left-handed."""

    @abstractmethod
    def world_sample(self) -> np.ndarray:
        """(k, 3) float64 sample of the positions in the world, by which an origin is chosen."""

    @abstractmethod
    def chosen_origin(self) -> np.ndarray:
        """The origin of the file; else the one that suits its positions."""

    @abstractmethod
    def read(self, *, strict: bool, origin: np.ndarray | None = None) -> GaussianCloud:
        """All splats, relative to ``origin``, by default ``chosen_origin``; errors and warnings as
        ``load_gaussians``, which must be the caller."""

    @abstractmethod
    def blocks(self, size: int, *, strict: bool, origin: np.ndarray) -> Iterator[GaussianCloud]:
        """The same splats in blocks of about ``size``."""

    def with_kernel(self, kernel: Kernel) -> Splats:
        """The same, read as splats of ``kernel`` where it matters for reading."""
        return self

    def close(self) -> None:  # noqa: B027 - most have opened nothing
        """Closes the files that it has opened itself."""
