"""Photographs in a data set's folder: found without leaving it, measured by their headers, read when
needed."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from meshsplats.camera import Camera
from meshsplats.datasets.lens import WHOLE, Lens, Pinhole, pinholes, undistort
from meshsplats.datasets.views import ImageCache, ViewImage
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.images.reading import Header, load_image, read_header

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".PNG", ".JPG", ".JPEG")
"""Tried, in this order, for names without a suffix, and for smaller copies stored in another format."""
MAX_NAME = 1000
MAX_STRETCH = 0.02
"""Largest difference between the scales of width and height at which an image still fits its camera."""


@dataclass(frozen=True)
class Frame:
    """A photograph as a data set's own file describes it."""

    name: str
    """Name of the view."""
    file: str
    """Path of the image in the folder, as written there."""
    lens: Lens | None
    """None if the file does not give a size and the image is missing."""
    world_to_camera: np.ndarray
    mask: str | None = None
    """Path of its mask in the folder; None: looked for in ``masks/``."""


def inside(folder: Path, name: str, where: str) -> Path:
    """The path of ``name`` in ``folder``. FileFormatError if it is absolute or leads out of the folder, by
    ``..`` or by a symbolic link; ``where`` begins the message."""
    clean = name.replace("\\", "/")
    parts = PurePosixPath(clean).parts
    if not clean or len(clean) > MAX_NAME or "\0" in clean:
        raise FileFormatError(f"{where}: a file name must have 1 to {MAX_NAME} characters, got {name[:60]!r}")
    if clean.startswith("/") or PureWindowsPath(clean).drive or ".." in parts:
        raise FileFormatError(
            f"{where}: names the file {name[:200]!r}; only files inside the data set's folder are read, named"
            " relative to it"
        )
    path = folder.joinpath(*parts)
    real, root = os.path.realpath(path), os.path.realpath(folder)
    if os.path.commonpath([real, root]) != root:
        raise FileFormatError(
            f"{where}: {name[:200]!r} is a link that leads out of the data set's folder; copy what is there"
        )
    return path


def find(folder: Path, name: str, where: str, *, other_suffix: bool = False) -> Path | None:
    """The file ``name`` in ``folder``, or None. A name without one of the known suffixes may lack it;
    ``other_suffix`` admits the same image in another format."""
    path = inside(folder, name, where)
    if path.is_file():
        return path
    known = path.suffix in SUFFIXES
    if known and not other_suffix:
        return None
    for suffix in SUFFIXES:
        candidate = path.with_suffix(suffix) if known else path.with_name(path.name + suffix)
        if candidate.is_file():
            # The link could be on this one.
            return inside(folder, str(candidate.relative_to(folder)), where)
    return None


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

    def load(self) -> ViewImage:
        image = self.store.find(self)
        if image is None:
            image = self._read()
            self.store.keep(self, image)
        return image

    @property
    def nbytes(self) -> int:
        masked = self.mask is not None or not self.lens.is_pinhole
        return ((8 if self.has_alpha else 3) + masked) * self.pinhole.width * self.pinhole.height

    def _read(self) -> ViewImage:
        pixels = load_image(self.path)
        color, alpha = pixels[..., :3], pixels[..., 3] if pixels.shape[2] == 4 else None
        size = (self.lens.width, self.lens.height)
        if alpha is None:
            color = _resized(color, size)
        else:
            # Colours of clear pixels mean nothing: mixing must see each as much as it is opaque.
            share = alpha.astype(np.float32) / 255
            mixed = np.empty((size[1], size[0], 4), np.float16)
            for i in range(3):
                mixed[..., i] = _resized(color[..., i].astype(np.float32) / 255 * share, size)
            mixed[..., 3] = _resized(share, size)
            color = mixed
        mask = None if self.mask is None else self._read_mask(size)
        if not self.lens.is_pinhole:
            color, seen = undistort(color, self.lens, self.pinhole)
            if mask is not None:
                counts = undistort(mask.astype(np.float32)[..., None], self.lens, self.pinhole)[0]
                mask = counts[..., 0] >= WHOLE  # 0 where nothing was seen
            else:
                mask = seen
        if alpha is None:
            return ViewImage(color, None, mask)
        return ViewImage(np.ascontiguousarray(color[..., :3]), np.ascontiguousarray(color[..., 3]), mask)

    def _read_mask(self, size: tuple[int, int]) -> np.ndarray:
        """(h, w) bool. A pixel counts if the mask is light (128 of 255 or more), and opaque where it has
        alpha, all over it."""
        assert self.mask is not None
        pixels = load_image(self.mask)
        light = pixels[..., :3].max(axis=2)
        if pixels.shape[2] == 4:
            light = np.minimum(light, pixels[..., 3])
        return _resized((light >= 128).astype(np.float32), size) >= WHOLE


def _resized(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """``pixels`` (h, w) float32 or (h, w, 3) uint8 at ``size`` (width, height): each new pixel is the mean of
    those it covers."""
    from PIL import Image

    if (pixels.shape[1], pixels.shape[0]) == size:
        return pixels
    return np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))


Taken = list[tuple[Camera, PhotoFile]]
"""The views made from one photograph: one, or the six of a panorama."""


