"""What all splat formats share: arguments of ``load_gaussians``, and what the reader of each offers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, BinaryIO, Literal

import numpy as np

from meshsplats._common.kinds import need_choice
from meshsplats.formats._display import display_cloud
from meshsplats.formats.content import Content
from meshsplats.formats.opened import Splats
from meshsplats.formats.ply.activated import Activated, checked_activated
from meshsplats.scene.gaussians import LEAST_OPACITY, GaussianCloud, Kernel

Axes = Literal["auto", "y-down", "y-up"]


@dataclass(frozen=True)
class Reading:
    """How files are read: arguments of ``load_gaussians``."""

    axes: Axes = "auto"
    kernel: Kernel | None = None
    time: float | None = None
    activated: tuple[Activated, ...] = ()
    in_blocks: bool = False
    """Whether the splats are wanted in blocks, not as a whole."""

    @classmethod
    def checked(
        cls,
        axes: Axes,
        kernel: Kernel | None,
        time: float | None,
        activated: Iterable[Activated],
        *,
        in_blocks: bool,
    ) -> Reading:
        """Raises ValueError for values that do not exist."""
        need_choice(Axes, axes=axes)
        need_choice(Kernel, optional=True, kernel=kernel)
        if time is not None and not np.isfinite(time):
            raise ValueError(f"time must be a finite number, got {time!r}")
        own = None if time is None else float(time)
        return cls(axes, kernel, own, checked_activated(activated), in_blocks)

    @property
    def record(self) -> dict[str, Any]:
        """What is given of ``kernel``, ``time`` and ``activated``, for JSON."""
        given = {"kernel": self.kernel, "time": self.time, "activated": sorted(self.activated) or None}
        return {name: value for name, value in given.items() if value is not None}

    def finished(self, cloud: GaussianCloud, splats: Splats) -> GaussianCloud:
        """``cloud`` of ``splats`` with display colours, up, and the kernel that is asked for; of moving
        splats those that are visible at the instant."""
        if splats.instant is not None:
            cloud = cloud.take(cloud.opacities >= LEAST_OPACITY)
        if splats.linear:
            cloud = display_cloud(cloud)
        if splats.up is not None:
            cloud = replace(cloud, up=splats.up)
        if self.kernel is None or self.kernel == cloud.kernel:
            return cloud
        scales = cloud.scales
        if self.kernel == "2dgs":
            scales = scales * np.array([1, 1, 0], np.float32)
        return replace(cloud, kernel=self.kernel, scales=scales)


def _always(content: Content) -> bool:
    return True


def _nothing(content: Content) -> None:
    return None


@dataclass(frozen=True)
class FormatReader:
    """What the module of a splat format offers."""

    matches: Callable[[Content], bool]
    """Whether the content is of this format, by its first bytes; the reader may still refuse it."""
    open: Callable[[Content, BinaryIO, Reading], Splats]
    """Its splats, where it matches; the file stays open while they are read."""
    holds_splats: Callable[[Content], bool] = _always
    """Whether it holds splats, for formats that may hold a mesh instead."""
    up: Callable[[Content], np.ndarray | None] = _nothing
    """(3,) direction that points up in the axes of the file, where it says so, without reading the splats."""
    motion: Callable[[Content], tuple[str, float, float] | None] = _nothing
    """Name of the layout, first and last time of splats that move in time."""
    to_y_down: np.ndarray | None = None
    """(3, 3) map from the axes of all its files to x right, y down, z forward; None: as the table says."""
