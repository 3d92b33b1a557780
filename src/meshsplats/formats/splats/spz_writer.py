"""Writes SPZ: version 3, one gzip stream, or 4, a Zstandard stream for each attribute (extra ``formats``).

Splats are sorted in space, unless they repeat each other as they are, and named by their smallest rotations,
so that streams compress well. Harmonics keep 5 bits at degree 1 and 4 bits beyond, as those of other writers.
"""

from __future__ import annotations

import math
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.errors import DataWarning
from meshsplats.formats._activation import log_scales
from meshsplats.formats._orientation import HALF_TURN_X
from meshsplats.formats.splats._quantising import as_bytes, nearest_axes, order_for_streams
from meshsplats.formats.splats._spz_layout import ANTIALIASED, COLOR_SCALE, MAGIC, REST, zstandard_modules
from meshsplats.formats.writing import FormatWriter, Writing, warn_of_losses
from meshsplats.scene.gaussians import LEAST_OPACITY, GaussianCloud

_FEWEST_BITS, _MOST_BITS = 12, 22
_STEPS = 8
"""Steps of positions, at least, in the deviation that most splats exceed along their second axis."""
_SMALLEST, _LARGEST = math.exp(-10), math.exp(255 / 16 - 10)
"""Range of deviations, scene units."""
_STEP = math.exp(1 / 16)
"""Of deviations, a factor."""
_SHOWS = 10
"""What is smaller than a tenth of most splats, and becomes no larger than that, does not show."""
_FIRST_BUCKET, _BUCKET = 8, 16
"""Steps of 1/128 in a step of harmonics of degree 1 and beyond."""
_GZIP_LEVEL, _REPEATED_LEVEL, _ZSTD_LEVEL = 4, 2, 9
"""Of splats that repeat each other, level 2 makes smaller files, and in less time."""


def write_spz(cloud: GaussianCloud, path: Path, writing: Writing) -> None:
    """Writes ``cloud``; see ``save_gaussians``. MissingDependencyError for version 4 without Zstandard."""
    compress = _compressor(writing.where) if writing.spz_version == 4 else None
    warn_of_losses(cloud, writing.where, keeps=("antialiased",))
    bits = _fraction_bits(cloud, writing.where)
    _warn_of_sizes(cloud, writing.where)
    if compress is None:
        path.write_bytes(_version_3(cloud, bits))
        return
    streams = _streams(cloud, bits, order_for_streams(cloud.means, cloud.quaternions))
    packed = [compress(stream) for stream in streams]
    head = _head(cloud, 4, bits, len(streams)) + struct.pack("<I12x", 32)
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
    with open(path, "wb") as file:
        file.writelines([head, table, *packed])


def spz_bytes(cloud: GaussianCloud, where: object) -> bytes:
    """A file of version 3 of ``cloud``; a DataWarning names ``where`` if its positions are too coarse, or
    its scales are out of range."""
    _warn_of_sizes(cloud, where)
    return _version_3(cloud, _fraction_bits(cloud, where))


def _version_3(cloud: GaussianCloud, bits: int) -> bytes:
    order = order_for_streams(cloud.means, cloud.quaternions)
    level = _REPEATED_LEVEL if isinstance(order, slice) else _GZIP_LEVEL
    packer = zlib.compressobj(level, zlib.DEFLATED, 31)
    parts = (_head(cloud, 3, bits), *_streams(cloud, bits, order))
    return b"".join([*map(packer.compress, parts), packer.flush()])


def _head(cloud: GaussianCloud, version: int, bits: int, streams: int = 0) -> bytes:
    """The first 16 bytes of a file."""
    flags = ANTIALIASED if cloud.kernel == "antialiased" else 0
    return struct.pack("<4sIIBBBB", MAGIC, version, len(cloud), cloud.sh_degree, bits, flags, streams)


def _compressor(where: object) -> Any:
    own, package = zstandard_modules(where)
    if own is not None:
        return lambda data: own.compress(data, _ZSTD_LEVEL)
    return package.ZstdCompressor(level=_ZSTD_LEVEL, write_checksum=True).compress


