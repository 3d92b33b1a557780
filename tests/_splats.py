"""Splats for tests, and what is expected of readers that refuse a file."""

from __future__ import annotations

import re
import tracemalloc

import numpy as np
import pytest

from meshsplats import FileFormatError, GaussianCloud, load_gaussians


def harmonics_of_3dgs(x, y, z):
    """(16,) basis values along a unit vector: the polynomials of the 3DGS code, constants typed out."""
    return np.array(
        [
            0.28209479177387814,
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    )


def few_splats():
    """Forty of degree 0, none of them faint."""
    rng = np.random.default_rng(0)
    n = 40
    return GaussianCloud(
        rng.normal(size=(n, 3)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        rng.uniform(0.05, 0.3, (n, 3)),
        rng.uniform(0.2, 0.95, n),
        rng.normal(size=(n, 1, 3)),
    )


def refused(path, message, memory):
    """Whether reading ``path`` fails with one clear error that matches, below ``memory`` bytes."""
    tracemalloc.start()
    with pytest.raises(FileFormatError) as caught:
        load_gaussians(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    text = str(caught.value)
    assert text.startswith(str(path))
    assert re.search(message, text[len(str(path)) :]), text  # the path may hold the words looked for
    assert len(text) < 500
    assert peak < memory
