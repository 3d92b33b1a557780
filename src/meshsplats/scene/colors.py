"""Display (sRGB-encoded) and linear colour values.

The curve is that of IEC 61966-2-1: a straight piece near black, a power of 2.4 above. Alpha is never encoded;
pass colour channels only.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_CHUNK = 1 << 15
"""Values per chunk: intermediate results stay in the processor's cache."""


def srgb_to_linear(display: np.ndarray) -> np.ndarray:
    """Linear light of ``display`` values in [0, 1], any shape; float32, in [0, 1].

    Concretely, ``v / 12.92`` up to 0.04045 and ``((v + 0.055) / 1.055) ** 2.4`` above. Values outside [0, 1]
    follow the same two formulas.
    """
    return _in_chunks(_decode, display)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Display values of ``linear`` light in [0, 1], any shape; float32. Inverse of ``srgb_to_linear``.

    Concretely, ``12.92 v`` up to 0.0031308 and ``1.055 v ** (1 / 2.4) - 0.055`` above. Values outside [0, 1]
    follow the same two formulas.
    """
    return _in_chunks(_encode, linear)


def encoding_slope(linear: np.ndarray) -> np.ndarray:
    """Derivative of ``linear_to_srgb``, float32; the slope of its linear part at 0 and below."""
    power = np.maximum(linear, np.float32(0.0031308)) ** np.float32(1 / 2.4 - 1)
    return np.where(linear <= np.float32(0.0031308), np.float32(12.92), np.float32(1.055 / 2.4) * power)


def _decode(v: np.ndarray) -> np.ndarray:
    # The power is not used below the limit; the maximum avoids a negative base there.
    curve = np.power((np.maximum(v, np.float32(0)) + np.float32(0.055)) / np.float32(1.055), np.float32(2.4))
    return np.where(v <= np.float32(0.04045), v / np.float32(12.92), curve)


def _encode(v: np.ndarray) -> np.ndarray:
    power = np.power(np.maximum(v, np.float32(0)), np.float32(1 / 2.4))
    curve = np.float32(1.055) * (power - 1) + 1  # = 1.055 power - 0.055, and exactly 1 at 1
    return np.where(v <= np.float32(0.0031308), v * np.float32(12.92), curve)


def _in_chunks(function: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> np.ndarray:
    values = np.asarray(values, np.float32)
    result = np.empty(values.shape, np.float32)
    source, target = values.reshape(-1), result.reshape(-1)
    for start in range(0, source.size, _CHUNK):
        target[start : start + _CHUNK] = function(source[start : start + _CHUNK])
    return result
