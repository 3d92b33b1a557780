"""Stereo in the compiled core: depths of photographs, what they say of each other, patches of their points.

Callers have checked their arrays: C-contiguous, of the types and shapes named here. All results have the same
bits with any number of threads.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from meshsplats._core.library import pointer, run, thread_count
from meshsplats._core.structures import (
    CameraStruct,
    CarvingStruct,
    ConsistencyStruct,
    FillingStruct,
    FusionStruct,
    MatchingStruct,
    ViewsStruct,
)


class Layout:
    """Images of several cameras, one after the other, row by row: "(pixels,)" is an array for all of them."""

    def __init__(self, cameras: Sequence[CameraStruct]) -> None:
        self.cameras = (CameraStruct * len(cameras))(*cameras)
        self.start = np.cumsum([0, *(camera.width * camera.height for camera in cameras)], dtype=np.int64)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def pixels(self) -> int:
        """Of all images."""
        return int(self.start[-1])

    def image(self, values: np.ndarray, index: int) -> np.ndarray:
        """The part of ``values`` (pixels, ...) that belongs to an image, (h, w, ...): a view."""
        camera = self.cameras[index]
        part = values[self.start[index] : self.start[index + 1]]
        return part.reshape(camera.height, camera.width, *values.shape[1:])

    def struct(self, threads: int | None) -> ViewsStruct:
        return ViewsStruct(
            cameras=ctypes.addressof(self.cameras),
            start=pointer(self.start),
            count=len(self.cameras),
            threads=thread_count(threads),
        )


class Planes(NamedTuple):
    """For each pixel a plane in space, (pixels,) float32 each."""

    inverse: np.ndarray
    """Inverse depth."""
    along_x: np.ndarray
    """Its change from one pixel to the next to the right..."""
    along_y: np.ndarray
    """... and downwards."""
    score: np.ndarray
    """Normalised cross-correlation with other photographs, -1 to 1."""


class Pairs(NamedTuple):
    """Which photographs are matched with which."""

    photo: np.ndarray
    """(m,) int32 the photographs whose depths are wanted."""
    sources: np.ndarray
    """(m, k) int32 those that each is matched with; -1: none."""
    range: np.ndarray
    """(m, 2) float32 least and greatest inverse depth."""


def match_photos(
    photos: Layout,
    color: np.ndarray,
    matched: Layout,
    pairs: Pairs,
    *,
    planes: int,
    rounds: int,
    threads: int | None = None,
) -> Planes:
    """The planes of the ``matched`` photographs, which are those of ``pairs.photo``: see csrc/stereo.h.

    ``color``: (pixels, 3) uint8 of all ``photos``. ``planes`` inverse depths are swept at half the size; then
    slanted windows are improved ``rounds`` times (-1: not at all).
    """
    found = Planes(*(np.zeros(matched.pixels, np.float32) for _ in Planes._fields))
    struct = MatchingStruct(
        photos=photos.struct(threads),
        color=pointer(color),
        matched=matched.struct(threads),
        photo=pointer(pairs.photo),
        sources=pointer(pairs.sources),
        range=pointer(pairs.range),
        **{name: pointer(values) for name, values in found._asdict().items()},
        source_count=pairs.sources.shape[1],
        planes=planes,
        rounds=rounds,
    )
    run("ms_match_photos", struct)
    return found


class Consistency(NamedTuple):
    """For each pixel with a depth how many other views, (pixels,) uint8, ..."""

    agree: np.ndarray
    """see the same place,"""
    past: np.ndarray
    """see something behind it,"""
    seen: np.ndarray
    """have it in the image, with nothing that is known in front of it."""


def count_consistent(
    views: Layout,
    inverse: np.ndarray,
    others: np.ndarray,
    neighbors: np.ndarray,
    tolerances: tuple[float, float],
    threads: int | None = None,
) -> Consistency:
    """What the depths ``others`` say of the depths ``inverse``, both (pixels,) float32 inverse, 0: none.

    ``neighbors``: (views, k) int32 views that check each; -1: none. ``tolerances``: relative differences of
    depth up to which they agree, and from which they see past it.
    """
    found = Consistency(*(np.zeros(views.pixels, np.uint8) for _ in Consistency._fields))
    struct = ConsistencyStruct(
        views=views.struct(threads),
        inverse=pointer(inverse),
        others=pointer(others),
        neighbors=pointer(neighbors),
        **{name: pointer(values) for name, values in found._asdict().items()},
        tolerance=tolerances[0],
        past_tolerance=tolerances[1],
        neighbor_count=neighbors.shape[1],
    )
    run("ms_count_consistent", struct)
    return found


def fill_depths(
    views: Layout,
    color: np.ndarray,
    planes: Planes,
    known: np.ndarray,
    *,
    per_pixel: float,
    threads: int | None = None,
) -> np.ndarray:
    """(pixels,) float32 inverse depths of the planes of the ``known`` (pixels,) bool pixels, continued to all
    others of their image; 0 in images without any.

    ``color``: (pixels, 3) uint8. ``per_pixel``: what a pixel of distance counts, in differences of colour.
    """
    result = np.zeros(views.pixels, np.float32)
    struct = FillingStruct(
        views=views.struct(threads),
        color=pointer(color),
        inverse=pointer(planes.inverse),
        along_x=pointer(planes.along_x),
        along_y=pointer(planes.along_y),
        known=pointer(known),
        result=pointer(result),
        per_pixel=per_pixel,
    )
    run("ms_fill_depths", struct)
    return result


def count_views(
    views: Layout,
    inverse: np.ndarray,
    points: np.ndarray,
    tolerances: tuple[float, float],
    threads: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) int32 each: how many ``views`` have a known depth at ``points`` (n, 3) float64, and how many see
    past them. ``inverse`` and ``tolerances`` as in ``count_consistent``."""
    agree, past = np.zeros((2, len(points)), np.int32)
    struct = CarvingStruct(
        views=views.struct(threads),
        inverse=pointer(inverse),
        points=pointer(points),
        agree=pointer(agree),
        past=pointer(past),
        count=len(points),
        tolerance=tolerances[0],
        past_tolerance=tolerances[1],
    )
    run("ms_count_views", struct)
    return agree, past


