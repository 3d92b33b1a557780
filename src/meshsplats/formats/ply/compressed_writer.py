"""Writes PlayCanvas compressed .ply: 16 bytes a splat, and one for each harmonic beyond the first.

Chunks of 256 splats share the ranges of their values, so splats are sorted in space.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshsplats.formats._activation import log_scales
from meshsplats.formats.ply.header import origin_comments
from meshsplats.formats.ply.notes import note_comments
from meshsplats.formats.splats._quantising import as_bytes, nearest_axes, sorted_in_space
from meshsplats.formats.writing import FormatWriter, Writing
from meshsplats.scene.gaussians import SH_C0, GaussianCloud

_SHARED = 256
_LEAST_LOG, _MOST_LOG = -20.0, 20.0
"""Of scales: an axis without extent must not take the steps of the others."""


def write_compressed_ply(cloud: GaussianCloud, path: Path, writing: Writing) -> None:
    """Writes ``cloud``; see ``save_gaussians``."""
    cloud = cloud.take(sorted_in_space(cloud.means))
    flat = cloud.kernel == "2dgs"
    quaternions, scales = nearest_axes(cloud.quaternions, cloud.scales, third_stays=flat)
    logs = np.clip(log_scales(scales), _LEAST_LOG, _MOST_LOG)
    colors = np.float32(0.5) + np.float32(SH_C0) * cloud.sh[:, 0]
    ranges, words = [], np.empty((len(cloud), 4), "<u4")
    for column, values, bits in (
        (0, cloud.means, (11, 10, 11)),
        (2, logs, (11, 10, 11)),
        (3, colors, (8,) * 3),
    ):
        low, high, shares = _in_chunks(values)
        ranges += [low, high]
        words[:, column] = _packed(shares, bits)
    words[:, 1] = _rotations(quaternions)
    words[:, 3] = words[:, 3] << 8 | as_bytes(cloud.opacities * np.float32(255))
    rest = cloud.sh[:, 1:].transpose(0, 2, 1).reshape(len(cloud), -1)  # all of red first, as f_rest_*
    # A byte means the middle of its step of 1/32 in [-4, 4]; 0 and 255 mean the ends.
    steps = np.clip(np.floor((rest / 8 + np.float32(0.5)) * 256), 0, 255).astype(np.uint8)
    with open(path, "wb") as file:
        file.write("\n".join(_header(cloud, len(ranges[0]))).encode("ascii"))
        file.write(np.concatenate(ranges, axis=1).astype("<f4").data)
        file.write(words.data)
        file.write(np.ascontiguousarray(steps).data)


def _header(cloud: GaussianCloud, chunks: int) -> list[str]:
    lines = ["ply", "format binary_little_endian 1.0", *origin_comments(cloud.origin)]
    lines += note_comments(cloud.kernel, cloud.up)
    if cloud.kernel == "2dgs":  # as Brush writes it: there are three scales all the same
        lines.append("comment SplatRenderMode: 2dgs")
    lines.append(f"element chunk {chunks}")
    for group in ("", "scale_"):
        lines += [f"property float {end}_{group}{axis}" for end in ("min", "max") for axis in "xyz"]
    lines += [f"property float {end}_{channel}" for end in ("min", "max") for channel in "rgb"]
    lines.append(f"element vertex {len(cloud)}")
    lines += [f"property uint packed_{what}" for what in ("position", "rotation", "scale", "color")]
    if cloud.sh_degree:
        lines.append(f"element sh {len(cloud)}")
        lines += [f"property uchar f_rest_{i}" for i in range(3 * (cloud.sh.shape[1] - 1))]
    return [*lines, "end_header", ""]


def _in_chunks(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least and greatest ``values`` (n, 3) of each chunk, and where between them each value lies, 0 to 1."""
    starts = np.arange(0, len(values), _SHARED)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    chunk = np.arange(len(values)) // _SHARED
    span = (high - low).astype(np.float64)
    shares = (values - low[chunk]) / np.where(span > 0, span, 1)[chunk]
    return low, high, shares


def _packed(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """(n,) words of fields, the first one on top."""
    words = np.zeros(len(shares), np.uint32)
    for column, width in enumerate(bits):
        field = np.rint(shares[:, column] * ((1 << width) - 1)).astype(np.uint32)
        words = words << np.uint32(width) | field
    return words


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """(n,) words: 0, the index of the largest of w, x, y, z, and the others in 10 bits each."""
    shares = quaternions[:, 1:] / np.float32(np.sqrt(2)) + np.float32(0.5)
    return _packed(shares, (10, 10, 10))


def _bytes_a_splat(coefficients: int) -> float:
    return 16.3 + 3 * (coefficients - 1)


WRITER = FormatWriter(write_compressed_ply, _bytes_a_splat)
