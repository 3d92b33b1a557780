"""Splats whose scales, opacities or colours are stored after activation, where a .ply should hold logarithms,
logits and harmonics: recognised by their values."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Literal, get_args

import numpy as np

from meshsplats.errors import DataWarning
from meshsplats.scene.gaussians import SH_C0

Activated = Literal["scales", "opacities", "colors"]
SAMPLE = 2000
"""Splats that are looked at. Distances between all pairs of them are computed for large scales."""
_FEWEST = 32
"""Of fewer splats, nothing is said."""
_APART, _CLOSE = 3.0, 0.02
"""The middle axis of a splat as a multiple of the distance to the nearest splat: in 20 captures and trained
scenes, the median is 0.25 to 1.8. Above the first value logarithms are doubted; the values themselves must
then be between the second and the first."""
_MEANINGS: dict[Activated, str] = {
    "scales": "the scales themselves, not their logarithms",
    "opacities": "opacities from 0 to {}, not logits",
    "colors": "colours from 0 to {}, not harmonics",
}


def checked_activated(activated: Iterable[str]) -> tuple[Activated, ...]:
    """``activated`` without repetitions. Raises ValueError for names that are not ``Activated``."""
    names = (activated,) if isinstance(activated, str) else tuple(activated)
    for name in names:
        if name not in get_args(Activated):
            raise ValueError(f"activated must be of {', '.join(get_args(Activated))}, got {name!r}")
    return tuple(name for name in get_args(Activated) if name in names)


def span_of(values: np.ndarray) -> int:
    """255 for values that are meant from 0 to 255, else 1."""
    return 255 if values.size and values.max() > 1.5 else 1


def suspects(
    count: int, means: np.ndarray, scales: np.ndarray, opacities: np.ndarray, colors: np.ndarray
) -> dict[Activated, int]:
    """Which of the stored values of a sample of ``count`` splats look activated, and their greatest value.

    Args:
        count: of all splats.
        means: (m, 3) centres.
        scales: (m, 2 or 3) as stored.
        opacities: (m,) as stored.
        colors: (m, 3) as stored.
    """
    found: dict[Activated, int] = {}
    if len(means) < _FEWEST:
        return found
    if scales.min() >= 0 and _without_logarithms(means.astype(np.float64), scales, count):
        found["scales"] = 1
    low, high = opacities.min(), opacities.max()
    whole = bool((opacities == np.round(opacities)).all())
    if low >= 0 and (0.9 <= high <= 1 or (20 < high <= 255 and whole)):
        found["opacities"] = span_of(opacities)
    low, high = colors.min(), colors.max()
    if low >= 0 and ((low <= 0.1 and 0.9 <= high <= 1) or (high <= 255 and np.median(colors) > 3)):
        found["colors"] = span_of(colors)
    return found


def warn_of(found: dict[Activated, int], where: object, *, stacklevel: int = 4) -> None:
    """Says what looks activated, and how it is read, to the caller ``stacklevel`` calls up."""
    if not found:
        return
    said = " and ".join(f"{name}: {_MEANINGS[name].format(span)}" for name, span in found.items())
    names = list(found)
    warnings.warn(
        f"{where}: its values look as if they were stored after activation ({said}); if so,"
        f" ``activated``={','.join(names)} reads it right",
        DataWarning,
        stacklevel=stacklevel + 1,
    )


def harmonics_of(colors: np.ndarray, span: float | np.ndarray) -> np.ndarray:
    """Harmonics of degree 0 of ``colors`` from 0 to ``span``, of all channels or of each."""
    return (colors / np.asarray(span, np.float32) - np.float32(0.5)) / np.float32(SH_C0)


def _without_logarithms(means: np.ndarray, scales: np.ndarray, count: int) -> bool:
    """Whether splats would be far larger than the distances between them, if these were logarithms.

    Concretely, a scene in other units has other logarithms, but the same ratio.
    """
    nearest = np.empty(len(means))
    for start in range(0, len(means), 256):
        part = means[start : start + 256]
        apart = np.square(part[:, None] - means).sum(axis=2)
        apart[np.arange(len(part)), np.arange(start, start + len(part))] = np.inf
        nearest[start : start + len(part)] = np.sqrt(apart.min(axis=1))
    # On a surface, a sample is as many times as sparse as the root of what it leaves out.
    nearest *= np.sqrt(len(means) / count)
    middle = np.sort(scales.astype(np.float64), axis=1)[:, -2]
    good = np.isfinite(nearest) & (nearest > 0)
    if not good.any():
        return False
    with np.errstate(over="ignore"):
        as_logarithms = float(np.median(np.exp(middle[good]) / nearest[good]))
    as_scales = float(np.median(middle[good] / nearest[good]))
    return as_logarithms > _APART and _CLOSE < as_scales < _APART
