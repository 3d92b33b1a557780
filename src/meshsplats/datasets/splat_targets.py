"""Data sets without photographs: images of splats from cameras placed around a scene, or inside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from meshsplats._kinds import need, need_all
from meshsplats.camera import MAX_SIDE, Camera
from meshsplats.cameras.framing import (
    SAMPLE,
    SURROUNDINGS,
    front_axes,
    guess_up,
    scene_bounds,
    unit_up,
    weighted_quantile,
)
from meshsplats.cameras.trajectories import NEAR_SHARE, look_at
from meshsplats.datasets.views import CACHE_BYTES, WHITE, Dataset, ImageCache, View, ViewImage
from meshsplats.gaussians import GaussianCloud
from meshsplats.rendering.looks import Look, check_look, draw_splats

Placement = Literal["auto", "object", "surrounded", "inside"]

STEPS = (1.324717957244746**-1, 1.324717957244746**-2, 2**0.5 - 1)
"""Steps of Kronecker's sequence for azimuth, height and distance: its points modulo 1 fill the unit cube
evenly in every run of successive points. The first two are powers of the inverse of the plastic number, the
most even pair known: directions matter most."""
OBJECT_ELEVATIONS = (0.0, 60.0)
SURROUNDED_ELEVATIONS = (3.0, 60.0)
"""Degrees above the horizon. Few captures show anything from below, and flat ground seen from the side is so
hard to match that such views make the others worse."""
INSIDE_ELEVATIONS = (-35.0, 35.0)
DISTANCES = (0.9, 1.1)
"""Multiples of the distance at which the subject just fits."""
SURROUNDINGS_SHARE = 0.01
"""A subject has surroundings if more than this share of the opacity lies beyond it."""
STANDS = 12
"""Largest number of places for cameras inside a scene."""
HELD_OUT = 8
"""Least number of views that are never trained on, used or not: a mesh can be evaluated on them later,
however it was trained."""
ZOOMS = {"area": (1,), "splats": (1, 2, 4)}
"""Zooms of the training views of each look, in turn: 1 is the whole image; 2 is a window of the same size of
an image twice as large. The filter of splat viewers has another width in the scene at every image size, and
a mesh that is drawn with it has to take the unfiltered shape. Means over areas hold for all sizes. Not four
zooms: four of ``STEPS[0]`` are almost whole turns, so that views of one zoom follow each other closely."""
TRAINING_SAMPLES = 2
"""Side of the grid of samples in each pixel of training views, for the look 'area'."""
WINDOW_CENTERS = 4096
"""Number of splats around which windows are cut out. Windows that are spread over the image show little but
background where the subject is slim."""
CANDIDATES = 512
"""Number of points that are tried as such places."""
ROOMY = 0.4
"""Least clearance of a place as a share of the largest one."""


def splat_dataset(
    cloud: GaussianCloud,
    *,
    placement: Placement = "auto",
    cameras: Sequence[Camera] | None = None,
    train: int = 64,
    test: int = 8,
    width: int = 400,
    height: int | None = None,
    fov: float | None = None,
    distance: tuple[float, float] = DISTANCES,
    up: Sequence[float] | np.ndarray | None = None,
    look: Look = "area",
    zooms: Sequence[int] | None = None,
    sh_degree: int | None = None,
    background: Sequence[float] = WHITE,
    samples: int | None = None,
    threads: int | None = None,
    cache_bytes: int = CACHE_BYTES,
) -> Dataset:
    """A data set made of splats alone: their images from cameras placed around them.

    Args:
        cloud: the splats.
        placement: 'object': cameras on all sides, from the horizon up. 'surrounded': an object in its
            surroundings, seen from all around; cameras a little above the ground. 'inside': cameras in free
            places between the splats that look outwards, for rooms and other scenes captured from inside.
            'auto': 'surrounded' if more than 1 % of the opacity lies far beyond the subject, else 'object';
            never 'inside', as splats of a room and of a hollow object look alike.
        cameras: cameras that the scene was trained from, as in the cameras.json of a model folder, instead of
            a placement. ``train`` and ``test`` of them are used (at most every eighth for testing), evenly
            spread and scaled to ``width``; ``height``, ``fov``, ``distance`` and ``up`` have no effect.
        train, test: numbers of views. Held-out views are the first of a sequence that the training views
            continue, so both are evenly spread and none coincide; the first ``HELD_OUT`` are never trained
            on, for any number of views.
        width, height: size in pixels; ``height`` None: as ``width``.
        fov: degrees that the shorter side spans; None: 50, or 75 inside.
        distance: nearest and farthest camera of 'object' and 'surrounded', as multiples of the distance at
            which the sphere with 90 % of the splats' opacity (or the whole subject, if that is smaller) just
            fits into the image.
        up: (3,) direction; None: ``framing.guess_up``.
        look: 'area': means over each pixel's area, for programs that take several samples a pixel. 'splats':
            as a 3DGS viewer shows them.
        zooms: zooms of the training views, in turn: 1 is the whole image, 2 a window of the same size of an
            image twice as large. None: ``ZOOMS`` of the look.
        samples: side of the grid of samples in each pixel. None: for 'area', ``TRAINING_SAMPLES`` in training
            views, which is faster, and the exact mean in test views; else 1.
        sh_degree, background, threads, cache_bytes: as in ``splat_views``.

    Raises ValueError for an empty cloud or an option out of its range.
    """
    need(GaussianCloud, cloud=cloud)
    need_all(Camera, cameras=cameras, optional=True)
    if len(cloud) == 0:
        raise ValueError("the scene is empty: there is nothing to make images of")
    if placement not in ("auto", "object", "surrounded", "inside"):
        raise ValueError(f"placement must be auto, object, surrounded or inside, got {placement!r}")
    if train < 1 or test < 0:
        raise ValueError(f"there must be at least 1 training view and 0 test views, got {train} and {test}")
    if not 1 <= width <= MAX_SIDE or not (height is None or 1 <= height <= MAX_SIDE):
        raise ValueError(f"width and height must lie between 1 and {MAX_SIDE} pixels")
    if not (len(distance) == 2 and 0 < distance[0] <= distance[1] < np.inf):
        raise ValueError(f"distance must be the nearest and the farthest multiple, > 0, got {distance!r}")
    first = max(test, HELD_OUT)  # of the training views
    if cameras is not None:
        cameras = [camera.with_near_plane(cloud.means) for camera in cameras]
        placed, first = _given(cameras, train, test, width)
    elif placement == "inside":
        placed = inside_cameras(
            cloud, first + train, up=up, width=width, height=height or width, fov=75.0 if fov is None else fov
        )
    else:
        if placement == "auto":
            placement = "surrounded" if has_surroundings(cloud) else "object"
        placed = outside_cameras(
            cloud,
            first + train,
            elevations=SURROUNDED_ELEVATIONS if placement == "surrounded" else OBJECT_ELEVATIONS,
            distance=distance,
            up=up,
            width=width,
            height=height or width,
            fov=50.0 if fov is None else fov,
        )
    check_look(look)
    zooms = ZOOMS[look] if zooms is None else zooms
    if not zooms or min(zooms) < 1:
        raise ValueError(f"zooms must be whole numbers from 1 on, got {zooms!r}")
    centers = window_centers(cloud)
    learned_from = [
        window_of_image(camera, zooms[i % len(zooms)], i, centers) for i, camera in enumerate(placed[first:])
    ]
    quick = TRAINING_SAMPLES if look == "area" else None
    held_out, learned = (
        splat_views(
            cloud,
            part,
            look=look,
            sh_degree=sh_degree,
            background=background,
            samples=side if samples is None else samples,
            threads=threads,
            cache_bytes=share,
        )
        for part, side, share in (
            (placed[: min(test, first)], None, cache_bytes // 8),
            (learned_from, quick, cache_bytes - cache_bytes // 8),
        )
    )
    return Dataset(learned, held_out, "splats", look, cloud.origin)


def has_surroundings(cloud: GaussianCloud) -> bool:
    """Whether more than ``SURROUNDINGS_SHARE`` of the opacity lies far outside the subject, as
    ``framing.scene_bounds`` has it."""
    center = scene_bounds(cloud).center
    distance = np.linalg.norm(cloud.means - center, axis=1)
    weights = cloud.opacities.astype(np.float64)
    if weights.sum() == 0:
        return False
    far = distance > SURROUNDINGS * weighted_quantile(distance, weights, 0.5)
    return bool(weights[far].sum() > SURROUNDINGS_SHARE * weights.sum())


def outside_cameras(
    cloud: GaussianCloud,
    count: int,
    *,
    elevations: tuple[float, float] = OBJECT_ELEVATIONS,
    distance: tuple[float, float] = DISTANCES,
    up: Sequence[float] | np.ndarray | None = None,
    width: int = 400,
    height: int = 400,
    fov: float = 50.0,
) -> list[Camera]:
    """``count`` cameras that look at the subject's middle, evenly spread over directions and distances.

    Directions are even on the sphere between two ``elevations`` (degrees), distances on a logarithmic scale.
    Every run of successive cameras is evenly spread, too. The other arguments are those of ``splat_dataset``.
    """
    axes = front_axes(guess_up(cloud) if up is None else unit_up(up))
    bounds = scene_bounds(cloud)  # refuses an empty cloud
    # Surroundings may have most of the opacity; then only the subject has to fit.
    reach = float(np.linalg.norm(bounds.points - bounds.center, axis=1).max(initial=0))
    fit = (min(bounds.radius, reach) or bounds.radius) / np.sin(np.radians(fov / 2))
    turns, heights, share = _sequence(count)
    low, high = np.sin(np.radians(elevations))
    away = fit * distance[0] * (distance[1] / distance[0]) ** share
    return [
        look_at(
            bounds.center + away[i] * _towards(axes, 2 * np.pi * turns[i], low + (high - low) * heights[i]),
            bounds.center,
            up=axes[1],
            width=width,
            height=height,
            fov=fov,
            near=away[i] * NEAR_SHARE,
            name=f"view_{i:04d}",
        )
        for i in range(count)
    ]


def _sequence(count: int) -> np.ndarray:
    """(3, count) numbers in [0, 1)."""
    return (0.5 + np.outer(STEPS, np.arange(count))) % 1


def _towards(axes: np.ndarray, turn: float, height: float) -> np.ndarray:
    """(3,) unit direction ``turn`` radians around the up axis; ``height``: the sine of its elevation."""
    right, upward, forward = axes
    level = np.sqrt(1 - height * height)
    return level * (np.sin(turn) * right + np.cos(turn) * forward) + height * upward


def inside_cameras(
    cloud: GaussianCloud,
    count: int,
    *,
    up: Sequence[float] | np.ndarray | None = None,
    width: int = 400,
    height: int = 400,
    fov: float = 75.0,
) -> list[Camera]:
    """``count`` cameras inside the scene that look outwards, in all directions near the horizon.

    They stand in up to ``STANDS`` places, far from each other, in the middle parts of the scene where the
    nearest splat is farthest away; the cameras in each place look in all directions.
    """
    axes = front_axes(guess_up(cloud) if up is None else unit_up(up))
    places, clearances = _free_places(cloud, axes, max(1, min(STANDS, count // 6)))
    low, high = np.sin(np.radians(INSIDE_ELEVATIONS))
    turns, heights, _ = _sequence(count)
    cameras = []
    for i in range(count):
        stand = i % len(places)
        direction = _towards(axes, 2 * np.pi * turns[i], low + (high - low) * heights[i])
        cameras.append(
            look_at(
                places[stand],
                places[stand] + clearances[stand] * direction,
                up=axes[1],
                width=width,
                height=height,
                fov=fov,
                near=clearances[stand] * 0.05,
                name=f"view_{i:04d}",
            )
        )
    return cameras


def _free_places(cloud: GaussianCloud, axes: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Up to ``count`` points (k, 3) between the splats, and (k,) how far the nearest splat is from each."""
    bounds = scene_bounds(cloud)  # refuses an empty cloud
    solid = np.flatnonzero(cloud.opacities > 0.1)
    rows = (solid if len(solid) else np.arange(len(cloud)))[:: -(-max(len(solid), 1) // SAMPLE)]
    points = cloud.means[rows].astype(np.float64)
    reach = 2 * np.median(cloud.scales[rows].astype(np.float64), axis=1)
    along = bounds.points @ axes.T
    low, high = (
        np.array([weighted_quantile(along[:, k], bounds.weights, q) for k in range(3)]) for q in (0.02, 0.98)
    )
    # The middle three quarters across and the middle half in height: people do not crawl.
    middle, half = (low + high) / 2, (high - low) / 2 * [0.75, 0.5, 0.75]
    # Kronecker's sequence of the plastic number's powers fills a cube evenly.
    steps = 1.2207440846057596 ** -np.arange(1, 4)
    inner = 2 * ((0.5 + np.arange(CANDIDATES)[:, None] * steps) % 1) - 1
    tried = (middle + half * inner) @ axes
    clearance = np.empty(CANDIDATES)
    square = (points**2).sum(axis=1)
    for start in range(0, CANDIDATES, 64):
        some = tried[start : start + 64]
        apart = np.maximum((some**2).sum(axis=1)[:, None] - 2 * some @ points.T + square, 0)
        clearance[start : start + 64] = (np.sqrt(apart) - reach).min(axis=1)
    best = clearance.max()
    if best <= 0:
        raise ValueError("no free place was found inside the scene; is it an object (placement 'object')?")
    roomy = np.flatnonzero(clearance >= ROOMY * best)
    chosen = [int(roomy[clearance[roomy].argmax()])]
    while len(chosen) < min(count, len(roomy)):
        away = np.linalg.norm(tried[roomy][:, None] - tried[chosen], axis=2).min(axis=1)
        chosen.append(int(roomy[away.argmax()]))
    return tried[chosen], clearance[chosen]


def window_centers(cloud: GaussianCloud) -> np.ndarray:
    """(WINDOW_CENTERS, 3): means of splats, evenly spread over the opacity in the order of the file."""
    opacity = np.cumsum(cloud.opacities, dtype=np.float64)
    shares = (np.arange(WINDOW_CENTERS) + 0.5) / WINDOW_CENTERS
    chosen = np.searchsorted(opacity, shares * opacity[-1])
    return cloud.means[np.minimum(chosen, len(cloud) - 1)]


def window_of_image(camera: Camera, zoom: int, number: int, centers: np.ndarray) -> Camera:
    """As large an image, cut out of that of ``camera`` drawn ``zoom`` times as large, around one of
    ``centers``, scene points (k, 3), that ``camera`` sees; ``number`` spreads such windows over them."""
    if zoom == 1:
        return camera
    x, y = camera.width / 2, camera.height / 2
    positions, _ = camera.project(centers)
    seen = positions[camera.in_image(positions)]
    if len(seen):
        x, y = seen[int((0.5 + STEPS[2] * number) % 1 * len(seen))].tolist()
    left = round(min(max(x * zoom - camera.width / 2, 0), (zoom - 1) * camera.width))
    top = round(min(max(y * zoom - camera.height / 2, 0), (zoom - 1) * camera.height))
    return replace(
        camera,
        fx=camera.fx * zoom,
        fy=camera.fy * zoom,
        cx=camera.cx * zoom - left,
        cy=camera.cy * zoom - top,
    )


def _given(cameras: Sequence[Camera], train: int, test: int, width: int) -> tuple[list[Camera], int]:
    """Up to ``test`` of the cameras, at most every eighth, spread over them, then up to ``train`` of the
    others; with images ``width`` pixels wide. And the number of the first of those."""
    if len(cameras) < 1:
        raise ValueError("cameras is empty; leave it out to have cameras placed")
    held = _spread(len(cameras), min(test, -(-len(cameras) // 8) if len(cameras) > 1 else 0))
    rest = np.delete(np.arange(len(cameras)), held)
    chosen = [*held, *rest[_spread(len(rest), min(train, len(rest)))]]
    return [cameras[i].scaled(width / cameras[i].width) for i in chosen], len(held)


def _spread(count: int, some: int) -> list[int]:
    """``some`` indices below ``count``, evenly spread."""
    return [int((i + 0.5) * count / some) for i in range(some)]


def splat_views(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    *,
    look: Look = "area",
    sh_degree: int | None = None,
    background: Sequence[float] = WHITE,
    samples: int | None = None,
    threads: int | None = None,
    cache_bytes: int = CACHE_BYTES,
) -> tuple[View, ...]:
    """Views whose images are rendered from the splats: targets where there are no photographs.

    ``look``, ``sh_degree``, ``samples`` and ``threads`` are those of ``rendering.looks.draw_splats``. Images
    have alpha, so that they can be laid over any background; ``background`` is that of ``View.image``. They
    are rendered at first use and kept in float16, 8 bytes a pixel, as in ``load_dataset``.
    """
    check_look(look)
    red, green, blue = map(float, background)
    store = ImageCache(cache_bytes)
    return tuple(
        View(
            camera,
            RenderedSplats(cloud, camera, look, sh_degree, samples, threads, store),
            (red, green, blue),
        )
        for camera in cameras
    )


@dataclass(frozen=True, eq=False)
class RenderedSplats:
    """An image of splats, rendered on demand."""

    cloud: GaussianCloud
    camera: Camera
    look: Look
    sh_degree: int | None
    samples: int | None
    threads: int | None
    store: ImageCache = field(repr=False)

    def load(self) -> ViewImage:
        return self._drawn(self.samples)

    def points(self) -> ViewImage:
        """The values at the pixels' centres, without the mean over their areas of the look 'area'."""
        return self._drawn(1)

    def _drawn(self, samples: int | None) -> ViewImage:
        image = self.store.find((self, samples))
        if image is None:
            drawn = draw_splats(
                self.cloud,
                self.camera,
                self.look,
                background=(0, 0, 0),
                samples=samples,
                sh_degree=self.sh_degree,
                threads=self.threads,
            )
            # Values beyond float16 are far brighter than any display.
            color = np.clip(drawn.color, 0, 60_000).astype(np.float16)
            image = ViewImage(color, drawn.alpha.astype(np.float16))
            self.store.keep((self, samples), image)
        return image

    @property
    def nbytes(self) -> int:
        kinds = 2 if self.look == "area" else 1  # means and points
        return 8 * kinds * self.camera.width * self.camera.height
