"""Data sets without photographs: images of splats from cameras placed around a scene, or inside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from meshsplats._common.choices import MAX_SIDE, Look
from meshsplats._common.kinds import need, need_all, need_choice
from meshsplats._core.library import check_threads
from meshsplats.cameras.placing import (
    ALL_ELEVATIONS,
    DISTANCES,
    OBJECT_ELEVATIONS,
    STEPS,
    SURROUNDED_ELEVATIONS,
    has_surroundings,
    inside_cameras,
    outside_cameras,
)
from meshsplats.datasets.views import CACHE_BYTES, WHITE, Dataset, ImageCache, View, ViewImage
from meshsplats.rendering.core_arguments import MAX_SAMPLES
from meshsplats.rendering.looks import check_look, draw_splats
from meshsplats.rendering.sight import check_sight
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.viewpoints.finding import FoundCameras, find_cameras

Placement = Literal["auto", "object", "surrounded", "inside", "found"]

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
    below: bool = False,
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
            'found': from where the splats look as they do in photographs (``find_cameras``). 'auto': 'found'
            unless the scene is an object; for objects 'surrounded' if more than 1 % of the opacity lies far
            beyond the subject, else 'object'. 'auto' with a ``distance`` or ``fov`` is never 'found'.
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
        below: of 'object', also from below.
        up: (3,) direction; None: ``framing.guess_up``.
        look: 'area': means over each pixel's area, for programs that take several samples a pixel. 'splats':
            as a 3DGS viewer shows them.
        zooms: zooms of the training views, in turn: 1 is the whole image, 2 a window of the same size of an
            image twice as large. None: ``ZOOMS`` of the look.
        samples: side of the grid of samples in each pixel. None: for 'area', ``TRAINING_SAMPLES`` in training
            views, which is faster, and the exact mean in test views; else 1.
        sh_degree, background, threads, cache_bytes: as in ``splat_views``.

    Raises ValueError for an empty cloud, an option out of its range, and ``cameras`` of which none sees any
    of the splats; a DataWarning names those that see none where others do.
    """
    need(GaussianCloud, cloud=cloud)
    need_all(Camera, cameras=cameras, optional=True)
    if len(cloud) == 0:
        raise ValueError("the scene is empty: there is nothing to make images of")
    need_choice(Placement, placement=placement)
    if train < 1 or test < 0:
        raise ValueError(f"there must be at least 1 training view and 0 test views, got {train} and {test}")
    if not 1 <= width <= MAX_SIDE or not (height is None or 1 <= height <= MAX_SIDE):
        raise ValueError(f"width and height must lie between 1 and {MAX_SIDE} pixels")
    if not (len(distance) == 2 and 0 < distance[0] <= distance[1] < np.inf):
        raise ValueError(f"distance must be the nearest and the farthest multiple, > 0, got {distance!r}")
    _check_drawing(look, sh_degree, samples, threads)
    zooms = ZOOMS[look] if zooms is None else zooms
    if not zooms or not all(isinstance(zoom, (int, np.integer)) and zoom >= 1 for zoom in zooms):
        raise ValueError(f"zooms must be whole numbers from 1 on, got {zooms!r}")
    first = max(test, HELD_OUT)  # of the training views
    free, found = fov is None and tuple(distance) == DISTANCES, None
    if cameras is not None:
        check_sight(cloud, cameras, threads=threads)
        cameras = [camera.with_near_plane(cloud.means) for camera in cameras]
        placed, first = _given(cameras, train, test, width)
    elif placement == "inside":
        placed = inside_cameras(
            cloud, first + train, up=up, width=width, height=height or width, fov=75.0 if fov is None else fov
        )
    elif found := _found(cloud, placement, first + train, up, width, height, free, threads):
        placed = list(found.cameras)
    else:
        if placement == "auto":
            placement = "surrounded" if has_surroundings(cloud) else "object"
        of_object = ALL_ELEVATIONS if below else OBJECT_ELEVATIONS
        placed = outside_cameras(
            cloud,
            first + train,
            elevations=SURROUNDED_ELEVATIONS if placement == "surrounded" else of_object,
            distance=distance,
            up=up,
            width=width,
            height=height or width,
            fov=50.0 if fov is None else fov,
        )
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
    around = cameras is None and placement in ("object", "surrounded")
    words = "" if found is None else found.seen_in_words()
    return Dataset(learned, held_out, "splats", look, cloud.origin, around, words)


def _found(
    cloud: GaussianCloud,
    placement: Placement,
    count: int,
    up: Sequence[float] | np.ndarray | None,
    width: int,
    height: int | None,
    free: bool,
    threads: int | None,
) -> FoundCameras | None:
    """The views of placement 'found'; None if the scene is to be seen from a dome; ``free``: no option of
    domes was given."""
    if placement != "found" and not (placement == "auto" and free):
        return None
    options: dict[str, Any] = {"up": up, "width": width, "height": height, "threads": threads}
    found = find_cameras(cloud, count, anywhere=placement == "found", **options)
    return None if found.kind == "object" and placement == "auto" else found


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

    Raises ValueError for an option out of its range.
    """
    _check_drawing(look, sh_degree, samples, threads)
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


def _check_drawing(look: Look, sh_degree: int | None, samples: int | None, threads: int | None) -> None:
    """ValueError for what ``render_splats`` refuses: images are rendered when they are first used."""
    check_look(look)
    check_threads(threads)
    if sh_degree is not None and sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree must be 0, 1, 2 or 3, got {sh_degree!r}")
    if samples is not None and not (isinstance(samples, (int, np.integer)) and 1 <= samples <= MAX_SAMPLES):
        raise ValueError(f"samples must be a whole number from 1 to {MAX_SAMPLES}, got {samples!r}")


def are_rendered(views: Sequence[View]) -> bool:
    """Whether some of ``views`` are images of splats, not photographs."""
    return any(isinstance(view.source, RenderedSplats) for view in views)


def shown_degree(views: Sequence[View]) -> int | None:
    """Greatest degree of the harmonics that the images of splats among ``views`` show; None: all of them,
    or there are no such images."""
    degrees = [view.source.sh_degree for view in views if isinstance(view.source, RenderedSplats)]
    known = [degree for degree in degrees if degree is not None]
    return max(known) if known and len(known) == len(degrees) else None


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