@dataclass
class Album:
    """Turns the frames of a data set into cameras with their photographs, and counts what is missing."""

    folder: Path
    """The data set's folder, which no path may leave."""
    downscale: int
    store: ImageCache
    missing: list[str] = field(default_factory=list)
    no_mask: list[str] = field(default_factory=list)

    def views(self, frames: Iterable[Frame], where: str) -> list[Taken]:
        """Cameras and photographs of each frame whose image is there, in order."""
        result: list[Taken] = []
        masks = (self.folder / "masks").is_dir()
        for frame in frames:
            label = f"{where}: image {frame.name[:60]!r}"
            full = find(self.folder, frame.file, label)
            small = self._smaller(frame.file, label)
            if frame.lens is None or (full is None and small is None):
                self.missing.append(frame.file)
                continue
            path = small or full
            assert path is not None
            header = read_header(path)
            _check_shape(frame.lens, header, path)
            width, height = header.width, header.height
            if small is None:
                width, height = (max(1, round(side / self.downscale)) for side in (width, height))
            mask = self._mask(frame, label, masks)
            if mask is not None:
                _check_shape(frame.lens, read_header(mask), mask)
            lens = frame.lens.scaled(width, height)
            taken = []
            for pinhole in pinholes(lens):
                source = PhotoFile(frame.name, path, lens, pinhole, mask, header.has_alpha, self.store)
                taken.append((_camera(frame, pinhole, label), source))
            result.append(taken)
        return result

    def _smaller(self, name: str, where: str) -> Path | None:
        """The copy in ``images_<downscale>/``, if there is such a folder."""
        parts = PurePosixPath(name.replace("\\", "/")).parts
        if self.downscale == 1 or len(parts) < 2:
            return None
        for i in reversed(range(len(parts) - 1)):
            beside = PurePosixPath(*parts[:i], f"{parts[i]}_{self.downscale}")
            if (self.folder / beside).is_dir():
                found = find(self.folder, str(beside.joinpath(*parts[i + 1 :])), where, other_suffix=True)
                if found is None:
                    raise FileFormatError(
                        f"{where}: {str(beside)!r} has no such image; complete that folder, or remove it:"
                        f" images are then made smaller here"
                    )
                return found
        return None

    def _mask(self, frame: Frame, where: str, folder: bool) -> Path | None:
        if frame.mask is not None:
            found = find(self.folder, frame.mask, where)
            if found is None:
                self.no_mask.append(frame.mask)
            return found
        if not folder:
            return None
        # images/a/b.jpg has masks/a/b.jpg.png (COLMAP's way), masks/a/b.png or masks/a/b.jpg.
        parts = PurePosixPath(frame.file.replace("\\", "/")).parts
        below = len(parts) > 1 and parts[0].startswith("images")
        inner = PurePosixPath("masks", *(parts[1:] if below else parts))
        for candidate in (f"{inner}.png", str(inner.with_suffix(".png")), str(inner)):
            found = find(self.folder, candidate, where)
            if found is not None:
                return found
        self.no_mask.append(str(inner))
        return None

    def report(self, where: str, found: int) -> None:
        """Warns of what is missing; FileFormatError if nothing is left."""
        if not found:
            what = "names no images" if not self.missing else f"none of its images is there{self._hint()}"
            raise FileFormatError(f"{where}: {what}")
        for names, text in (
            (self.missing, "images are missing; their views are left out"),
            (self.no_mask, "images have no mask and count wholly"),
        ):
            if names:
                shown = ", ".join(names[:3]) + (" ..." if len(names) > 3 else "")
                warnings.warn(f"{where}: {len(names)} {text} ({shown})", DataWarning, stacklevel=2)

    def _hint(self) -> str:
        name = self.missing[0]
        first = PurePosixPath(name.replace("\\", "/")).parts[0]
        smaller = sorted(p.name for p in self.folder.glob("images_*") if p.is_dir())
        hint = f" (the first: {str(self.folder / name)[:300]})"
        if not (self.folder / first).is_dir() and smaller:
            factors = ", ".join(s.removeprefix("images_") for s in smaller)
            hint += f"; there are {', '.join(smaller)}: give a downscale of {factors}"
        return hint


def _camera(frame: Frame, pinhole: Pinhole, where: str) -> Camera:
    matrix = np.eye(4)
    matrix[:3] = pinhole.rotation @ frame.world_to_camera[:3]
    lens = {key: getattr(pinhole, key) for key in ("fx", "fy", "cx", "cy", "width", "height")}
    try:
        return Camera(matrix, **lens, name=frame.name + pinhole.suffix)
    except ValueError as error:
        raise FileFormatError(f"{where}: {error}") from None


def _check_shape(lens: Lens, header: Header, path: Path) -> None:
    """FileFormatError unless the image is the camera's, but for its scale and a pixel of rounding."""
    width, height = header.width, header.height
    stretch = (width / lens.width) / (height / lens.height)
    if abs(stretch - 1) > MAX_STRETCH + 1 / min(width, height):
        turned = ""
        if abs(stretch / (width / height) ** 2 - 1) < 0.05:
            turned = ". It is turned: cameras belong to images as they are stored, before any rotation"
        raise FileFormatError(
            f"{path}: {width} x {height} pixels do not fit its camera, which took {lens.width} x"
            f" {lens.height}{turned}"
        )


def split(taken: Sequence[Taken], test_every: int) -> tuple[list[Taken], list[Taken]]:
    """Train and test: every n-th, which are sorted by name, is for testing, from the first on."""
    if not test_every:
        return list(taken), []
    test = [views for i, views in enumerate(taken) if i % test_every == 0]
    return [views for i, views in enumerate(taken) if i % test_every], test
