"""The orders in which the triangles of a mesh are blended."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

if TYPE_CHECKING:
    import numpy as np


Order = Literal["fragment", "splat"]
"""fragment: the triangles are sorted at every sample. splat: whole splats are, by their centres."""


def checked_order(order: str, face_splat: np.ndarray | None) -> Order:
    """``order`` as the drawing order of a mesh with that ``face_splat``.

    Raises ValueError for another word, or 'splat' without ``face_splat``.
    """
    if order not in get_args(Order):
        raise ValueError(f"order must be {' or '.join(map(repr, get_args(Order)))}, got {order!r}")
    if order == "splat" and face_splat is None:
        raise ValueError(
            "order='splat' blends whole splats, but the mesh has no face_splat: give it one, or"
            " order='fragment'"
        )
    return order  # type: ignore[return-value]
