"""How large a pixel is at each splat, and the low-pass filter of that size which splats were trained with.

3DGS adds 0.3 px^2 to the covariance of every splat on the picture, 2DGS never draws one narrower than a
standard deviation of sqrt(1/2) px. A mesh has no such filter: its triangles must be wide enough from the
start.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from meshsplats._geometry import spacing
from meshsplats.camera import Camera
from meshsplats.cameras.framing import SAMPLE
from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion.chunks import chunks, thin_product
from meshsplats.conversion.options import ConversionOptions
from meshsplats.gaussians import SH_C0, GaussianCloud
from meshsplats.spherical_harmonics import sh_basis

FILTER_PX2: dict[str, dict[str, float]] = {
    "area": {"3dgs": 0.05, "antialiased": 0.05, "2dgs": 0.05},
    "splats": {"3dgs": 0.5, "antialiased": 0.4, "2dgs": 0.3},
}
"""Variance of the filter in square pixels, by look and kernel. 3DGS and its antialiased kernel add 0.3 and
2DGS has 0.5; those of 'splats' serve best over the distances of the given cameras and up to eight times as
far. Means over a pixel's area need none but for the few samples that a pixel has: against these, 0.03 to 0.08
gain 0.6 dB over none, and 0.5 lose 2 to 3 dB."""

DRAWN_PX2 = 0.3
"""Variance that 3DGS adds at whatever size it draws: that of the filter of a mesh that is drawn with one."""

MAX_CAMERAS = 32
"""Of more cameras, so many are used, evenly spaced in their order."""

SPACING_SHARE = 0.35
"""Pixel size as a share of the spacing of the splats, where nothing else is known: of six scenes, the
pictures that they were made from, or shown at, have 0.31 to 0.91."""

SPACING_POWER = 0.3
"""How far the pixel size follows the local spacing (1) rather than the scene's median (0). Splats lie closer
where there is more detail, not only where cameras come closer."""

FRAMING_PIXELS = 1000
FRAMING_VIEWS = 6
"""Side and number of the square pictures for 'framing'."""
FRAMING_SPACING = 0.7
"""The most that a pixel of 'framing' may be, as a share of the median spacing of the splats: twice that of
'density'. Only clouds that hold far more detail than such pictures show come to it."""

_CHUNK = 1 << 14


class Views:
    """What the cameras see of each splat: weights (f / d)^2, the pixels that a unit of area at the splat
    covers."""

    def __init__(self, means: np.ndarray, cameras: Sequence[Camera]) -> None:
        chosen = np.unique(
            np.linspace(0, len(cameras) - 1, min(len(cameras), MAX_CAMERAS)).round().astype(int)
        )
        self.cameras = [cameras[i] for i in chosen]
        self.means = means
        # Differences of nearby positions lose nothing in float32, positions far from the origin would.
        self.origin = (
            means[:: max(1, len(means) // 1000)].mean(axis=0, dtype=np.float64) if len(means) else np.zeros(3)
        )

    def _each(self, part: slice) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """For each camera: (3, k) offsets of the splats ``part`` from its centre in the world frame, (k,) the
        squares of their lengths, (k,) bool which of them it sees, and (k,) weights; 0: not seen."""
        points = np.ascontiguousarray((self.means[part] - self.origin).T, np.float32)
        for camera in self.cameras:
            rotation, center = camera.world_to_camera[:3, :3], camera.center - self.origin
            fx, fy = camera.fx, camera.fy
            # Rows that give 2 x' / width * z and 2 y' / height * z, with x' and y' pixels from the middle of
            # the picture, and z: on the picture is what has none of the first two larger than z.
            lens = np.array(
                [
                    [2 * fx / camera.width, 0, 2 * camera.cx / camera.width - 1],
                    [0, 2 * fy / camera.height, 2 * camera.cy / camera.height - 1],
                    [0, 0, 1],
                ]
            )
            matrix = lens @ rotation
            across = matrix.astype(np.float32) @ points
            across -= (matrix @ center).astype(np.float32)[:, None]
            z = across[2]
            seen = z > camera.near
            np.abs(across[:2], out=across[:2])
            seen &= across[0] <= z
            seen &= across[1] <= z
            away = points - center.astype(np.float32)[:, None]
            square = away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
            np.maximum(square, np.float32(1e-30), out=square)
            weight = np.float32(fx * fy) / square
            weight *= seen
            yield away, square, seen, weight

    def pixel_sizes(self) -> np.ndarray:
        """(n,) float32 size of a pixel at each splat in scene units: d / f with 1 / d^2 averaged over the
        cameras that see it, so that near views, where it covers more pixels, count for more. 0 where no
        camera sees the splat."""
        sizes = np.empty(len(self.means), np.float32)
        for part in chunks(len(sizes), _CHUNK):
            count, total = np.zeros((2, part.stop - part.start), np.float32)
            for _, _, seen, weight in self._each(part):
                count += seen
                total += weight
            sizes[part] = np.sqrt(np.divide(count, total, out=np.zeros_like(total), where=count > 0))
        return sizes

    def mean_colors(self, sh: np.ndarray) -> np.ndarray:
        """(n, 3) display colour of coefficients ``sh`` (n, k, 3) averaged over the cameras that see each
        splat, in [0, 1].

        Views count by the pixels that the splat covers. Averaged first, clipped after. Degree 0 for unseen
        splats.
        """
        colors = np.empty((len(sh), 3), np.float32)
        degree = int(sh.shape[1] ** 0.5) - 1
        matrix = _from_monomials(degree)
        # Each coefficient three times, as colours lie in memory; and the sum over the coefficients.
        spread = np.repeat(matrix, 3, axis=1)
        gather = np.tile(np.eye(3, dtype=np.float32), (sh.shape[1], 1))
        terms = MONOMIALS[1 : len(matrix)]
        for part in chunks(len(sh), _CHUNK):
            k = part.stop - part.start
            # Harmonics are polynomials of the direction: the means of its monomials are all that is needed.
            mean = np.zeros((len(matrix), k), np.float32)
            values = np.empty_like(mean)
            for away, square, _, weight in self._each(part):
                away /= np.sqrt(square)
                values[0] = weight
                for value, (factor, axis) in zip(values[1:], terms, strict=True):
                    np.multiply(values[factor], away[axis], out=value)
                mean += values
            unseen = mean[0] == 0
            mean /= np.where(unseen, np.float32(1), mean[0])
            shade = thin_product(mean.T, spread)
            shade[unseen] = np.repeat(np.eye(1, len(matrix), dtype=np.float32) * SH_C0, 3)
            shade *= sh[part].reshape(k, -1)
            color = thin_product(shade, gather)
            color += np.float32(0.5)
            np.clip(color, 0, 1, out=colors[part])
        return colors


MONOMIALS = [
    (-1, -1),  # 1
    *[(0, 0), (0, 1), (0, 2)],  # x y z
    *[(1, 0), (1, 1), (2, 1), (1, 2), (2, 2)],  # xx xy yy xz yz
    *[(4, 0), (4, 1), (6, 0), (6, 1), (4, 2), (5, 2), (6, 2)],  # xxx xxy xyy yyy xxz xyz yyz
]
"""Monomials of a direction up to degree 3, each as the product of an earlier one, by number, and an axis.
zz is 1 - xx - yy on the sphere, so those of degree d and less are as many as spherical harmonics."""


def _from_monomials(degree: int) -> np.ndarray:
    """((degree + 1)^2, (degree + 1)^2) float32 whose product with ``MONOMIALS`` of a direction, in rows, is
    ``sh_basis`` of it."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values = np.ones((64, (degree + 1) ** 2))
    for number, (factor, axis) in list(enumerate(MONOMIALS))[1 : values.shape[1]]:
        values[:, number] = values[:, factor] * directions[:, axis]
    return np.linalg.lstsq(values, sh_basis(directions, degree), rcond=None)[0].astype(np.float32)


