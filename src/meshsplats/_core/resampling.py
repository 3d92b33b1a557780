"""Images looked up between their pixels, in the compiled core."""

from __future__ import annotations

import numpy as np

from meshsplats._core.library import pointer, run, thread_count
from meshsplats._core.structures import ResamplingStruct


def resample(
    image: np.ndarray, points: np.ndarray, *, wraps: bool = False, threads: int | None = None
) -> np.ndarray:
    """(..., c) of the image's type: ``image`` (h, w, c), uint8 or float32, at ``points`` (..., 2) float32.

    Bilinear, and bytes are rounded. Points are column and row, whole at the centres of pixels; beyond the
    border the values there count, and NaN gives 0. ``wraps``: the first column follows the last one.
    """
    height, width, channels = image.shape
    image, points = np.ascontiguousarray(image), np.ascontiguousarray(points)
    result = np.zeros((*points.shape[:-1], channels), image.dtype)
    whole = image.dtype == np.uint8
    run(
        "ms_resample",
        ResamplingStruct(
            points=pointer(points),
            bytes=pointer(image) if whole else None,
            values=None if whole else pointer(image),
            result=pointer(result),
            count=points.size // 2,
            height=height,
            width=width,
            channels=channels,
            wraps=wraps,
            threads=thread_count(threads),
        ),
    )
    return result
