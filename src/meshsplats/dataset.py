"""Dataset: cameras with the pictures they took, for training and for testing; read from folders, or drawn
from splats."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from meshsplats.camera import Camera
from meshsplats.gaussians import GaussianCloud

if TYPE_CHECKING:
    from meshsplats.rendering.looks import Look

CACHE_BYTES = 2 << 30
"""Pictures of a data set kept in memory after their first use, in bytes, where nothing else is asked for."""
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Picture:
    """What a camera saw. Values are display-referred (sRGB-encoded), rows run from top to bottom."""

    color: np.ndarray
    """(h, w, 3) RGB as it is on black, so times alpha where there is one: uint8 (255 is 1), or float16 or
    float32 in units of 1."""
    alpha: np.ndarray | None = None
    """(h, w) opacity, of the same type; None: opaque, as photographs are."""
    mask: np.ndarray | None = None
    """(h, w) bool, True where the picture counts; None: everywhere."""

    def __post_init__(self) -> None:
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

    def over(self, background: Sequence[float] | np.ndarray = WHITE) -> np.ndarray:
        """(h, w, 3) float32 ``color + (1 - alpha) * background``; ``background``: RGB, (3,) or (h, w, 3)."""
        color = _unit(self.color)
        if self.alpha is None:
            return color
        return color + (1 - _unit(self.alpha))[..., None] * np.asarray(background, np.float32)

    def __repr__(self) -> str:
        height, width = self.color.shape[:2]
        more = [name for name in ("alpha", "mask") if getattr(self, name) is not None]
        return f"Picture({', '.join([f'{width} x {height} {self.color.dtype}', *more])})"

    @property
    def nbytes(self) -> int:
        return sum(a.nbytes for a in (self.color, self.alpha, self.mask) if a is not None)


class PictureSource(Protocol):
    """Something a picture can be had from when it is asked for."""

    def load(self) -> Picture: ...

    @property
    def nbytes(self) -> int:
        """Memory the picture takes once loaded, in bytes, known before it is."""
        ...


@dataclass(frozen=True, eq=False)
class View:
    """A camera and what it saw. Pictures are read or drawn when they are first asked for."""

    camera: Camera
    """Pinhole of the picture's size; photographs of other lenses are undistorted to it."""
    source: Picture | PictureSource
    background: tuple[float, float, float] = WHITE
    """RGB in [0, 1] behind pictures with alpha in ``image``."""

    def __repr__(self) -> str:
        return f"View({self.name!r}, {self.camera.width} x {self.camera.height})"

    @property
    def name(self) -> str:
        """The picture's name, relative to the data set."""
        return self.camera.name

    @property
    def picture(self) -> Picture:
        """The picture as stored. ValueError if it has not the camera's size."""
        picture = self.source if isinstance(self.source, Picture) else self.source.load()
        size = (self.camera.height, self.camera.width)
        if picture.color.shape[:2] != size:
            raise ValueError(
                f"view {self.name!r}: its picture has shape {picture.color.shape[:2]}, not {size}"
            )
        return picture

    @property
    def image(self) -> np.ndarray:
        """(h, w, 3) float32 RGB in [0, 1], over ``background`` where the picture has alpha."""
        return self.picture.over(self.background)

    @property
    def alpha(self) -> np.ndarray | None:
        """(h, w) float32 opacity in [0, 1]; None if everything is opaque."""
        alpha = self.picture.alpha
        return None if alpha is None else _unit(alpha)

    @property
    def mask(self) -> np.ndarray | None:
        """(h, w) bool, True where the picture counts; None: everywhere. Photographs do not count outside
        their masks, and beyond the borders that undistortion leaves black."""
        return self.picture.mask