def pixel_sizes(
    cloud: GaussianCloud, options: ConversionOptions, views: Views | None, up: np.ndarray
) -> np.ndarray | None:
    """(n,) size of a pixel at each splat in scene units, by ``options.footprint``; None for 'none' and
    'filter'.

    Splats that no camera sees take the median of the others. ``up`` (3,) is the axis of the cameras of
    'framing'.
    """
    if options.footprint in ("none", "filter"):
        return None
    if options.footprint == "distance":
        pixel = options.viewing_distance / options.focal  # type: ignore[operator]
        return np.full(len(cloud), pixel, np.float32)
    if options.footprint == "density":
        local = spacing(cloud.means)
        typical = np.median(local)
        relative = np.divide(local, typical, out=np.ones_like(local), where=typical > 0)
        return np.float32(SPACING_SHARE) * typical * np.power(relative, np.float32(SPACING_POWER))
    if options.footprint == "framing":
        side = FRAMING_PIXELS
        views = Views(cloud.means, orbit(cloud, FRAMING_VIEWS, width=side, height=side, up=up))
    if views is None:
        raise ValueError("footprint='cameras' needs cameras")
    sizes = views.pixel_sizes()
    seen = sizes > 0
    if not seen.any():
        raise ValueError(
            f"none of the {len(views.cameras)} cameras sees any of the {len(cloud)} splats: are they of one"
            " scene? Choose footprint='density' or 'none' to go without them"
        )
    sizes = np.where(seen, sizes, np.median(sizes[seen]))
    if options.footprint == "framing":
        # One point in ``step`` lies sqrt(step) times as far from the next, on a surface.
        step = -(-len(cloud) // SAMPLE)
        typical = np.median(spacing(cloud.means[::step])) / np.sqrt(step)
        if typical > 0:  # splats all in one spot have no spacing
            np.minimum(sizes, np.float32(FRAMING_SPACING * typical), out=sizes)
    return sizes


def widen(scales: np.ndarray, pixel: np.ndarray | None, px2: float, kernel: str) -> np.ndarray:
    """(n, 3) standard deviations with the filter of variance ``px2`` square pixels applied, as ``kernel``
    does it."""
    if pixel is None:
        return scales
    low_pass = (px2 * np.square(pixel, dtype=np.float32))[:, None]
    square = np.square(scales)
    return np.sqrt(np.maximum(square, low_pass) if kernel == "2dgs" else square + low_pass)