class SurfaceArrays(NamedTuple):
    """n points on surfaces."""

    points: np.ndarray
    """(n, 3) float32."""
    normals: np.ndarray
    """(n, 3) float32 unit vectors; 0: unknown."""
    pixels: np.ndarray
    """(n,) float32 size of a pixel of its photograph at each."""
    colors: np.ndarray
    """(n, 3) uint8."""
    sure: np.ndarray
    """(n,) uint8: 1 for those that other views confirm."""


class Fused(NamedTuple):
    """m patches, columns of float32."""

    points: np.ndarray
    """(m, 3)."""
    axes: np.ndarray
    """(m, 3, 3) the longer axis, the shorter one, the normal."""
    deviations: np.ndarray
    """(m, 3) standard deviations of its points along them."""
    colors: np.ndarray
    """(m, 3) mean of its points, 0 to 1."""
    pixels: np.ndarray
    """(m,) size of a pixel."""
    sure: np.ndarray
    """(m,) share of its points that are sure."""
    counts: np.ndarray
    """(m,) number of its points."""


def fuse_points(surface: SurfaceArrays, wanted: int, largest: float, threads: int | None = None) -> Fused:
    """At most ``wanted`` patches for the points of ``surface``: see csrc/fusion.h.

    ``largest``: their greatest standard deviation in pixels, as long as there are enough of them.
    """
    table = np.zeros((wanted, 21), np.float32)
    struct = FusionStruct(
        points=pointer(surface.points),
        normals=pointer(surface.normals),
        pixels=pointer(surface.pixels),
        colors=pointer(surface.colors),
        sure=pointer(surface.sure),
        patches=pointer(table),
        count=len(surface.points),
        wanted=wanted,
        threads=thread_count(threads),
        largest=largest,
    )
    run("ms_fuse_points", struct)
    t = table[: struct.found]
    return Fused(
        t[:, :3], t[:, 3:12].reshape(-1, 3, 3), t[:, 12:15], t[:, 15:18], t[:, 18], t[:, 19], t[:, 20]
    )
