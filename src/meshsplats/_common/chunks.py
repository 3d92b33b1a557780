"""Work on long arrays, in chunks that fit the processor's cache."""

from __future__ import annotations

import numpy as np

SINGLE_THREADED = 200_000
"""Multiplications up to which OpenBLAS computes a product in one thread. More threads are no faster on
products this thin, and far slower where another program occupies a processor: all wait for that one."""


def thin_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``a @ b`` of (n, k) and (k, m), for large n and small k and m."""
    out = np.empty((len(a), b.shape[1]), np.result_type(a, b))
    step = max(1, SINGLE_THREADED // b.size)
    for begin in range(0, len(a), step):
        np.matmul(a[begin : begin + step], b, out=out[begin : begin + step])
    return out


def chunks(n: int, size: int) -> list[slice]:
    """Slices of ``size`` (the last may be shorter) that together are 0 to ``n``."""
    return [slice(begin, min(begin + size, n)) for begin in range(0, n, size)]
