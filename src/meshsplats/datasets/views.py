"""Dataset: cameras with their images, for training and for testing; read from folders, or rendered
from splats."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from meshsplats._common.arrays import check_units, checked_array
from meshsplats._common.choices import Look
from meshsplats._common.kinds import need, need_all
from meshsplats.errors import DataWarning
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import MAX_COLOR
from meshsplats.scene.origin import in_words, zero_origin

CACHE_BYTES = 2 << 30
"""Default limit on the images of a data set that are kept in memory after their first use, bytes."""
WHITE = (1.0, 1.0, 1.0)
SHOWN = 5
"""Names in a message, at most."""
_PIXELS = 1 << 18
"""Pixels that the check of premultiplied colours looks at, about."""
_ROUNDING = 0.03
"""Excess of a premultiplied colour that may come from rounding and resampling."""
_MOST_BRIGHT = 0.1
"""Share of the pixels that may be too bright, as around the edges of what JPEG has stored."""


@dataclass(frozen=True, eq=False)
class ViewImage:
    """The image of one view. Values are display-referred (sRGB-encoded), rows run from top to bottom."""

    color: np.ndarray
    """(h, w, 3) RGB, premultiplied by alpha where there is one (straight RGB, as of a .png file, is refused):
    uint8 (255 is 1), or float16 or float32 with white at 1."""
    alpha: np.ndarray | None = None
    """(h, w) opacity, of the same type; None: opaque, as photographs are."""
    mask: np.ndarray | None = None
    """(h, w) bool, True where pixels count; None: all of them."""

    def __post_init__(self) -> None:
        need(np.ndarray, color=self.color)
        need(np.ndarray, alpha=self.alpha, mask=self.mask, optional=True)
        shape = self.color.shape
        if len(shape) != 3 or shape[2] != 3 or self.color.dtype not in (np.uint8, np.float16, np.float32):
            raise ValueError(
                f"color must have shape (h, w, 3) and type uint8, float16 or float32,"
                f" got {shape} {self.color.dtype}"
            )
        if self.alpha is not None and (self.alpha.shape, self.alpha.dtype) != (shape[:2], self.color.dtype):
            raise ValueError(f"alpha must have shape {shape[:2]} and the type of color")
        if self.mask is not None and (self.mask.shape, self.mask.dtype) != (shape[:2], np.dtype(bool)):
            raise ValueError(f"mask must have shape {shape[:2]} and type bool")
        if self.color.dtype == np.float32:  # float16 are images of splats, of which some are far too bright
            check_units("color", self.color)
        if self.alpha is not None and self.color.dtype != np.float16:
            _check_premultiplied(self.color, self.alpha)

    def over(self, background: Sequence[float] | np.ndarray = WHITE) -> np.ndarray:
        """(h, w, 3) float32 ``color + (1 - alpha) * background``; ``background``: RGB, (3,) or (h, w, 3)."""
        color = _unit(self.color)
        if self.alpha is None:
            return color
        return color + (1 - _unit(self.alpha))[..., None] * np.asarray(background, np.float32)

    def __repr__(self) -> str:
        height, width = self.color.shape[:2]
        more = [name for name in ("alpha", "mask") if getattr(self, name) is not None]
        return f"ViewImage({', '.join([f'{width} x {height} {self.color.dtype}', *more])})"

    @property
    def nbytes(self) -> int:
        return sum(a.nbytes for a in (self.color, self.alpha, self.mask) if a is not None)


class ImageSource(Protocol):
    """Loads an image on demand."""

    def load(self) -> ViewImage: ...

    @property
    def nbytes(self) -> int:
        """Memory of the loaded image in bytes, known in advance."""
        ...


@dataclass(frozen=True, eq=False)
class View:
    """A camera and its image, which is read or rendered at first use."""

    camera: Camera
    """Pinhole camera of the image's size; photographs of other lenses are undistorted to it."""
    source: ViewImage | ImageSource
    background: tuple[float, float, float] = WHITE
    """RGB in [0, 1] over which ``image`` shows images with alpha."""
    turn: int = 0
    """Quarter turns clockwise after which the image is upright, as of a photograph that was taken with the
    camera held upright and stored on its side."""

    def __repr__(self) -> str:
        return f"View({self.name!r}, {self.camera.width} x {self.camera.height})"

    @property
    def name(self) -> str:
        """The image's name, relative to the data set."""
        return self.camera.name

    @property
    def upright(self) -> Camera:
        """The camera as it was held: with its image upright, after ``turn``."""
        camera = self.camera
        for _ in range(self.turn % 4):
            matrix = camera.world_to_camera[[1, 0, 2, 3]] * [[-1], [1], [1], [1]]
            camera = replace(
                camera,
                world_to_camera=matrix,
                fx=camera.fy,
                fy=camera.fx,
                cx=camera.height - camera.cy,
                cy=camera.cx,
                width=camera.height,
                height=camera.width,
            )
        return camera

    def load(self) -> ViewImage:
        """The image as stored: read or rendered now, or from the cache. ValueError if its size is not
        the camera's."""
        image = self.source if isinstance(self.source, ViewImage) else self.source.load()
        size = (self.camera.height, self.camera.width)
        if image.color.shape[:2] != size:
            raise ValueError(f"view {self.name!r}: its image has shape {image.color.shape[:2]}, not {size}")
        return image

    @property
    def image(self) -> np.ndarray:
        """(h, w, 3) float32 RGB in [0, 1], over ``background`` where the image has alpha."""
        return self.load().over(self.background)

    @property
    def alpha(self) -> np.ndarray | None:
        """(h, w) float32 opacity in [0, 1]; None if everything is opaque."""
        alpha = self.load().alpha
        return None if alpha is None else _unit(alpha)

    @property
    def mask(self) -> np.ndarray | None:
        """(h, w) bool, True where pixels count; None: all of them.

        Pixels of photographs do not count outside the masks, and where undistortion leaves borders black.
        """
        return self.load().mask


