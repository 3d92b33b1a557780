"""Checks of arrays for the data classes; their rows, chosen and joined; samples of sequences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import FrozenInstanceError
from typing import TYPE_CHECKING, Any, TypeVar, overload

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike

T = TypeVar("T")
_BRIGHTEST = 16
"""Times white. Single pixels of an image may be brighter, most of it never is."""


@overload
def subsample(items: np.ndarray, most: int) -> np.ndarray: ...
@overload
def subsample(items: tuple[T, ...], most: int) -> tuple[T, ...]: ...
@overload
def subsample(items: Sequence[T], most: int) -> Sequence[T]: ...
def subsample(items: Sequence[T] | np.ndarray, most: int) -> Sequence[T] | np.ndarray:
    """At most ``most`` of ``items``, a sequence or array, evenly spread, from the first on: every k-th where
    they are k times as many, also around a circle."""
    count = len(items)
    if count <= most:
        return items
    rows = np.arange(most, dtype=np.int64) * count // most
    if isinstance(items, np.ndarray):
        return np.asarray(items[rows])
    chosen = [items[i] for i in rows.tolist()]
    return tuple(chosen) if isinstance(items, tuple) else chosen


def area_means(values: np.ndarray, height: int, width: int) -> np.ndarray:
    """(height, width, ...) float32 means of ``values`` (h, w, ...) over as many equal areas; entries at their
    borders count by the share that lies in each."""
    return _span_means(_span_means(values, height, 0), width, 1)


def _span_means(values: np.ndarray, size: int, axis: int) -> np.ndarray:
    before = values.shape[axis]
    edges = np.linspace(0, before, size + 1)
    first = np.minimum(edges[:-1].astype(int), before - 1)
    shape = [1] * values.ndim
    shape[axis] = size
    result = np.zeros((*values.shape[:axis], size, *values.shape[axis + 1 :]), np.float32)
    for k in range(int((np.ceil(edges[1:] - 1e-9) - first).max())):
        # Each span holds the k-th entry from its first one by this share.
        share = np.minimum(edges[1:], first + k + 1) - np.maximum(edges[:-1], first + k)
        share = np.maximum(share, 0) * (size / before)
        entries = np.take(values, np.minimum(first + k, before - 1), axis=axis).astype(np.float32, copy=False)
        entries *= share.astype(np.float32).reshape(shape)
        result += entries
    return result


def block_means(values: np.ndarray, side: int) -> np.ndarray:
    """(h, w, ...) float32: means of blocks of ``side`` x ``side`` of ``values``, without what is left over at
    the ends of their first two axes. Several times as fast as ``mean`` over two axes."""
    height, width = (n // side * side for n in values.shape[:2])
    total = np.zeros((height // side, width // side, *values.shape[2:]), np.float32)
    for y in range(side):
        for x in range(side):
            total += values[y:height:side, x:width:side]
    total /= side * side
    return total


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


def chosen_rows(chosen: ArrayLike | slice, count: int, of: str) -> np.ndarray:
    """Indices of the rows that ``chosen`` names, a (count,) mask, indices or a slice, in its order.

    Raises ValueError, which says what the rows are ``of``, for a mask of another length, and for indices that
    are no rows.
    """
    if isinstance(chosen, slice):
        return np.arange(count)[chosen]
    given = np.asarray(chosen)
    if given.dtype == bool:
        if given.shape != (count,):
            raise ValueError(f"a mask of {of} must have shape ({count},), got {given.shape}")
        return np.flatnonzero(given)
    if given.ndim != 1 or (given.size and given.dtype.kind not in "iu"):
        raise ValueError(
            f"{of} are chosen by a mask, a slice or indices (n,), got {given.dtype} of shape {given.shape}"
        )
    if given.size and (given.min() < -count or given.max() >= count):
        raise ValueError(f"indices of {count:,} {of}, got {given.min()} to {given.max()}")
    return given.astype(np.int64, copy=False)


def joined_rows(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of meshes, by name, one part behind the other; ``faces`` number the ``vertices`` of their
    part, and those of all parts in the result. Arrays that a part lacks are left out.

    Raises ValueError for more vertices or triangles than int32 can number.
    """
    if len(parts) == 1:
        return dict(parts[0])
    for name in ("vertices", "faces"):
        count = sum(len(part[name]) for part in parts)
        if count > np.iinfo(np.int32).max:
            raise ValueError(f"{count:,} {name} are more than a mesh can number")
    names = [name for name in parts[0] if all(name in part for part in parts)]
    joined = {name: np.concatenate([part[name] for part in parts]) for name in names if name != "faces"}
    joined["faces"] = np.empty((sum(len(part["faces"]) for part in parts), 3), np.int32)
    row = first = 0
    for part in parts:
        faces = part["faces"]
        np.add(faces, np.int32(first), out=joined["faces"][row : row + len(faces)])
        row, first = row + len(faces), first + len(part["vertices"])
    return joined


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
    if np.dtype(dtype).kind in "iu":
        if given.dtype.kind == "f":
            raise TypeError(f"{name} must hold integers, got dtype {given.dtype}")
        limits = np.iinfo(np.dtype(dtype))
        fits = np.can_cast(given.dtype, dtype)
        if not fits and given.size and (given.min() < limits.min or given.max() > limits.max):
            raise ValueError(
                f"{name} must fit {np.dtype(dtype).name}, got values from {given.min()} to {given.max()}"
            )
    with np.errstate(over="ignore"):  # what is infinite then is refused
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


