"""Checks of arrays for the data classes; samples of sequences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar, overload

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike

T = TypeVar("T")


@overload
def subsample(items: np.ndarray, most: int) -> np.ndarray: ...
@overload
def subsample(items: tuple[T, ...], most: int) -> tuple[T, ...]: ...
@overload
def subsample(items: Sequence[T], most: int) -> Sequence[T]: ...
def subsample(items: Sequence[T] | np.ndarray, most: int) -> Sequence[T] | np.ndarray:
    """Every k-th of ``items``, a sequence or array, with the least k that leaves at most ``most``."""
    return items[:: max(1, -(-len(items) // most))]


def spread_indices(count: int, most: int) -> list[int]:
    """At most ``most`` indices below ``count``, ascending, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def nonzero_rows(array: np.ndarray) -> np.ndarray:
    """(n,) bool: whether ``array`` (n, k) has a value other than 0 in each row. Several times as fast as
    ``any``."""
    found = array[:, 0] != 0
    for column in array.T[1:]:
        found |= column != 0
    return np.asarray(found)


def checked_array(name: str, value: ArrayLike, dtype: DTypeLike, shape: tuple[int | None, ...]) -> np.ndarray:
    """``value`` as a C-contiguous array of ``dtype``; ``None`` in ``shape`` admits any length.

    An array that already is one is returned itself, after one pass over its values where they are floats.
    Raises TypeError if the values are not numbers, ValueError if the shape differs or a value is not finite.
    """
    try:
        given = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:
        # Ragged lists; tensors with gradients, or on a GPU.
        way = f"; {name}.detach().cpu().numpy() is an array" if hasattr(value, "detach") else ""
        raise TypeError(f"{name} must hold numbers, got a {type(value).__name__}: {error}{way}") from None
    if given.dtype.kind not in "fiub":
        what = f"a {type(value).__name__}" if given.ndim == 0 else f"dtype {given.dtype}"
        raise TypeError(f"{name} must hold numbers, got {what}")
    if given.ndim != len(shape) or any(
        s is not None and s != g for s, g in zip(shape, given.shape, strict=True)
    ):
        sides = ", ".join("n" if s is None else str(s) for s in shape)
        wanted = f"({sides},)" if len(shape) == 1 else f"({sides})"
        raise ValueError(f"{name} must have shape {wanted}, got {given.shape}")
    if np.dtype(dtype).kind == "i":
        if given.dtype.kind == "f":
            raise TypeError(f"{name} must hold integers, got dtype {given.dtype}")
        limits = np.iinfo(np.dtype(dtype))
        fits = np.can_cast(given.dtype, dtype)
        if not fits and given.size and (given.min() < limits.min or given.max() > limits.max):
            raise ValueError(
                f"{name} must fit {np.dtype(dtype).name}, got values from {given.min()} to {given.max()}"
            )
    array = np.ascontiguousarray(given, dtype=dtype)
    # The sum is not finite if any term is not. Each is checked only then, or where large values overflow it.
    if array.dtype.kind == "f" and array.size:
        with np.errstate(over="ignore", invalid="ignore"):
            suspicious = not np.isfinite(array.sum())
        if suspicious:
            bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1)
            if bad.any():
                raise ValueError(
                    f"{name} must be finite, row {int(bad.argmax())} is not ({int(bad.sum())} such rows)"
                )
    return array
