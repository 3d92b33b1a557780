"""Origins: the points that float32 coordinates are relative to, where the world is wider than float32.

float32 has 24 bits. At a northing of 4,500,000 m its step is half a metre, so a georeferenced scene keeps its
detail only relative to a point nearby. Arrays hold coordinates relative to that origin; world = origin +
local, in float64.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

REACH = 64
"""Distance from (0, 0, 0), in extents of the scene, up to which float32 is fine enough: 17 of its 24 bits
are left for places in the scene, half a millimetre in 60 m."""
FAR = 10_000.0
"""Least distance across, and greatest height, of the coordinates of a survey, in metres or feet. Those that
were turned to y up have a northing for a height."""
FEWEST_STEPS = 1 << 10
"""Steps across a scene below which what a float32 file itself has lost shows in images."""
SAMPLE = 1 << 12
"""Positions that the choice of an origin looks at, about."""
_SHARE = 0.05
"""Share of the positions at either end that do not count for the extent: outliers."""


_LOST = "precision is lost; double coordinates, or coordinates relative to a point nearby, keep it"


def zero_origin() -> np.ndarray:
    """(3,) float64 zeros: coordinates are those of the world."""
    return np.zeros(3)


def choose_origin(positions: np.ndarray) -> np.ndarray:
    """The origin for a scene of ``positions`` (n, 3) float64 in the world: (3,) float64.

    Zero for a scene that is no farther away than ``REACH`` times its extent, so that coordinates stay as they
    are, unless they are those of a survey: ``FAR`` away, and farther than the scene is wide. Zero also for
    positions without an extent. Else the median, rounded to a power of ten of at most the extent (below 1: a
    power of two). The nearest and farthest positions along each axis, one in twenty, do not count.
    """
    found = _spread(positions)
    if found is None:
        return zero_origin()
    center, extent, farthest = found
    away = float(np.abs(center).max())
    surveyed = away >= FAR and away > extent
    if (farthest <= REACH * extent and not surveyed) or extent <= 2.0**-52 * farthest:
        return zero_origin()
    unit = 10.0 ** math.floor(math.log10(extent)) if extent >= 1 else 2.0 ** math.floor(math.log2(extent))
    return np.round(center / unit) * unit + 0.0


def lost_detail(positions: np.ndarray) -> str:
    """What a file that stores ``positions`` (n, 3), a sample of them, as float32 has lost, in words; empty
    unless there are fewer than ``FEWEST_STEPS`` steps across the scene."""
    coarse = _coarse(positions)
    if coarse is None:
        return ""
    return f"positions {coarse}: {_LOST}"


def lost_between(positions: np.ndarray, size: float) -> str:
    """As ``lost_detail``, where there are steps enough across the scene, but larger ones than what is there:
    splats or triangles of that ``size``. What is smaller than the steps of a scene around zero is a point."""
    found = _spread(positions)
    if found is None:
        return ""
    center, extent, farthest = found
    step = _step(farthest)
    if not 0 < size < step or size < _step(extent) or _is_coarse(extent, farthest):
        return ""
    where = f"positions near {in_words(np.round(center))} are stored as float32, in steps of {step:g}"
    return f"{where}, of what is {size:.2g} large: {_LOST}"


def usual_size(scales: np.ndarray) -> float:
    """The median of the largest standard deviations (n, 3) of splats, of a sample of them."""
    return float(np.median(sampled(scales).max(axis=1)))


def lost_by_rounding(name: str, exact: ArrayLike) -> str:
    """What positions ``exact`` (n, 3), if they are float64, lose as float32, in words; empty unless there are
    fewer than ``FEWEST_STEPS`` steps across them. Looks at a sample."""
    given = np.asarray(exact)
    if given.dtype.kind != "f" or given.dtype.itemsize <= 4:
        return ""
    sample = sampled(given)
    coarse = _coarse(sample)
    if coarse is None or (sample == sample.astype(np.float32)).all():
        return ""
    return f"{name} {coarse}: precision is lost; relative to a point nearby (``origin``), they keep it"


def loses_detail(local: np.ndarray, shift: np.ndarray) -> bool:
    """Whether positions ``local`` (n, 3) have their detail in float32, but not after a ``shift`` (3,)."""
    sample = sampled(local)
    return _coarse(sample) is None and _coarse(sample + shift) is not None


def need_detail(samples: Mapping[Any, np.ndarray], origin: np.ndarray) -> None:
    """Raises ValueError for one of several files, ``samples`` (n, 3) float64 of their positions by name, that
    has fewer than ``FEWEST_STEPS`` float32 steps across it relative to their one ``origin``."""
    found = {name: spread for name, sample in samples.items() if (spread := _spread(sample - origin))}
    for name, (center, extent, farthest) in found.items():
        if not _is_coarse(extent, farthest):
            continue
        other = max(found, key=lambda place: float(np.linalg.norm(found[place][0] - center)))
        at, beside = (in_words(choose_origin(samples[place])) for place in (name, other))
        lost = (
            f"relative to {in_words(origin)}, places in {name} would be in steps of {_step(farthest):g}"
            f" across an extent of {extent:.3g}"
        )
        if 2 * np.linalg.norm(found[other][0] - center) < np.linalg.norm(center):
            text = f"{name}, around {at}, is too far from the origin that is given"
            raise ValueError(f"{text}: {lost}; give one nearby, or none")
        raise ValueError(
            f"{name}, around {at}, and {other}, around {beside}, are too far apart for one result: {lost};"
            " take each file by itself, or give both coordinates of one world"
        )


def _coarse(positions: np.ndarray) -> str | None:
    """Where ``positions`` (n, 3) are and how coarse float32 is there, in words; None unless there are fewer
    than ``FEWEST_STEPS`` steps across them."""
    found = _spread(positions)
    if found is None:
        return None
    center, extent, farthest = found
    if not _is_coarse(extent, farthest):
        return None
    near, step = in_words(np.round(center)), _step(farthest)
    return f"near {near} are stored as float32, in steps of {step:g} across an extent of {extent:.3g}"


def _is_coarse(extent: float, farthest: float) -> bool:
    """Whether fewer than ``FEWEST_STEPS`` steps are left across an ``extent`` that reaches so far."""
    return 0 < extent < FEWEST_STEPS * _step(farthest)


def _step(farthest: float) -> float:
    """The step of float32 at that coordinate."""
    return 2.0 ** (math.floor(math.log2(farthest)) - 23) if farthest else 0.0


def _spread(positions: np.ndarray) -> tuple[np.ndarray, float, float] | None:
    """Median (3,), extent, and the greatest coordinate; None without positions that float32 could hold."""
    holds = np.abs(positions) <= np.finfo(np.float32).max  # False for NaN
    finite = positions[holds.all(axis=1)].astype(np.float64, copy=False)
    if not len(finite):
        return None
    low, center, high = np.quantile(finite, [_SHARE, 0.5, 1 - _SHARE], axis=0)
    return center, float((high - low).max()), float(np.abs([low, high]).max())


def sampled(positions: np.ndarray) -> np.ndarray:
    """About ``SAMPLE`` of the rows of ``positions`` (n, 3), evenly spread, as float64."""
    return positions[:: max(1, len(positions) // SAMPLE)].astype(np.float64)


def relative(local: np.ndarray, own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """``local`` (n, 3) float32 coordinates, of the origin ``own``, relative to the origin ``other``: float64
    where that moves them."""
    return local if (own == other).all() else local + (own - other)


def shared_origin(origins: Iterable[np.ndarray]) -> np.ndarray:
    """The origin for records of ``origins`` that are joined: that of the first one that is not zero."""
    found = list(origins)
    return next((origin for origin in found if origin.any()), found[0] if found else zero_origin())


def need_one_origin(records: Mapping[str, Any]) -> None:
    """Raises ValueError unless the ``records``, by name, that are not None are relative to one origin."""
    known = [(name, record) for name, record in records.items() if record is not None]
    for name, record in known[1:]:
        first, wanted = known[0]
        if (record.origin != wanted.origin).any():
            raise ValueError(
                f"{first} is relative to {in_words(wanted.origin)}, {name} to {in_words(record.origin)}:"
                f" give {name}.relative_to({first}.origin)"
            )


def in_words(origin: Iterable[float]) -> str:
    """``origin`` as text that ``float`` reads back exactly, without digits that say nothing."""
    return " ".join(repr(int(x)) if x == int(x) and abs(x) < 1e15 else repr(float(x)) for x in origin)