@dataclass(frozen=True, eq=False)
class Dataset:
    """Training views and held-out views, each sorted by name unless rendered from splats. Cameras are
    relative to ``origin``."""

    train: tuple[View, ...]
    test: tuple[View, ...] = ()
    name: str = ""
    look: Look = "area"
    """Look of the images (``rendering.looks``); photographs are means over each pixel's area."""
    origin: np.ndarray = field(default_factory=zero_origin)
    """(3,) float64 point of the world that cameras, and with them all that is made of the data set, are
    relative to: world = origin + local."""
    around: bool = False
    """Whether cameras were placed around an object, which may be looked at from elsewhere, too."""
    placed: str = ""
    """What was found out about a scene in which cameras were looked for, in words."""

    def __post_init__(self) -> None:
        need_all(View, train=self.train, test=self.test)
        object.__setattr__(self, "train", tuple(self.train))
        object.__setattr__(self, "test", tuple(self.test))
        object.__setattr__(self, "origin", checked_array("origin", self.origin, np.float64, (3,)))

    def __repr__(self) -> str:
        sizes = sorted({(view.camera.width, view.camera.height) for view in self.views})
        shapes = [f"{width} x {height}" for width, height in sizes[:3]] + ["..."] * (len(sizes) > 3)
        name = [repr(self.name)] if self.name else []
        counts = [f"{len(self.train)} views to train with", f"{len(self.test)} held out"]
        at = [f"origin {in_words(self.origin)}"] if self.origin.any() else []
        return f"Dataset({', '.join([*name, *counts, *shapes, *at])})"

    @property
    def views(self) -> tuple[View, ...]:
        return self.train + self.test

    @property
    def opening(self) -> Camera | None:
        """The first held-out view, or the first of all, upright, from which the scene is shown; None: from
        anywhere. Of a place, and of what was photographed, other views show what no image shows."""
        return None if self.around or not self.views else (self.test or self.train)[0].upright

    @property
    def memory(self) -> int:
        """Bytes of all images together once loaded, of which at most ``cache_bytes`` are kept: 3 a pixel for
        photographs, 8 with alpha, 1 more with masks or undistorted."""
        return sum(view.source.nbytes for view in self.views)

    def relative_to(self, origin: Sequence[float] | np.ndarray) -> Dataset:
        """The same views in the world, with cameras relative to ``origin`` (3,), such as that of the mesh or
        the splats that they show."""
        point = checked_array("origin", origin, np.float64, (3,))
        shift = point - self.origin
        if not shift.any():
            return self

        def moved(views: tuple[View, ...]) -> tuple[View, ...]:
            return tuple(replace(view, camera=view.camera.relative_to(shift)) for view in views)

        return replace(self, train=moved(self.train), test=moved(self.test), origin=point)

    def with_near_planes(self, points: np.ndarray) -> Dataset:
        """The same views with the near planes of a scene of ``points`` (n, 3), its vertices or centres, where
        their cameras name none: ``Camera.with_near_plane``."""
        train, test = (with_near_planes(views, points) for views in (self.train, self.test))
        return replace(self, train=train, test=test)

    def scorable(self) -> Dataset:
        """The same without held-out views in which no pixel counts, which have no score. Reads those that
        have masks. Warns with a DataWarning that names them."""
        kept = tuple(view for view in self.test if _counts(view))
        if len(kept) == len(self.test):
            return self
        names = [view.name for view in self.test if view not in kept]
        shown = ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")
        warnings.warn(
            f"{len(names)} of {len(self.test)} held-out photographs are not scored, as no pixel of them"
            f" counts: {shown}. Are their masks right?",
            DataWarning,
            stacklevel=3,
        )
        return replace(self, test=kept)

    def over(self, background: Sequence[float]) -> Dataset:
        """The same views with another ``background`` for images with alpha."""
        red, green, blue = map(float, background)

        def changed(views: tuple[View, ...]) -> tuple[View, ...]:
            return tuple(replace(view, background=(red, green, blue)) for view in views)

        return replace(self, train=changed(self.train), test=changed(self.test))


