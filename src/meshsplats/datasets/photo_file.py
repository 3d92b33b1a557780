"""A photograph of a data set, which is read when it is needed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from meshsplats._common.arrays import area_means
from meshsplats.datasets.lens import WHOLE, Lens, Pinhole, undistort
from meshsplats.datasets.views import ImageCache, ViewImage
from meshsplats.images.reading import load_image

FINE = 2.5
"""Pixels along a side for each pixel of the undistorted image that suffice: photographs with twice as many
are made smaller first, down to about these. Finer ones take long, for what cannot be seen."""


@dataclass(frozen=True, eq=False)
class PhotoFile:
    """A photograph, read, brought to size and undistorted when it is asked for."""

    name: str
    """As the data set has it."""
    path: Path
    lens: Lens
    """The lens before the image at the size it is used in."""
    pinhole: Pinhole
    mask: Path | None
    has_alpha: bool
    store: ImageCache = field(repr=False)
    cut_out: bool = False
    """Whether the mask is the subject's outline: what is outside is clear."""
    turn: int = 0
    """``Header.turn`` of the photograph."""
    mask_turn: int = 0
    """Quarter turns counter-clockwise after which the mask lies on the photograph as it is stored."""
    as_stored: bool = False
    """Whether its colour profile is ignored, as most programs that train splats do."""

    def load(self) -> ViewImage:
        image = self.store.find(self)
        if image is None:
            image = self._read()
            self.store.keep(self, image)
        return image

    @property
    def nbytes(self) -> int:
        masked = (self.mask is not None and not self.cut_out) or not self.lens.is_pinhole
        return ((8 if self.has_alpha else 3) + masked) * self.pinhole.width * self.pinhole.height

    def _read(self) -> ViewImage:
        pixels = load_image(self.path, to_srgb=not self.as_stored)
        color = pixels[..., :3]
        share = pixels[..., 3].astype(np.float32) / 255 if pixels.shape[2] == 4 else None
        light = None if self.mask is None else light_of_mask(self.mask, self.mask_turn)
        if self.cut_out and light is not None:
            inside = _resized(light, (color.shape[1], color.shape[0]))
            share = inside if share is None else share * inside
            light = None
        if not self.lens.is_pinhole:
            return self._undistorted(color, share, light)
        size = (self.lens.width, self.lens.height)
        mask = None if light is None else _resized(light, size) >= WHOLE
        if share is None:
            return ViewImage(_resized(color, size), None, mask)
        layers = np.stack([_resized(layer, size) for layer in _premultiplied(color, share)], axis=-1)
        return _with_alpha(layers.astype(np.float16), mask)

    def _undistorted(
        self, color: np.ndarray, share: np.ndarray | None, light: np.ndarray | None
    ) -> ViewImage:
        """The image of ``color`` (h, w, 3) uint8, with the opacity ``share`` (h, w) float32 and the mask
        ``light`` (h, w) float32 of any size. Made smaller only as it is undistorted: either blurs."""
        if share is None:
            color = self._bounded(color)
        else:  # in bytes: as floats, large photographs would take gigabytes
            layers = (np.rint(255 * layer).astype(np.uint8) for layer in _premultiplied(color, share))
            color = np.stack([self._bounded(layer) for layer in layers], axis=-1)
        color, seen = undistort(color, self.lens, self.pinhole)
        if light is not None:
            counts = undistort(self._bounded(light)[..., None], self.lens, self.pinhole)[0]
            seen = counts[..., 0] >= WHOLE  # 0 where nothing was seen
        if share is None:
            return ViewImage(color, None, seen)
        return _with_alpha((color / np.float32(255)).astype(np.float16), seen)

    def _bounded(self, pixels: np.ndarray) -> np.ndarray:
        """``pixels`` (h, w) or (h, w, c), made smaller if they are more than twice as fine as they need be,
        or larger if they are coarser than the lens."""
        height, width = pixels.shape[:2]
        lens = self.lens
        if width < lens.width or height < lens.height:
            return _resized(pixels, (lens.width, lens.height))
        factor = int(min(width / lens.width, height / lens.height) / FINE)
        return _resized(pixels, (round(width / factor), round(height / factor))) if factor > 1 else pixels


def _premultiplied(color: np.ndarray, share: np.ndarray) -> Iterator[np.ndarray]:
    """(h, w) float32 each: the channels of ``color`` (h, w, 3) uint8, in units of 1, times ``share`` (h, w),
    and this. Colours of clear pixels mean nothing: mixing must see each as much as it is opaque."""
    for i in range(3):
        yield color[..., i].astype(np.float32) / 255 * share
    yield share


def _with_alpha(layers: np.ndarray, mask: np.ndarray | None) -> ViewImage:
    """The image of ``layers`` (h, w, 4), colour times alpha, and alpha."""
    color, alpha = (np.ascontiguousarray(part) for part in (layers[..., :3], layers[..., 3]))
    return ViewImage(color, alpha, mask)


def light_of_mask(path: Path, turn: int = 0) -> np.ndarray:
    """(h, w) float32: 1 where the mask at ``path`` is light (128 of 255 or more; of 0 and 1 alone, 1) and,
    with alpha, opaque; else 0. Turned counter-clockwise by so many quarter turns."""
    pixels = np.rot90(load_image(path), turn)
    light = pixels[..., :3].max(axis=2)
    if pixels.shape[2] == 4:
        light = np.minimum(light, pixels[..., 3])
    return (light >= (1 if light.max() == 1 else 128)).astype(np.float32)


def _resized(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """``pixels`` (h, w) float32 or (h, w, 3) uint8 at ``size`` (width, height): each new pixel is the mean
    over its area."""
    from PIL import Image

    (height, width), (columns, rows) = pixels.shape[:2], size
    if (width, height) == size:
        return pixels
    if (width % columns == 0 and height % rows == 0) or columns > width or rows > height:
        return np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))
    # Pillow's box takes whole pixels, by their centres, and shifts what it shows by up to a quarter of one.
    result = np.empty((rows, columns, *pixels.shape[2:]), pixels.dtype)
    for channel in np.ndindex(pixels.shape[2:]):  # one at a time: photographs are large
        one = (..., *channel)
        means = area_means(pixels[one], rows, columns)
        result[one] = np.rint(means) if pixels.dtype == np.uint8 else means
    return result
