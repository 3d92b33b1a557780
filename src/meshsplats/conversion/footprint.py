"""The footprint: how large a pixel is at each splat, and the low-pass filter of that size.

3DGS adds 0.3 px^2 to the covariance of every splat in the image; 2DGS never draws one with a standard
deviation below sqrt(1/2) px. A mesh has no such filter: its triangles must be wide enough from the start.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from meshsplats._common.arrays import spread_indices
from meshsplats._common.chunks import chunks, thin_product
from meshsplats._common.geometry import spacing
from meshsplats.cameras.framing import SAMPLE, guess_up
from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion.options import ConversionOptions
from meshsplats.scene.camera import Camera, hiding_near_plane
from meshsplats.scene.gaussians import SH_C0, GaussianCloud, Kernel
from meshsplats.scene.mesh import MAX_COLOR
from meshsplats.scene.spherical_harmonics import sh_basis

FILTER_PX2: dict[str, dict[str, float]] = {
    "area": {"3dgs": 0.05, "antialiased": 0.05, "2dgs": 0.05},
    "splats": {"3dgs": 0.5, "antialiased": 0.4, "2dgs": 0.3},
}
"""Variance of the filter in square pixels, by look and kernel. Splats are drawn with ``LOW_PASS_PX2``; the
values for 'splats' are the best from the distances of the given cameras to eight times as far. Means over a
pixel's area need a filter only because a pixel has few samples: 0.03 to 0.08 gain 0.6 dB over none, and 0.5
loses 2 to 3 dB."""

MAX_CAMERAS = 32
"""Of more cameras this many are used, evenly spaced in their order."""

FRAMING_PIXELS = 1000
FRAMING_VIEWS = 6
"""Side and count of the square images for 'framing'."""
FRAMING_SPACING = 0.7
"""Largest pixel for 'framing', as a share of the median spacing of the splats. Only clouds with far more
detail than such images can show reach it."""

_CHUNK = 1 << 14


def origin_step(count: int) -> int:
    """Step of the sample of ``count`` splats whose mean is the origin."""
    return max(1, count // 1000)


def origin_of(means: np.ndarray) -> np.ndarray:
    """(3,) float64 mean of ``means`` (n, 3), 0 if there are none."""
    return means.mean(axis=0, dtype=np.float64) if len(means) else np.zeros(3)


class CameraCoverage:
    """How many pixels of each camera a unit of area at each splat covers: weights (f / d)^2.

    Args:
        means: (n, 3) float32 centres of the splats.
        cameras: at least one; of more than ``MAX_CAMERAS``, some are chosen.
        origin: (3,) of the whole scene, where ``means`` are a part of it; see ``origin_of``.
    """

    def __init__(
        self, means: np.ndarray, cameras: Sequence[Camera], origin: np.ndarray | None = None
    ) -> None:
        self.cameras = [cameras[i] for i in spread_indices(len(cameras), MAX_CAMERAS)]
        self._near = [camera.near_plane(means) for camera in self.cameras]
        self.means = means
        # Relative to an origin among the splats: positions far from zero lose digits in float32.
        self.origin = origin_of(means[:: origin_step(len(means))]) if origin is None else origin

    def _each(self, part: slice) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """For each camera: (3, k) offsets from its centre to the splats ``part`` in the world frame, (k,)
        squares of their lengths, (k,) bool which of them it sees, and (k,) weights, 0 for the others."""
        points = np.ascontiguousarray((self.means[part] - self.origin).T, np.float32)
        for camera, near in zip(self.cameras, self._near, strict=True):
            rotation, center = camera.world_to_camera[:3, :3], camera.center - self.origin
            fx, fy = camera.fx, camera.fy
            # Rows to clip space: a point is in the image if and only if abs(x) <= z and abs(y) <= z.
            lens = np.array(
                [
                    [2 * fx / camera.width, 0, 2 * camera.cx / camera.width - 1],
                    [0, 2 * fy / camera.height, 2 * camera.cy / camera.height - 1],
                    [0, 0, 1],
                ]
            )
            matrix = lens @ rotation
            clip = matrix.astype(np.float32) @ points
            clip -= (matrix @ center).astype(np.float32)[:, None]
            z = clip[2]
            seen = z > near
            np.abs(clip[:2], out=clip[:2])
            seen &= clip[0] <= z
            seen &= clip[1] <= z
            away = points - center.astype(np.float32)[:, None]
            with np.errstate(over="ignore"):
                square = away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
            seen &= square < np.inf  # farther than float32 can tell
            # Of those that it sees, none is nearer; the others must not divide by zero.
            np.maximum(square, np.float32(max(near, 1e-15)) ** 2, out=square)
            weight = np.float32(fx * fy) / square
            weight *= seen
            yield away, square, seen, weight

    def pixel_sizes(self) -> np.ndarray:
        """(n,) float32 size of a pixel at each splat in scene units; 0 where no camera sees it.

        Concretely, d / f with (f / d)^2 averaged over the cameras that see the splat: close views, in which
        it covers more pixels, count for more.
        """
        count, total = self._sums
        return np.sqrt(np.divide(count, total, out=np.zeros_like(total), where=count > 0))

    def densities(self) -> np.ndarray:
        """(n,) float32 pixels that a unit of area at each splat covers, on average over all cameras: 0 in
        those that do not see it."""
        return self._sums[1] / np.float32(len(self.cameras))

    @cached_property
    def _sums(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) float32 number of cameras that see each splat, and the sum of their weights."""
        count, total = np.zeros((2, len(self.means)), np.float32)
        for part in chunks(len(total), _CHUNK):
            for _, _, seen, weight in self._each(part):
                count[part] += seen
                total[part] += weight
        return count, total

    def mean_colors(self, sh: np.ndarray) -> np.ndarray:
        """(n, 3) float32 display RGB in [0, 1]: colours of ``sh`` (n, k, 3), averaged over the cameras.

        Each camera that sees the splat counts by the pixels that the splat covers. The mean is clipped, not
        the single colours. A splat that no camera sees has its colour of degree 0.
        """
        colors = np.empty((len(sh), 3), np.float32)
        degree = int(sh.shape[1] ** 0.5) - 1
        matrix = _from_monomials(degree)
        # Repeats each coefficient for r, g and b; sums over the coefficients.
        spread = np.repeat(matrix, 3, axis=1)
        gather = np.tile(np.eye(3, dtype=np.float32), (sh.shape[1], 1))
        terms = MONOMIALS[1 : len(matrix)]
        for part in chunks(len(sh), _CHUNK):
            k = part.stop - part.start
            # Harmonics are polynomials of the direction, so their means follow from those of its monomials.
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
"""Monomials of a direction up to degree 3, each as an earlier one, by index, times an axis. As zz is
1 - xx - yy on the sphere, there is one for each spherical harmonic of the same degrees."""