def _counts(view: View) -> bool:
    """Whether any pixel does."""
    if getattr(view.source, "mask", view) is None:  # an image, or a photograph that has not been read
        return True
    mask = view.mask
    return mask is None or bool(mask.any())


def check_counting(views: Sequence[View]) -> None:
    """ValueError if no pixel of any of ``views`` counts. Reads those with masks, up to one that has some."""
    if views and not any(map(_counts, views)):
        raise ValueError(
            f"all pixels of the {len(views)} training views are masked out: their masks are black throughout,"
            " and only white pixels (128 of 255 or more) count"
        )


def with_near_planes(views: Sequence[View], points: np.ndarray) -> tuple[View, ...]:
    """``views`` whose cameras have the near plane of a scene of ``points`` (n, 3), where they name none."""
    return tuple(replace(view, camera=view.camera.with_near_plane(points)) for view in views)


class ImageCache:
    """Keeps images up to a number of bytes, first come, first served.

    Nothing is ever evicted: training cycles through all views, and evicting the oldest image would then
    always evict the one that is needed next.
    """

    def __init__(self, limit: int) -> None:
        if limit < 0:
            raise ValueError(f"cache_bytes must be >= 0, got {limit}")
        self._left = limit
        self._kept: dict[object, ViewImage] = {}
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[ImageCache], tuple[int]]:
        # A copy, or that of another process, begins empty: images may be gigabytes, and are read again.
        with self._lock:
            return ImageCache, (self._left + sum(image.nbytes for image in self._kept.values()),)

    def find(self, key: object) -> ViewImage | None:
        return self._kept.get(key)

    def keep(self, key: object, image: ViewImage) -> None:
        with self._lock:
            if key not in self._kept and image.nbytes <= self._left:
                self._left -= image.nbytes
                self._kept[key] = image


def _check_premultiplied(color: np.ndarray, alpha: np.ndarray) -> None:
    """Raises ValueError for ``color`` that is not times ``alpha``: where that is near 0, many pixels are far
    brighter than a premultiplied colour can be. A sample of large images is looked at."""
    white = 255 if color.dtype == np.uint8 else 1
    step = max(1, alpha.size // _PIXELS)
    shares = alpha.reshape(-1)[::step]
    faint = shares < white / MAX_COLOR
    colors, shares = color.reshape(-1, 3)[::step][faint], shares[faint]
    most = MAX_COLOR * np.maximum(shares, 0).astype(np.float32) + _ROUNDING * white  # below 0: resampling
    bright = (colors > most[:, None]).any(axis=1)
    if bright.sum() > _MOST_BRIGHT * len(faint):
        raise ValueError(
            "color must be premultiplied by alpha, but is bright where alpha is near 0: give"
            " color * alpha[..., None], where bytes are divided by 255 first"
        )


def _unit(values: np.ndarray) -> np.ndarray:
    """float32 in units of 1, a new array."""
    result = values.astype(np.float32)
    if values.dtype == np.uint8:
        result /= 255
    return result