def _fraction_bits(cloud: GaussianCloud, where: object) -> int:
    """Bits behind the point of the 24 that positions have: as many as small splats need, if the farthest one
    leaves them. Warns where it does not."""
    farthest = float(np.abs(cloud.means).max())
    room = 23 - math.frexp(farthest)[1] if farthest else _MOST_BITS
    if round(farthest * 2.0**room) > 2**23 - 1:  # rounded up to the end of the range
        room -= 1
    size = _usual_size(cloud)
    wanted = math.ceil(math.log2(_STEPS / size)) if size else _MOST_BITS
    bits = max(0, min(max(wanted, _FEWEST_BITS), _MOST_BITS, room))
    if farthest * 2.0**bits > 2**23 or (size and size * 2.0**bits < 1):
        warnings.warn(
            f"{where}: SPZ stores positions in 24 bits; with splats as far as {farthest:.4g} their step is"
            f" {2.0**-bits:.3g}, where half of the splats are smaller than {size:.3g}: 'clean' removes far"
            " ones, .sog and .ply are finer",
            DataWarning,
            stacklevel=4,
        )
    return bits


def _usual_size(cloud: GaussianCloud) -> float:
    """The deviation that most splats exceed along their second axis."""
    return float(np.median(np.sort(cloud.scales, axis=1)[:, 1]))


def _warn_of_sizes(cloud: GaussianCloud, where: object) -> None:
    """Warns of visible splats that the range of scales makes smaller, or larger where that shows: of a scene
    whose splats are small as a whole."""
    sizes = np.sort(cloud.scales[cloud.opacities >= LEAST_OPACITY], axis=1)
    smaller = int((sizes[:, 2] > _LARGEST * _STEP).sum())
    shows = _usual_size(cloud) < _SHOWS * _SMALLEST
    larger = int((sizes[:, 1] < _SMALLEST / _STEP).sum()) if shows else 0
    if smaller or larger:
        warnings.warn(
            f"{where}: SPZ stores scales from {_SMALLEST:.2g} to {_LARGEST:.0f} scene units; {larger:,}"
            f" visible splats become larger and {smaller:,} smaller: .sog and .ply keep their sizes, or scale"
            " the scene",
            DataWarning,
            stacklevel=4,
        )


def _streams(cloud: GaussianCloud, bits: int, order: np.ndarray | slice) -> list[bytes]:
    """The attributes in the order of the file, its splats in ``order``, in the axes of the format; none of
    harmonics of degree 0."""
    cloud = cloud.take(order).transformed(HALF_TURN_X)
    quaternions, scales = nearest_axes(cloud.quaternions, cloud.scales)
    limit = 2**23 - 1
    fixed = np.clip(np.rint(cloud.means.astype(np.float64) * 2.0**bits), -limit, limit).astype("<i4")
    positions = np.ascontiguousarray(fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3])
    streams = [
        positions,
        as_bytes(cloud.opacities * np.float32(255)),
        as_bytes((np.float32(0.5) + np.float32(COLOR_SCALE) * cloud.sh[:, 0]) * np.float32(255)),
        as_bytes((log_scales(scales) + 10) * 16),
        _rotations(quaternions),
    ]
    if cloud.sh_degree:
        buckets = np.full((REST[cloud.sh_degree], 1), _BUCKET, np.float32)
        buckets[:3] = _FIRST_BUCKET
        streams.append(as_bytes(np.rint(cloud.sh[:, 1:] * 128 / buckets) * buckets + 128))
    return [stream.tobytes() for stream in streams]


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """(n,) words: the index of w, the largest of x, y, z, w, and the others in 9 bits and a sign each."""
    small = quaternions[:, 1:]
    sizes = np.minimum(np.rint(np.abs(small) * np.float32(np.sqrt(2) * 511)), 511).astype(np.uint32)
    fields = sizes | (small < 0).astype(np.uint32) << 9
    words = np.full(len(small), 3 << 30, np.uint32)
    for i in range(3):
        words |= fields[:, i] << np.uint32(10 * (2 - i))
    return words.astype("<u4")


def _bytes_a_splat(coefficients: int) -> float:
    return 18 + 1.2 * (coefficients - 1)


WRITER = FormatWriter(write_spz, _bytes_a_splat, ("spz_version",))
