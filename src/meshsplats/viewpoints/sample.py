"""A sample of a scene's splats, and what they look like from a point or through a camera.

All measurements are of *angles*: the size of a splat over its distance. Photographs are taken from where
splats look small; the noise behind walls, which no photograph shows, looks coarse or full of holes.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property

import numpy as np

from meshsplats._common.geometry import level_axes, rotation_rows
from meshsplats._core.library import processors
from meshsplats.cameras.framing import guess_up
from meshsplats.cameras.trajectories import look_at
from meshsplats.rendering.api import Rendering, render_splats
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import DILATION, SH_C0, GaussianCloud
from meshsplats.viewpoints.thinning import ByPlace, largest, sizes_of, without_harmonics

SAMPLE = 50_000
"""Number of splats that panoramas show."""
SMALL_SAMPLE = 32_000
"""The same for a first impression."""
WIDEST = 5.0
"""Largest factor by which the splats of a sample are widened to close surfaces again. Where more is needed,
panoramas choose the splats that they show anew for each place."""
SIDE = 24
"""Pixels along the edge of a panorama's cube."""
SHARP_SIDE = 300
"""Splats have the low-pass filter of images of this many pixels: that of small images closes the holes in the
noise, and in surfaces that no photograph shows from there."""
CHECK_SIDE = 800
"""The same for images in which single views are checked, of twice the angle."""
REACH = 4.0
"""Standard deviations from its centre at which a splat is beyond sight."""
CONE = 32.0
"""Half the angle of view of a direction of a panorama, degrees."""
DIRECTIONS = 96
COARSE = 0.03
"""Angle in radians of a splat that is half a blob: 18 of 640 pixels across 55 degrees."""
BINS = np.arange(-8.5, -1.0, 0.5)
"""Logarithms of angles that histograms are made of."""
BLOCK = 1 << 13
"""Splats that are looked at together: what is computed of them stays in the cache (a million at a time take
eight times as long)."""
MOST = 4_000_000
"""Splats of a scene that views are checked with, at most..."""
MOST_IN_VIEW = 400_000
"""...and of those in one view: over a hundred for each of its pixels, which hide no hole. Of more, every so
many stand for all, wider."""
AT_A_TIME = 16
"""Panoramas that are drawn side by side, at most: of a large scene each takes 30 MB."""
LEVELS = 255
"""Shares are rounded to this many parts: sums of whole numbers have the same bits in any order."""


