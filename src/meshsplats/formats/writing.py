"""What all writers of splat formats share: the options of ``save_gaussians``, and what each format offers."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from meshsplats.errors import DataWarning
from meshsplats.scene.gaussians import GaussianCloud

SpzVersion = Literal[3, 4]


@dataclass(frozen=True)
class Writing:
    """How a file is written: arguments of ``save_gaussians``. None: the default of the format."""

    where: Path
    """The file, for messages; it is written under another name."""
    spz_version: SpzVersion | None = None
    linear: bool | None = None

    def options(self) -> list[str]:
        """Names of those that are given."""
        return [name for name in ("spz_version", "linear") if getattr(self, name) is not None]


@dataclass(frozen=True)
class FormatWriter:
    """What the module of a format that is written offers."""

    write: Callable[[GaussianCloud, Path, Writing], None]
    """Writes a cloud that is not empty to a file that exists already, and is empty."""
    bytes_a_splat: Callable[[int], float]
    """Estimated, for the number of harmonics per channel; for the message about a full disk."""
    takes: tuple[str, ...] = ()
    """Which options of ``Writing`` have a meaning for it."""


def warn_of_losses(
    cloud: GaussianCloud, where: object, *, keeps: tuple[str, ...] = (), degree: int = 3
) -> None:
    """A DataWarning that says what of ``cloud`` a file does not tell: of 'origin', 'up' and 'kernel', what it
    does not ``keep``, and harmonics beyond a ``degree``."""
    lost = []
    if cloud.sh_degree > degree and cloud.sh[:, (degree + 1) ** 2 :].any():
        lost.append(f"spherical harmonics beyond degree {degree}: its splats look the same from all sides")
    if cloud.origin.any() and "origin" not in keeps:
        lost.append("the origin: positions are relative to it, around 0 0 0")
    if cloud.up is not None and np.abs(cloud.up - (0, -1, 0)).max() > 1e-6 and "up" not in keeps:
        lost.append("which direction is up")
    if cloud.kernel != "3dgs" and cloud.kernel not in keeps:
        lost.append(f"the kernel '{cloud.kernel}': it will be read as '3dgs'")
    if lost:
        warnings.warn(f"{where}: the format leaves out {'; '.join(lost)}", DataWarning, stacklevel=5)