@dataclass(frozen=True, eq=False)
class Dataset:
    """Views to train with and views held out for testing, each sorted by name unless drawn from splats."""

    train: tuple[View, ...]
    test: tuple[View, ...] = ()
    name: str = ""
    look: Look = "area"
    """What the images are the truth of (``rendering.looks``); photographs are means over each pixel's
    area."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "train", tuple(self.train))
        object.__setattr__(self, "test", tuple(self.test))

    def __repr__(self) -> str:
        sizes = sorted({(view.camera.width, view.camera.height) for view in self.views})
        told = [f"{width} x {height}" for width, height in sizes[:3]] + ["..."] * (len(sizes) > 3)
        name = [repr(self.name)] if self.name else []
        counts = [f"{len(self.train)} views to train with", f"{len(self.test)} held out"]
        return f"Dataset({', '.join([*name, *counts, *told])})"

    @property
    def views(self) -> tuple[View, ...]:
        return self.train + self.test

    @property
    def memory(self) -> int:
        """Bytes that all pictures take together once loaded (of which only so many are kept as
        ``cache_bytes`` says): 3 a pixel for photographs, 8 with alpha, 1 more with masks or undistorted."""
        return sum(view.source.nbytes for view in self.views)

    def over(self, background: Sequence[float]) -> Dataset:
        """The same views with another ``background`` behind pictures with alpha."""
        red, green, blue = map(float, background)

        def changed(views: tuple[View, ...]) -> tuple[View, ...]:
            return tuple(replace(view, background=(red, green, blue)) for view in views)

        return replace(self, train=changed(self.train), test=changed(self.test))


def load_dataset(
    path: str | os.PathLike[str],
    *,
    downscale: int = 1,
    test_every: int = 8,
    background: Sequence[float] = WHITE,
    cache_bytes: int = CACHE_BYTES,
) -> Dataset:
    """The photographs and cameras in a folder.

    Layouts, tried in this order (``docs/datasets.md`` shows them):

    - NeRF-synthetic: ``transforms_train.json``, with ``transforms_test.json`` (else ``transforms_val.json``)
      as the test views;
    - COLMAP, as INRIA's 3DGS and Mip-NeRF 360 use it: ``images/`` and ``sparse/0/`` or ``sparse/``, binary or
      text, any camera model;
    - nerfstudio: ``transforms.json``, also named itself as ``path``;
    - COLMAP with ``colmap/sparse/0/`` or ``colmap/sparse/``, with the only model in ``sparse/``, or with the
      model beside ``images/``.

    ``masks/``, or the masks a file names, say which pixels count. Photographs of lenses that are no pinhole
    are undistorted when they are read; what the lens did not see is black and masked. Only the headers of
    pictures are read here: cameras are scaled to the size the pictures really have.

    Parameters
    ----------
    downscale: whole factor of the pictures' sides, 1 to 64. ``images_2/``, ``images_4/`` and so on are used
        where they exist; else each pixel becomes the mean of those it covers.
    test_every: views 0, n, 2n ... by name are held out, unless the data set has a split of its own; 0: none.
    background: RGB in [0, 1] of ``View.image`` where pictures have alpha. ``Picture.over`` takes another.
    cache_bytes: pictures are kept up to this many bytes after their first use; the others are read anew each
        time.

    Raises
    ------
    FileFormatError: a folder of no known layout, a broken file in it, a picture whose shape does not fit its
        camera, a path that leaves the folder; no picture is there at all.
    FileNotFoundError: nothing at ``path``.
    ValueError: an option out of its range.

    Warns with a DataWarning if some pictures or masks are missing: their views are left out, or count wholly.
    """
    from meshsplats.datasets.folder import read_folder

    for option, value, least, most in (("downscale", downscale, 1, 64), ("test_every", test_every, 0, 10**9)):
        if int(value) != value or not least <= value <= most:
            raise ValueError(f"{option} must be a whole number from {least} to {most}, got {value}")
    color = np.asarray(background, np.float64)
    if color.shape != (3,) or not ((color >= 0) & (color <= 1)).all():
        raise ValueError(f"background must be three numbers in [0, 1], got {background!r}")
    if test_every == 1:
        raise ValueError("test_every must be 0 (no test views) or at least 2: 1 leaves nothing to train with")
    store = PictureStore(cache_bytes)
    train, test = read_folder(Path(path), int(downscale), int(test_every), store)
    return Dataset(tuple(train), tuple(test), Path(os.path.abspath(path)).name).over(color.tolist())


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
    """Views of the splats themselves: targets where there are no photographs.

    ``look``, ``sh_degree``, ``samples`` and ``threads`` are those of ``rendering.looks.draw_splats``. Images
    have alpha, so any background can be put behind them; ``background`` is that of ``View.image``. They are
    drawn when first asked for and kept in float16, 8 bytes a pixel, as in ``load_dataset``.
    """
    from meshsplats.rendering.looks import check_look

    check_look(look)
    red, green, blue = map(float, background)
    store = PictureStore(cache_bytes)
    return tuple(
        View(camera, DrawnSplats(cloud, camera, look, sh_degree, samples, threads, store), (red, green, blue))
        for camera in cameras
    )


class PictureStore:
    """Pictures that are kept, up to a number of bytes; those that come later are not.

    Nothing is put out again: training goes through all views over and over, and a store that puts out the
    oldest would then never have the one asked for.
    """

    def __init__(self, limit: int) -> None:
        if limit < 0:
            raise ValueError(f"cache_bytes must be >= 0, got {limit}")
        self._left = limit
        self._kept: dict[object, Picture] = {}
        self._lock = threading.Lock()

    def find(self, key: object) -> Picture | None:
        return self._kept.get(key)

    def keep(self, key: object, picture: Picture) -> None:
        with self._lock:
            if key not in self._kept and picture.nbytes <= self._left:
                self._left -= picture.nbytes
                self._kept[key] = picture


@dataclass(frozen=True, eq=False)
class DrawnSplats:
    """A picture of splats, drawn when it is asked for."""

    cloud: GaussianCloud
    camera: Camera
    look: Look
    sh_degree: int | None
    samples: int | None
    threads: int | None
    store: PictureStore = field(repr=False)

    def load(self) -> Picture:
        return self._drawn(self.samples)

    def points(self) -> Picture:
        """The values at the pixels' centres alone, of which the mean over their areas is made (look
        'area')."""
        return self._drawn(1)

    def _drawn(self, samples: int | None) -> Picture:
        from meshsplats.rendering.looks import draw_splats

        picture = self.store.find((self, samples))
        if picture is None:
            drawn = draw_splats(
                self.cloud,
                self.camera,
                self.look,
                background=(0, 0, 0),
                samples=samples,
                sh_degree=self.sh_degree,
                threads=self.threads,
            )
            # Beyond float16 lies only what no display can show.
            color = np.clip(drawn.color, 0, 60_000).astype(np.float16)
            picture = Picture(color, drawn.alpha.astype(np.float16))
            self.store.keep((self, samples), picture)
        return picture

    @property
    def nbytes(self) -> int:
        kinds = 2 if self.look == "area" else 1  # means and points
        return 8 * kinds * self.camera.width * self.camera.height


def _unit(values: np.ndarray) -> np.ndarray:
    """float32 in units of 1, a new array."""
    result = values.astype(np.float32)
    if values.dtype == np.uint8:
        result /= 255
    return result