def fibonacci(count: int) -> np.ndarray:
    """(count, 3) unit vectors, evenly spread over the sphere."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - 5**0.5) * np.arange(count)
    level = np.sqrt(1 - z * z)
    return np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)


def coded(values: np.ndarray) -> np.ndarray:
    """(n, 1, 3) harmonics that show ``values`` (n, 3), each from 0 to 1, as colours."""
    return ((values - 0.5) / SH_C0)[:, None].astype(np.float32)


def angle_as_color(angle: np.ndarray) -> np.ndarray:
    """Logarithms of angles, from 0 for exp(-9) to 1 for a radian."""
    return np.clip((np.log(np.maximum(angle, 1e-9)) + 9) / 9, 0, 1)


class AllSplats:
    """All splats of a scene, as far as views can tell: a sample as small as that of panoramas hides holes."""

    def __init__(self, cloud: GaussianCloud, threads: int | None) -> None:
        step = -(-len(cloud) // MOST)
        self.cloud = cloud if step == 1 else without_harmonics(cloud, slice(None, None, step))
        self.threads, self.wider = threads, float(step) ** 0.5
        self.sizes = sizes_of(self.cloud.scales)
        self.reach = REACH * self.wider * largest(self.cloud.scales)

    def look(self, camera: Camera, sharp_side: int = CHECK_SIDE) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What ``camera`` sees.

        Args:
            camera: view, of a small image.
            sharp_side: side in pixels of the image whose low-pass filter the splats have.

        Returns:
            (h, w) logarithm of the angle, alpha, and standard deviation of the logarithm of the depth within
            a pixel: large in fog, small on surfaces.
        """
        matrix = camera.world_to_camera.astype(np.float32)
        slope = np.float32(0.5 * camera.width / camera.fx)
        rows = []
        for start in range(0, len(self.cloud), BLOCK):
            x = self.cloud.means[start : start + BLOCK] @ matrix[:3, :3].T + matrix[:3, 3]
            beside = np.maximum(np.abs(x[:, 0]), np.abs(x[:, 1])) - self.reach[start : start + BLOCK]
            rows.append(start + np.flatnonzero((x[:, 2] > 0) & (beside < slope * x[:, 2])))
        chosen = np.concatenate(rows)
        step = max(1, -(-len(chosen) // MOST_IN_VIEW))
        chosen, wider = chosen[::step], np.float32(self.wider * step**0.5)
        if not len(chosen):
            return np.full((camera.height, camera.width), -9.0), *np.zeros((2, camera.height, camera.width))
        whole = self.cloud
        means = np.take(whole.means, chosen, axis=0)
        away = np.linalg.norm(means - camera.center, axis=1) + np.finfo(np.float32).tiny
        deep = np.clip(np.log(away / np.median(away)) / 8 + 0.5, 0, 1)
        angle = angle_as_color(self.sizes[chosen] / away)
        cloud = GaussianCloud(
            means,
            np.take(whole.quaternions, chosen, axis=0),
            np.take(whole.scales, chosen, axis=0) * wider,
            np.take(whole.opacities, chosen),
            coded(np.stack([angle, deep, deep * deep], axis=1)),
            whole.kernel,
        )
        image = render_splats(
            cloud,
            camera,
            background=(0, 0, 0),
            threads=self.threads,
            dilation=DILATION * (camera.width / sharp_side) ** 2,
        )
        alpha = image.alpha.astype(np.float64)
        mean = image.color / np.maximum(alpha, 1e-6)[..., None]
        spread = 8 * np.sqrt(np.maximum(mean[..., 2] - mean[..., 1] ** 2, 0))
        return mean[..., 0] * 9 - 9, alpha, spread


class Sample:
    """Splats of a scene, in its frame, and a frame of directions that moves with the scene."""

    def __init__(
        self, cloud: GaussianCloud, up: np.ndarray | None, threads: int | None, most: int = SAMPLE
    ) -> None:
        self.cloud, self.threads = cloud, threads
        n = len(cloud)
        thin, wider = cloud, 1.0
        if n > most:
            thin = cloud.take(np.sort(np.random.default_rng(0).choice(n, most, replace=False)))
            wider = min((n / most) ** 0.5, WIDEST)
        self.thin = thin = replace(thin, scales=thin.scales * np.float32(wider), sh=thin.sh[:, :1])
        self.means = thin.means.astype(np.float64)
        self.size = sizes_of(thin.scales).astype(np.float64) / wider
        self.by_place = None if n <= most * WIDEST**2 else ByPlace(cloud, most)
        self.normals = _normals(thin)
        self.center = np.median(self.means, axis=0)
        self.radius = float(np.median(np.linalg.norm(self.means - self.center, axis=1))) or 1.0
        self.axes = _frame(self.means - self.center, guess_up(cloud) if up is None else up, self.radius)
        self.gaze = fibonacci(DIRECTIONS) @ self.axes
        self.cube = np.concatenate([np.eye(3), -np.eye(3)]) @ self.axes
        self.turns = np.stack([self._turn(k) for k in range(6)])
        self.rays = np.concatenate([self._rays(k) for k in range(6)])
        length = np.linalg.norm(self.rays, axis=1)
        self.rays /= length[:, None]
        weight = (self.gaze @ self.rays.T > np.cos(np.radians(CONE))) * length**-3  # solid angles of pixels
        self.cone = np.round(weight / weight.sum(axis=1, keepdims=True) * 2**20)
        self.cone_sum = self.cone.sum(axis=1)

    @cached_property
    def whole(self) -> AllSplats:
        """All splats, against which views are checked."""
        return AllSplats(self.cloud, self.threads)

    def _turn(self, k: int) -> np.ndarray:
        """(3, 3) rotation from the scene to the camera of face ``k`` of a panorama."""
        up = self.axes[1] if k % 3 != 1 else self.axes[2]
        return look_at(np.zeros(3), self.cube[k], up=up).world_to_camera[:3, :3]

    def _rays(self, k: int) -> np.ndarray:
        c = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
        x, y = np.meshgrid(c, c)
        grid = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        rays: np.ndarray = grid @ self.turns[k]
        return rays

    def _face(self, place: np.ndarray, k: int) -> Camera:
        matrix = np.eye(4)
        matrix[:3, :3] = self.turns[k]
        matrix[:3, 3] = -self.turns[k] @ place
        return Camera(matrix, SIDE / 2, SIDE / 2, SIDE / 2, SIDE / 2, SIDE, SIDE, self.near)

    @property
    def near(self) -> float:
        """Depth of the near plane of panoramas."""
        return 0.003 * self.radius

    def panoramas(self, places: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """What is seen from each of the ``places`` (k, 3), as ``panorama`` tells it."""
        with ThreadPoolExecutor(min(self.threads or processors(), AT_A_TIME)) as pool:
            return [self._in_cones(*pixels) for pixels in pool.map(self._pixels, places)]

    def panorama(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What is seen from ``place`` (3,).

        Returns:
            (DIRECTIONS, bins) shares of the view that opaque pixels of an angle take, (DIRECTIONS,) mean
            alpha, and (6 * SIDE * SIDE,) the distance of each pixel along ``rays``, inf where it is empty.
        """
        return self._in_cones(*self._pixels(place))

    def _in_cones(
        self, shares: np.ndarray, alpha: np.ndarray, depth: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``panorama`` from what ``_pixels`` returns."""
        scale = self.cone_sum[:, None] * LEVELS
        seen = (self.cone @ np.round(alpha * LEVELS)) / scale[:, 0]
        return (self.cone @ shares) / scale, seen, depth

    def _pixels(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(p, bins) shares, (p,) alpha and (p,) distances of the pixels of ``panorama``.

        Found by one thread: images as small as its faces gain nothing from more. Without BLAS: some builds of
        OpenBLAS for Windows, such as that of NumPy 1.26, crash where two threads call it at once.
        """
        thin, means, size = self.thin, self.means, self.size
        if self.by_place is not None:
            thin, size = self.by_place.seen_from(place, self.near)
            means = thin.means.astype(np.float64)
        apart = np.einsum("ni,ki->nk", means - place, self.axes)
        away = np.linalg.norm(apart, axis=1) + 1e-9 * self.radius
        angle = angle_as_color(size / away)
        shown = coded(np.stack([angle, np.clip(self.near / away, 0, 1), angle], axis=1))
        reach = REACH * largest(thin.scales)
        drawn = [self._drawn(thin, reach, place, k, apart, shown) for k in range(6)]
        color = np.concatenate([image.color.reshape(-1, 3) for image in drawn]).astype(np.float64)
        alpha = np.concatenate([image.alpha.ravel() for image in drawn]).astype(np.float64)
        solid = np.round(np.clip((alpha - 0.7) / 0.25, 0, 1) * LEVELS)  # surfaces have no holes, noise has
        log_angle = color[:, 0] / np.maximum(alpha, 1e-6) * 9 - 9
        bins = np.clip(np.round((log_angle - BINS[0]) / 0.5), 0, len(BINS) - 1).astype(int)
        shares = np.zeros((len(alpha), len(BINS)))
        shares[np.arange(len(alpha)), bins] = solid
        depth = np.full(len(alpha), np.inf)
        full = alpha > 0.5
        depth[full] = self.near * alpha[full] / np.maximum(color[full, 1], 1e-9)
        return shares, alpha, depth

    def _drawn(
        self,
        thin: GaussianCloud,
        reach: np.ndarray,
        place: np.ndarray,
        k: int,
        apart: np.ndarray,
        shown: np.ndarray,
    ) -> Rendering:
        """Face ``k`` of the panorama from ``place``: of the splats ``thin`` that ``reach`` (n,) into it.

        Args:
            apart: (n, 3) of the splats from there, along ``axes``.
            shown: (n, 1, 3) their harmonics.
        """
        ahead = apart[:, k % 3] if k < 3 else -apart[:, k % 3]
        beside = np.maximum(np.abs(apart[:, (k + 1) % 3]), np.abs(apart[:, (k + 2) % 3]))
        rows = np.flatnonzero((ahead > 0) & (beside < ahead + reach))
        cloud = GaussianCloud(
            np.take(thin.means, rows, axis=0),
            np.take(thin.quaternions, rows, axis=0),
            np.take(thin.scales, rows, axis=0),
            np.take(thin.opacities, rows),
            np.take(shown, rows, axis=0),
            thin.kernel,
        )
        return render_splats(
            cloud,
            self._face(place, k),
            background=(0, 0, 0),
            threads=1,
            dilation=DILATION * (SIDE / SHARP_SIDE) ** 2,
        )

    def depth_along(self, depth: np.ndarray, gaze: np.ndarray) -> float:
        """Mean of the logarithm of ``depth`` (of a panorama) in the view along ``gaze`` (3,), as a depth."""
        inside = (self.rays @ gaze > np.cos(np.radians(CONE))) & np.isfinite(depth)
        return float(np.exp(np.mean(np.log(depth[inside])))) if inside.any() else self.radius

    def seen_at(
        self, depth: np.ndarray, place: np.ndarray, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Which of the splats ``rows`` are seen in a panorama with that ``depth``: (k,) bool; and (k, 3) the
        unit vectors towards them."""
        toward = self.means[rows] - place
        away = np.linalg.norm(toward, axis=1) + 1e-9 * self.radius
        toward = toward / away[:, None]
        along = toward @ self.cube.T
        face = along.argmax(axis=1)
        ahead = along[np.arange(len(rows)), face]
        x, y = (np.einsum("kj,kj->k", self.turns[face, axis], toward) / ahead for axis in (0, 1))
        column, row = (np.clip(((v + 1) / 2 * SIDE).astype(int), 0, SIDE - 1) for v in (x, y))
        return away <= 1.2 * depth[face * SIDE * SIDE + row * SIDE + column] + 2 * self.size[rows], toward


def merit(log_angle: np.ndarray, natural: float, finer: float) -> np.ndarray:
    """1 for splats that look as large as in photographs, less for others; 0 for blobs.

    Args:
        log_angle: logarithm of the angle.
        natural: angle of the splats in photographs.
        finer: tolerance below it, in its logarithm; above it is 0.8.
    """
    off = log_angle - np.log(natural)
    bell = np.exp(-0.5 * (off / np.where(off < 0, finer, 0.8)) ** 2)
    return bell / (1 + (np.exp(log_angle) / COARSE) ** 2)


def _normals(cloud: GaussianCloud) -> np.ndarray:
    """(n, 3) unit directions of the shortest axis of each splat."""
    shortest = cloud.scales.argmin(axis=1)
    rows = np.stack(
        [np.stack(row, axis=-1) for row in rotation_rows(*cloud.quaternions.T.astype(np.float64))], 1
    )
    normals: np.ndarray = rows[np.arange(len(shortest)), :, shortest]
    return normals


def _frame(points: np.ndarray, up: np.ndarray, radius: float) -> np.ndarray:
    """(3, 3) rows right, up, forward of a frame that follows the ``points`` (n, 3): right is their longest
    level axis, towards their longer tail."""
    level = np.stack(level_axes(up))
    flat = points @ level.T
    away = np.linalg.norm(flat, axis=1, keepdims=True)
    flat = flat / np.maximum(away / (2 * radius), 1)  # strays do not turn it
    _, axes = np.linalg.eigh((flat[:, :, None] * flat[:, None]).sum(axis=0))
    along = flat @ axes[:, 1]
    right = (-1.0 if np.sum(along**3) < 0 else 1.0) * (axes[:, 1] @ level)
    return np.stack([right, up, np.cross(up, right)])