def _from_monomials(degree: int) -> np.ndarray:
    """(k, k) float32 matrix M, k = (degree + 1)^2, with ``sh_basis(d) = m @ M`` for the ``MONOMIALS`` m of a
    direction d.

    Found by least squares over random directions: the system has an exact solution.
    """
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values = np.ones((64, (degree + 1) ** 2))
    for index, (factor, axis) in list(enumerate(MONOMIALS))[1 : values.shape[1]]:
        values[:, index] = values[:, factor] * directions[:, axis]
    return np.linalg.lstsq(values, sh_basis(directions, degree), rcond=None)[0].astype(np.float32)


@dataclass(frozen=True, eq=False)
class SceneSample:
    """What the conversion of a part needs to know of the whole scene."""

    kept: int
    """Count of the splats that are converted: inside the crop box and opaque enough."""
    kernel: Kernel
    sample: GaussianCloud
    """Every ``step``-th of the kept splats, of degree 0; its origin is that of all splats."""
    step: int
    origin: np.ndarray
    """(3,) float64 as ``CameraCoverage.origin`` of all of them, in their coordinates."""

    @classmethod
    def of(cls, cloud: GaussianCloud) -> SceneSample:
        """That of splats in memory, all of which are kept."""
        step = -(-len(cloud) // SAMPLE)
        sample = cloud.of_degree(0).take(np.arange(0, len(cloud), step))
        return cls(len(cloud), cloud.kernel, sample, step, origin_of(cloud.means[:: origin_step(len(cloud))]))


class SceneViews:
    """What cameras see of a scene: the size of a pixel at any of its splats, and their mean colours.

    Args:
        scene: a sample of it.
        options: resolved ones.
        cameras: where the mesh will be seen from, for what follows them.
        up: (3,) unit vector, the axis of the cameras of 'framing'.
        whole: all splats will be asked for at once, not in blocks.
    """

    def __init__(
        self,
        scene: SceneSample,
        options: ConversionOptions,
        cameras: Sequence[Camera] | None,
        up: np.ndarray,
        *,
        whole: bool = False,
    ) -> None:
        self._scene, self._options, self._given = scene, options, cameras or ()
        self._largest = np.float32(np.inf)
        self.is_none = options.footprint in ("none", "filter")
        """Whether there is no footprint."""
        self.unseen: np.float32 | None = None
        """At splats that no camera sees: the median pixel of the others, of the sample at first. None: of
        those that are asked for."""
        self._cameras: list[Camera] = []
        if cameras and (options.footprint == "cameras" or options.colors == "mean"):
            self._cameras = self._placed(cameras)
        self._measuring = self._cameras
        if options.footprint == "framing":
            side = FRAMING_PIXELS
            self._measuring = self._placed(orbit(scene.sample, FRAMING_VIEWS, width=side, height=side, up=up))
            self._largest = _largest_pixel(scene.sample.means, scene.step)
        if self.has_unseen and not whole:
            self.unseen = self._median(self.seen(scene.sample.means))

    @property
    def has_unseen(self) -> bool:
        """Whether splats may be outside all images."""
        return self._options.footprint in ("framing", "cameras")

    def pixel_sizes(self, means: np.ndarray, seen: np.ndarray | None = None) -> np.ndarray | None:
        """(n,) float32 size of a pixel at each of ``means`` (n, 3) in scene units; None for 'none' and
        'filter'. ``seen``: those of ``seen(means)``, where they are known."""
        if self.is_none:
            return None
        if not self.has_unseen:
            pixel = self._options.viewing_distance / self._options.focal  # type: ignore[operator]
            return np.full(len(means), pixel, np.float32)
        sizes = self.seen(means) if seen is None else seen
        unseen = self._median(sizes) if self.unseen is None else self.unseen
        sizes = np.where(sizes > 0, sizes, unseen)
        return np.minimum(sizes, self._largest, out=sizes)

    def seen(self, means: np.ndarray) -> np.ndarray:
        """(n,) float32 sizes in scene units, 0 where no camera sees the splat."""
        return CameraCoverage(means, self._measuring, self._scene.origin).pixel_sizes()

    def colors(self, cloud: GaussianCloud) -> np.ndarray:
        """(n, 3) display RGB of ``cloud``: the mean over the cameras, if that is asked for, else of degree 0,
        which is above 1 where harmonics may darken it."""
        if self._options.colors == "view" and cloud.sh_degree:
            return np.clip(0.5 + np.float32(SH_C0) * cloud.sh[:, 0], 0, MAX_COLOR)
        if self._options.colors != "mean" or not self._cameras or not cloud.sh_degree:
            return cloud.colors
        return CameraCoverage(cloud.means, self._cameras, self._scene.origin).mean_colors(cloud.sh)

    def _placed(self, cameras: Sequence[Camera]) -> list[Camera]:
        """Those of ``cameras`` that count, with the near planes that they have in front of the scene."""
        some = [cameras[i] for i in spread_indices(len(cameras), MAX_CAMERAS)]
        return [camera.with_near_plane(self._scene.sample.means) for camera in some]

    def _median(self, sizes: np.ndarray) -> np.float32:
        seen = sizes[sizes > 0]
        if not len(seen):
            cameras = self._given if self._options.footprint == "cameras" else self._measuring
            raise ValueError(_none_seen(cameras, self._scene.sample.means, self._scene.kept))
        return np.float32(np.median(seen))


def usual_pixels(
    cloud: GaussianCloud, cameras: Sequence[Camera] | None = None, coverage: CameraCoverage | None = None
) -> np.ndarray:
    """(n,) float32 size of a pixel at each splat of ``cloud`` in scene units: in images of ``cameras``, whose
    ``coverage`` may be there already, else in those of 'framing'."""
    source = ConversionOptions(footprint="cameras" if cameras else "framing")
    views = SceneViews(SceneSample.of(cloud), source, cameras, guess_up(cloud, cameras), whole=True)
    # Near planes that cameras do not have are those in front of a sample here, of the whole scene there.
    same = coverage is not None and all(camera.near is not None for camera in coverage.cameras)
    pixel = views.pixel_sizes(cloud.means, coverage.pixel_sizes() if coverage and same else None)
    assert pixel is not None
    return pixel


def _none_seen(cameras: Sequence[Camera], means: np.ndarray, count: int) -> str:
    """What to say where ``cameras`` see none of ``count`` splats, some of which are at ``means`` (n, 3)."""
    reason = hiding_near_plane(cameras, means)
    reason = f"{reason}." if reason else "are they of one scene?"
    return (
        f"none of the {len(cameras)} cameras sees any of the {count:,} splats: {reason} Choose"
        " footprint='framing' or 'none' to go without them"
    )


def _largest_pixel(means: np.ndarray, step: int) -> np.float32:
    """Largest pixel for 'framing', scene units, by ``means`` (n, 3) of every ``step``-th splat."""
    # One point in ``step`` lies sqrt(step) times as far from the next, on a surface.
    typical = np.median(spacing(means)) / np.sqrt(step)
    # Splats all in one spot have no spacing.
    return np.float32(FRAMING_SPACING * typical) if typical > 0 else np.float32(np.inf)


def widen(scales: np.ndarray, pixel: np.ndarray | None, px2: float, kernel: str) -> np.ndarray:
    """(n, 3) standard deviations after the low-pass filter of ``kernel``, variance ``px2`` square pixels.

    Args:
        scales: (n, 3) standard deviations, scene units.
        pixel: (n,) size of a pixel at each splat, scene units; None: no filter.
    """
    if pixel is None:
        return scales
    with np.errstate(over="ignore"):
        low_pass = (px2 * np.square(pixel, dtype=np.float32))[:, None]
        square = np.square(scales)
        result = np.sqrt(np.maximum(square, low_pass) if kernel == "2dgs" else square + low_pass)
    # A splat so large that its variance overflows needs no filter.
    return np.where(np.isfinite(result), result, scales) if result.max(initial=0) == np.inf else result