def check_units(name: str, image: np.ndarray) -> None:
    """Raises ValueError for a float ``image`` of values from 0 to 255, where white is 1. Looks at some of the
    rows of large ones."""
    rows = image[:: 1 + (image.size >> 18)]
    high = rows.max(initial=0)
    if high > _BRIGHTEST and np.median(rows[rows > 0]) > 1:
        raise ValueError(f"{name} must hold values from 0 to 1, got up to {high:g}: divide bytes by 255")


def check_faces(faces: np.ndarray, vertices: int) -> None:
    """Raises ValueError unless the int32 ``faces`` (f, 3) number some of so many ``vertices``. Renderers and
    writers ask again: what was written into a mesh since would take their process down."""
    if len(faces) and faces.view(np.uint32).max() >= vertices:  # in one pass: -1 is large, too
        raise ValueError(
            f"faces must be vertex indices from 0 to {vertices - 1}, got {faces.min()} to {faces.max()}"
        )


def guarded(cls: type[T]) -> type[T]:
    """The frozen dataclass of arrays ``cls``, which says how to change a field where one is assigned.

    ``cloud.means += 1`` changes the array first and assigns it then, so that the error comes too late.
    """

    def refuse(self: Any, name: str, value: object) -> None:
        done = ""
        if isinstance(value, np.ndarray) and value is getattr(self, name, None):
            done = " The operation has changed the array in place already, here and wherever it is shared."
        raise FrozenInstanceError(
            f"cannot assign to {name!r} of a {cls.__name__}, which does not change: dataclasses.replace(it,"
            f" {name}=...) makes another.{done}"
        )

    cls.__setattr__ = refuse  # type: ignore[method-assign]
    return cls


def checked_attributes(attributes: Mapping[str, ArrayLike], rows: int) -> dict[str, np.ndarray]:
    """``attributes`` by name as float32 arrays (rows,) or (rows, c). The errors of ``checked_array``."""
    checked = {}
    for name, value in attributes.items():
        ndim = np.ndim(value)
        if ndim not in (1, 2):
            raise ValueError(
                f"attribute {name!r} must have one row for each vertex, got shape {np.shape(value)}"
            )
        checked[name] = checked_array(f"attribute {name!r}", value, np.float32, (rows, None)[:ndim])
    return checked
