"""Shared by all readers: a memory budget, and checks of arrays from untrusted files."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from meshsplats.errors import DataWarning, FileFormatError, NoColorsWarning
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.origin import choose_origin, lost_between, lost_detail, sampled, usual_size

T = TypeVar("T")
_BASE_BYTES = 256 << 20
_FACTOR = 64


class Budget:
    """Bytes of memory that reading one file may take: 256 MiB, and 64 times its size.

    Real files of the known formats unpack to less, save for long runs of equal values. A decompression bomb
    needs more, and so does a small file that repeats one mesh a million times.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file_bytes = 0
        self._left = _BASE_BYTES
        self.extend(os.stat(path).st_size)

    @property
    def file_bytes(self) -> int:
        """Bytes of the file and of all that belongs to it."""
        return self._file_bytes

    def extend(self, file_bytes: int) -> None:
        """Adds the share of another file that belongs to the first."""
        self._file_bytes += file_bytes
        self._left += _FACTOR * file_bytes

    def spend(self, count: int, what: str) -> None:
        """Takes ``count`` bytes for ``what`` from the budget; call it before allocating.

        Raises:
            FileFormatError: the budget is exceeded.
        """
        self._left -= count
        if self._left < 0:
            raise FileFormatError(
                f"{self._path}: {what} would take the data beyond what a file of {self._file_bytes:,} bytes"
                " may unpack to (a decompression bomb?); refused"
            )


def local_positions(
    positions: np.ndarray, origin: np.ndarray | None, where: object
) -> tuple[np.ndarray, np.ndarray]:
    """``positions`` (n, 3) of the world relative to ``origin``, by default one that suits them; and that
    origin.

    Positions that are float32 already are those of the file: a DataWarning says so where they have lost
    detail.
    """
    if origin is None:
        few = sampled(positions)
        if positions.dtype == np.float32:
            warn_of_lost_detail(few, where)
        origin = choose_origin(few)
    return (positions.astype(np.float64) - origin if origin.any() else positions), origin


def warn_of_lost_detail(sample: np.ndarray, where: object) -> None:
    """A DataWarning if a file that stores positions as float32, of which this is a ``sample``, has lost
    detail."""
    if lost := lost_detail(sample):
        warnings.warn(f"{where}: {lost}", DataWarning, stacklevel=4)


def warn_of_coarse_steps(sample: np.ndarray, scales: np.ndarray, where: object) -> None:
    """A DataWarning if splats of a file are smaller than the steps of float32 at their positions, of which
    this is a ``sample`` (k, 3). ``scales``: (n, 3)."""
    if len(sample) and (lost := lost_between(sample, usual_size(scales))):
        warnings.warn(f"{where}: {lost}", DataWarning, stacklevel=4)


def straight_colors(colors: np.ndarray, path: Path, brightest: float = 1) -> np.ndarray:
    """(v, 4) float32 RGBA from stored colours (v, 4), (v, 3) or (v, 0): RGB in [0, ``brightest``], opacity in
    [0, 1].

    Integers are divided by the largest value of their type, a missing alpha becomes 1, float values out of
    range are clipped with a counted DataWarning. Without colours the mesh is mid grey, with a DataWarning.
    """
    result = np.ones((len(colors), 4), np.float32)
    if colors.shape[1] == 0:
        result[:, :3] = 0.5
        warnings.warn(f"{path}: no vertex colours; the mesh is shown in grey", NoColorsWarning, stacklevel=2)
        return result
    if colors.dtype.kind == "u":
        result[:, : colors.shape[1]] = colors
        result[:, : colors.shape[1]] /= np.float32(np.iinfo(colors.dtype).max)
        return result
    if colors.dtype.kind != "f":
        raise FileFormatError(f"{path}: colours must be floats or unsigned integers, got {colors.dtype}")
    with np.errstate(over="ignore"):
        result[:, : colors.shape[1]] = colors
    most = np.array([brightest, brightest, brightest, 1], np.float32)
    # Values that are not finite are left to the check of SplatMesh, which names their row.
    if ((result < 0) | (result > most)).any() and np.isfinite(result).all():
        # A rounding error needs no warning.
        outside = int(((result < -1e-6) | (result > most + np.float32(1e-6))).any(axis=1).sum())
        if outside:
            warnings.warn(
                f"{path}: {outside:,} vertex colours lay outside [0, {brightest:g}] and were clipped",
                DataWarning,
                stacklevel=2,
            )
        np.clip(result, 0, most, out=result)
    return result


def check_attribute_names(mesh: SplatMesh) -> None:
    """Raises ValueError for attribute names that no file should hold."""
    for name in mesh.attributes:
        try:
            encoded = name.encode()
        except UnicodeEncodeError:
            raise ValueError(f"attribute name {name[:40]!r} is not valid text and cannot be stored") from None
        if b"\0" in encoded or len(encoded) > 200:
            raise ValueError(f"attribute name {name[:40]!r} cannot be stored (NUL in it, or over 200 bytes)")


def checked(path: Path, make: Callable[..., T], *args: Any, **kwargs: Any) -> T:
    """``make(...)`` of arrays from a file; its ValueError becomes a FileFormatError that names ``path``."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return make(*args, **kwargs)
    except FileFormatError:
        raise
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{path}: {error}") from None
