"""simplify: fewer splats that look the same from a distance, by merging pairs.

Splats are merged pair by pair; dropping some of them would tear holes. A pair becomes one splat of the same
mass, mean and covariance, and colours are averaged by mass. Mass is integrated optical depth: that of a splat
of opacity o, ``-log(1 - o exp(-r^2 / 2))``, is ``2 pi Li2(o)`` over the plane of its standard deviations
(Li2: the dilogarithm, the sum of ``o^k / k^2``), times the mean area of its projections. It adds up where
splats lie behind each other, and as long as opacities are small it is opacity times area. Splats that lie
beside each other and cover more than one opaque splat of their covariance would become a wider one.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.chunks import chunks
from meshsplats._common.geometry import quaternions_of
from meshsplats._common.kinds import need, need_all
from meshsplats._core.library import check_threads, processors
from meshsplats.conversion.footprint import CameraCoverage, usual_pixels, widen
from meshsplats.conversion.merging_coverage import Parts, Wholes, covered_shares
from meshsplats.conversion.merging_groups import Groups, Moments, covariances_of, groups_of
from meshsplats.conversion.merging_weights import pixels_of
from meshsplats.conversion.selection import disc_areas, mean_shadow
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import LEAST_OPACITY, LOW_PASS_PX2, GaussianCloud, Kernel

BLOCK = 1 << 16
"""Splats that ``simplify_in_blocks`` merges at a time."""

LARGE = 1_000_000
"""Splats from which on they are merged in blocks for cameras: 12 million took 7.5 GB together."""

CHUNK = 1 << 14
"""Splats whose masses are computed together: so many stay in the cache."""

DENSE = 0.9
"""Integrated optical depth of a merged splat, over that of its two standard deviations, from which its parts
may cover more than it does: their opacities add up to less than this."""

SOLID, SOLID_SHARE = 0.98, 0.95
"""Splats of at least the first opacity that have at least the second share of all mass are a surface sampled
by opaque splats..."""
MERGED_OPAQUE = np.float32(1 - 2**-20)
"""...unless they have this one, which merged ones get that are so opaque, and keep as logits in files: no
cloud becomes such a surface by merging. Such surfaces..."""
SOLID_COVER = 1.4
"""...cover this multiple of their area when they are merged: through gaps between merged ones shows what is
behind all."""

FEWEST_OF_BLOCK = 64
"""Splats that it leaves of a block at least, before the blocks are joined."""


def simplify(
    cloud: GaussianCloud,
    count: int,
    *,
    cameras: Sequence[Camera] | None = None,
    low_pass: float | np.ndarray | None = None,
    threads: int | None = None,
) -> GaussianCloud:
    """``cloud`` as ``count`` splats, by merging similar ones; the cloud itself if it has no more.

    Neighbours are merged, always the pair of least cost: growth of the area and difference in colour, in
    proportion to their mass. Mass, mean and covariance of the whole are preserved; spherical harmonics of
    every degree are averaged by mass. A splat that was not merged keeps its values to the last bit. Splats
    that cover more, beside each other, than one opaque splat of their covariance become a wider one of the
    same axes; mass beyond that of an opaque splat is lost: many opaque layers become one. Splats of less
    opacity than 1/255, which are never drawn, have no mass and go first.

    Merged splats have the cloud's kernel. Those of '2dgs' stay flat: the smallest of their three axes is
    dropped, with its part of the covariance.

    Args:
        cloud: the splats.
        count: how many to keep, at least 1.
        cameras: where the result will be seen from. Splats count by the pixels that show them, so that what
            is near stays fine, and what is hidden or out of sight becomes coarse; and the cameras give the
            size of a pixel at each splat for ``low_pass``. Default: images of 1000 pixels from all sides that
            just hold the subject, whose splats count by their own area.
        low_pass: standard deviation, in scene units, of the low-pass filter that the splats are drawn with:
            one number or (n,), >= 0. Finer differences do not count, and splats narrower than the filter
            count as widened by it (but for 'antialiased'). Default: sqrt(0.3) pixels, sqrt(0.5) for '2dgs'.
        threads: at most this many; all processors by default. The result has the same bits with any number.

    Returns:
        A cloud of min(count, n) splats, in the order of the first of the splats merged into each.

    Raises:
        ValueError: ``count``, ``low_pass`` or ``threads`` out of range.
        MemoryError: the work does not fit; it takes about 600 bytes a splat, and 80 MB a thread.
    """
    need(GaussianCloud, cloud=cloud)
    need_all(Camera, cameras=cameras, optional=True)
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
        raise ValueError(f"count must be a whole number of splats, at least 1, got {count!r}")
    check_threads(threads)
    if count >= len(cloud):
        return cloud
    coverage = CameraCoverage(cloud.means, cameras) if cameras else None
    if low_pass is None:
        low_pass = _usual_low_pass(cloud, cameras, coverage)
    width = _checked_width(low_pass, len(cloud))
    masses = _masses(cloud, width)
    counted = pixels_of(cloud, masses, coverage, threads) if coverage else masses
    return _merge(cloud, count, width, masses, counted, threads).cloud


def simplify_large(
    cloud: GaussianCloud, count: int, cameras: Sequence[Camera] | None, threads: int | None = None
) -> GaussianCloud:
    """``simplify``, in blocks where ``cameras`` say how much of each is seen, and there are many splats."""
    if cameras and len(cloud) > LARGE:
        return simplify_in_blocks(cloud, count, cameras=cameras, threads=threads)
    return simplify(cloud, count, cameras=cameras, threads=threads)


def simplify_in_blocks(
    cloud: GaussianCloud,
    count: int,
    *,
    cameras: Sequence[Camera] | None = None,
    block: int = BLOCK,
    threads: int | None = None,
) -> GaussianCloud:
    """``simplify`` for large clouds: block by block of space, in half the time and little memory beside the
    cloud's.

    Blocks of at most ``block`` splats, cut at medians, keep equal shares of their visible splats, or, with
    ``cameras``, as many as they cover pixels. Pairs across their borders are not merged: images are as good
    (benchmarks/results/viewer.md). Splats are ordered by block.
    """
    if len(cloud) <= block or count >= len(cloud):
        return simplify(cloud, count, cameras=cameras, threads=threads)
    coverage = CameraCoverage(cloud.means, cameras) if cameras else None
    low_pass = _usual_low_pass(cloud, cameras, coverage)
    masses = _masses(cloud, low_pass)
    counted = pixels_of(cloud, masses, coverage, threads) if coverage else masses
    blocks = _blocks(cloud.means, np.arange(len(cloud)), block)
    visible = np.array([(cloud.opacities[rows] >= LEAST_OPACITY).sum() for rows in blocks])
    wanted = np.array([counted[rows].sum() for rows in blocks]) if cameras else visible
    shares = _shares(wanted, visible, max(count, FEWEST_OF_BLOCK * len(blocks)))

    def left(rows: np.ndarray, share: int) -> GaussianCloud:
        part = cloud.take(rows)
        if share >= len(part):
            return part
        return _merge(part, share, low_pass[rows], masses[rows], counted[rows], threads=1).cloud

    kept = np.flatnonzero(shares)
    with ThreadPoolExecutor(threads or processors()) as pool:
        parts = list(pool.map(left, [blocks[i] for i in kept], shares[kept].tolist()))
    # What is left over is the least of each block: few of all.
    return simplify(GaussianCloud.joined(parts), count, threads=threads)


def _shares(wanted: np.ndarray, visible: np.ndarray, total: int) -> np.ndarray:
    """(b,) int64 numbers of splats, ``total`` together, that blocks keep: in proportion to ``wanted`` (b,),
    but at most those that are ``visible`` (b,), and at least ``FEWEST_OF_BLOCK`` of them."""
    wanted = wanted.astype(np.float64)  # products of the counts of NumPy 1 on Windows, int32, would overflow
    free, left = wanted > 0, float(total)
    while free.any() and ((full := free & (wanted * left > visible * wanted[free].sum())).any()):
        free &= ~full
        left = total - visible[(wanted > 0) & ~free].sum()
    unit = wanted[free].sum() / left if left > 0 and free.any() else 1.0
    ends = np.rint(np.cumsum(np.where(free, wanted, np.where(wanted > 0, visible * unit, 0))) / unit)
    shares = np.diff(ends.astype(np.int64), prepend=0)
    return np.maximum(shares, np.minimum(visible, FEWEST_OF_BLOCK))


def _blocks(means: np.ndarray, rows: np.ndarray, most: int) -> list[np.ndarray]:
    """``rows`` of ``means`` (n, 3) in blocks of at most ``most``, each in ascending order."""
    if len(rows) <= most:
        return [np.sort(rows)]
    points = means[rows]
    axis = int(np.ptp(np.quantile(subsample(points, 10_000), (0.02, 0.98), axis=0), axis=0).argmax())
    middle = len(rows) // 2
    order = np.argpartition(points[:, axis], middle)
    return _blocks(means, rows[order[:middle]], most) + _blocks(means, rows[order[middle:]], most)


class Merged(NamedTuple):
    """Fewer splats, and what became of the old ones."""

    cloud: GaussianCloud
    group: np.ndarray
    """(n,) row of ``cloud`` that each old splat has become part of."""
    masses: np.ndarray
    """(n,) float64 masses of the old splats, >= 0."""


def merge(cloud: GaussianCloud, count: int, low_pass: np.ndarray, threads: int | None = None) -> Merged:
    """``simplify`` for ``count`` less than the number of splats and ``low_pass`` (n,) float64, which it has
    checked, without cameras."""
    masses = _masses(cloud, low_pass)
    return _merge(cloud, count, low_pass, masses, masses, threads)


def _merge(
    cloud: GaussianCloud,
    count: int,
    low_pass: np.ndarray,
    masses: np.ndarray,
    counted: np.ndarray,
    threads: int | None,
) -> Merged:
    """``merge`` of splats with these ``masses`` (n,), of which each counts as ``counted`` (n,), > 0 if it is
    ever drawn."""
    n = len(cloud)
    if n > np.iinfo(np.int32).max:
        raise ValueError(f"at most 2^31 - 1 splats can be merged, got {n}")
    group = groups_of(cloud, counted, low_pass, int(count), threads or processors())
    return Merged(_merged(cloud, masses, low_pass, group, threads or processors()), group, masses)


def _checked_width(low_pass: float | np.ndarray, n: int) -> np.ndarray:
    """(n,) float64. ValueError for other than one number >= 0, or one for each of the n splats."""
    width = np.asarray(low_pass, np.float64)
    if width.shape not in ((), (n,)) or not np.isfinite(width).all() or (width < 0).any():
        raise ValueError(f"low_pass must be one number >= 0, or one for each of the {n} splats")
    return np.broadcast_to(width, (n,))


def _masses(cloud: GaussianCloud, low_pass: np.ndarray) -> np.ndarray:
    """(n,) float64 masses of splats, 0 for those that are never drawn."""
    masses = np.empty(len(cloud))
    for part in chunks(len(cloud), CHUNK):
        opacities = cloud.opacities[part]
        area = mean_shadow(disc_areas(_drawn(cloud.scales[part], low_pass[part], cloud.kernel)))
        masses[part] = np.where(opacities < LEAST_OPACITY, 0, optical_depth(opacities) * area)
    return masses


def optical_depth(opacity: np.ndarray) -> np.ndarray:
    """Integrated optical depth of a splat over 2 pi, as a multiple of the product of its two standard
    deviations: the dilogarithm of its ``opacity`` (0 to 1); float64, 0 to pi^2 / 6."""
    o = np.asarray(opacity, np.float64)
    # Above a half by Euler's reflection formula, so that the series is short.
    small = np.minimum(o, 1 - o)
    series, power = np.zeros_like(o), np.ones_like(o)
    for k in range(1, 50):
        power = power * small
        series += power / k**2
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.where(small > 0, np.log(o) * np.log1p(-o), 0)
    return np.where(o > 0.5, np.pi**2 / 6 - logs - series, series)


def opacity_of(depth: np.ndarray) -> np.ndarray:
    """Inverse of ``optical_depth`` for ``depth`` >= 0, within 1e-5; 1 beyond its range."""
    return np.interp(depth, *_table())


@lru_cache(maxsize=1)
def _table() -> tuple[np.ndarray, np.ndarray]:
    opacity = np.linspace(0, 1, 8193)
    return optical_depth(opacity), opacity


def low_pass_of(kernel: Kernel, pixels: np.ndarray) -> np.ndarray:
    """(n,) float64 standard deviations of the low-pass filter that splats of this ``kernel`` are drawn with,
    where pixels are as large as ``pixels`` (n,)."""
    return np.sqrt(LOW_PASS_PX2[kernel]) * pixels.astype(np.float64)


def _usual_low_pass(
    cloud: GaussianCloud, cameras: Sequence[Camera] | None, coverage: CameraCoverage | None = None
) -> np.ndarray:
    return low_pass_of(cloud.kernel, usual_pixels(cloud, cameras, coverage))


def _drawn(scales: np.ndarray, low_pass: np.ndarray, kernel: str) -> np.ndarray:
    """(n, 3) float64 standard deviations after the low-pass filter, where it adds to the opacity."""
    if kernel == "antialiased":
        return scales.astype(np.float64)
    return widen(scales.astype(np.float64), low_pass, 1.0, kernel)


def _depths(masses: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """(n,) float64 ``optical_depth`` of splats of these ``masses`` (n,), with standard deviations ``drawn``
    (n, 3)."""
    area = mean_shadow(disc_areas(drawn))
    return np.divide(masses, area, out=np.zeros_like(masses), where=area > 0)


def _are_solid(cloud: GaussianCloud, masses: np.ndarray) -> bool:
    """Whether nearly all of ``cloud`` is opaque, as where splats were made of points or of a mesh."""
    opaque = (cloud.opacities >= SOLID) & (cloud.opacities != MERGED_OPAQUE)
    return float(masses[opaque].sum()) >= SOLID_SHARE * float(masses.sum())


def _matrices(covariances: np.ndarray) -> np.ndarray:
    """(n, 3, 3) of (n, 6) xx, xy, xz, yy, yz, zz."""
    return covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def _merged(
    cloud: GaussianCloud, masses: np.ndarray, low_pass: np.ndarray, group: np.ndarray, threads: int
) -> GaussianCloud:
    """One splat for each group."""
    sizes = np.bincount(group)
    first = np.unique(group, return_index=True)[1]
    result = cloud.take(first)
    changed = np.flatnonzero(sizes > 1)
    rows = np.flatnonzero(sizes[group] > 1)
    part = replace(cloud, sh=cloud.sh[:, :1]).take(rows)
    index = np.zeros(len(sizes), np.int64)
    index[changed] = np.arange(len(changed))
    own = index[group[rows]]
    all_moments = Moments(part.means.astype(np.float64), covariances_of(part), masses[rows], part.colors)
    groups = Groups(own, masses[rows])
    means, covariances, mass, _ = all_moments.together(groups)
    width = groups.averages(low_pass[rows, None])[:, 0]
    variances, axes = np.linalg.eigh(_matrices(covariances))
    scales = np.sqrt(np.maximum(variances[:, ::-1], 0))  # largest first
    axes = axes[:, :, ::-1].copy()
    axes[np.linalg.det(axes) < 0, :, 2] *= -1
    if cloud.kernel == "2dgs":
        scales[:, 2] = 0
    depth = _depths(mass, _drawn(scales, width, cloud.kernel))
    dense = depth > DENSE
    if dense.any():
        inside = groups.order[dense[own[groups.order]] & (part.opacities[groups.order] >= LEAST_OPACITY)]
        filtered = 0.0 if cloud.kernel == "antialiased" else np.square(low_pass[rows[inside]])
        parts = Parts(
            (np.cumsum(dense) - 1)[own[inside]],
            all_moments.means[inside],
            _matrices(all_moments.covariances[inside]) + np.multiply.outer(filtered, np.eye(3)),
            part.opacities[inside].astype(np.float64),
        )
        drawn = _drawn(scales[dense], width[dense], cloud.kernel)
        shares = covered_shares(parts, Wholes(means[dense], axes[dense], drawn[:, :2]), threads)
        wanted = shares * (SOLID_COVER if _are_solid(cloud, masses) else 1.0)
        scales[dense, :2] *= np.sqrt(np.maximum(wanted, 1))[:, None]
        depth = _depths(mass, _drawn(scales, width, cloud.kernel))
    fields = {
        name: getattr(result, name).copy() for name in ("means", "quaternions", "scales", "opacities", "sh")
    }
    fields["means"][changed] = means
    fields["quaternions"][changed] = quaternions_of(axes)
    fields["scales"][changed] = scales
    opacity = opacity_of(depth)
    fields["opacities"][changed] = np.where(opacity >= SOLID, MERGED_OPAQUE, opacity)
    for k in range(cloud.sh.shape[1]):
        fields["sh"][changed, k] = groups.averages(cloud.sh[rows, k])
    return replace(result, **fields)
