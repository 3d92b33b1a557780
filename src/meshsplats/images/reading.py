"""Reading image files within limits: their size from the header, then their pixels."""

from __future__ import annotations

import io
import math
import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.choices import MAX_SIDE
from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError

MAX_PIXELS = 1 << 26
"""Images of more pixels than this (67 million) are refused: a small file can claim any size."""
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")
"""Formats that Pillow may read here. Others start programs, or hold no photographs."""
_WIDTH, _HEIGHT, _ORIENTATION = 0x100, 0x101, 0x112
_TURNS = {3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}
"""``Header.turn`` by EXIF's orientation; 0 for others."""
_UNTURNED = {
    **{2: "FLIP_LEFT_RIGHT", 3: "ROTATE_180", 4: "FLIP_TOP_BOTTOM", 5: "TRANSPOSE"},
    **{6: "ROTATE_90", 7: "TRANSVERSE", 8: "ROTATE_270"},
}
"""Pillow's names of what leads from an upright image to one of EXIF's orientations."""
MAX_PROFILE = 1 << 22
"""Bytes of a colour profile; those of printers have up to three million."""
ROUNDING = 3
"""Levels of 255 by which a profile that is sRGB by another name differs from it, at most."""
_HEIF = re.compile(rb"....ftyp(heic|heix|heim|heis|hevc|hevx|mif1|msf1)", re.DOTALL)
"""How HEIF files begin, as iPhones take photographs."""
_AVIF = re.compile(rb"....ftypavi[fs]", re.DOTALL)
"""How AVIF files begin."""
_MAKE, _MODEL, _EXIF_IFD = 0x010F, 0x0110, 0x8769
"""Tags of EXIF data: maker and name of the camera, and the part about the photograph."""
_LENS, _FOCAL, _FOCAL_OF_FILM, _ZOOM = 0xA434, 0x920A, 0xA405, 0xA404
"""Tags of that part: name of the lens, focal length in mm, the same of 35 mm film, digital zoom."""


@dataclass(frozen=True)
class Header:
    """Size and kind of an image file."""

    width: int
    height: int
    has_alpha: bool
    orientation: int = 1
    """EXIF's: how the image, as it is stored, is turned and mirrored, from 1, not at all, to 8."""

    @property
    def turn(self) -> int:
        """Quarter turns clockwise after which the image, as it is stored, is upright, without mirroring."""
        return _TURNS.get(self.orientation, 0)


@dataclass(frozen=True)
class Shot:
    """How a photograph was taken, as far as its file tells."""

    size: tuple[int, int]
    """Width and height in pixels."""
    format: str
    """As Pillow names it."""
    lens: tuple[str, ...] = ()
    """What tells lenses apart, as far as it is known: maker and name of the camera, name of the lens, focal
    length, the same of 35 mm film, digital zoom."""
    is_panorama: bool = False
    """Whether it shows all sides, and says so."""


def read_header(path: Path) -> Header:
    """Size and kind of an image, without its pixels. FileFormatError if it is none, or too large."""
    with _opened(path) as image, _decoding(path):
        return Header(*_stored_size(image), _has_alpha(image), _orientation(image))


def load_image(
    path: str | os.PathLike[str], data: bytes | None = None, *, to_srgb: bool = False
) -> np.ndarray:
    """uint8 (h, w, 3) RGB, or (h, w, 4) straight RGBA if the image has alpha.

    Args:
        path: the image file.
        data: an image inside another file, which ``path`` then names in messages.
        to_srgb: whether an embedded colour profile counts. One that is broken does not, with a DataWarning.

    Raises:
        FileFormatError: the image is broken, too large, or of no known format.
    """
    with _opened(path, data) as opened, _decoding(path):
        image = _as_stored(opened)
        if image.mode.startswith("I;16") or image.mode == "I":
            grey = np.asarray(image, np.int64)
            if grey.min(initial=0) < 0 or grey.max(initial=0) > 65535:
                raise FileFormatError(f"{path}: an image cannot hold integers beyond 16 bits")
            return np.repeat(np.rint(grey / 257).astype(np.uint8)[..., None], 3, axis=2)
        if image.mode == "F":
            raise FileFormatError(f"{path}: holds floating-point values; convert it to 8 bits")
        plain = image.convert("RGBA" if _has_alpha(image) else "RGB")
        return np.asarray(_in_srgb(image, plain, path) if to_srgb else plain)


def _in_srgb(image: Any, plain: Any, path: str | os.PathLike[str]) -> Any:
    """``plain``, which ``image`` is as RGB or RGBA, with the colours that the profile of ``image`` means."""
    profile = image.info.get("icc_profile")
    if not profile:
        return plain
    try:
        mode, transform = _srgb_transform(profile)
        if transform is None:
            return plain
        if (mode == "CMYK") != (image.mode == "CMYK") or (mode == "L" and image.mode not in ("L", "LA")):
            raise ValueError(f"it is not one for {image.mode} images")
        colors = transform.apply(image if image.mode == mode else plain.convert(mode))
    except (OSError, ValueError, TypeError, ImportError, MemoryError) as error:
        reason = str(error)[:120]
        warnings.warn(f"{path}: its colour profile is ignored: {reason}", DataWarning, stacklevel=3)
        return plain
    if plain.mode == "RGBA":
        colors.putalpha(plain.getchannel("A"))
    return colors


def converted_profile(path: Path) -> str:
    """The name of the colour profile that ``to_srgb`` of ``load_image`` converts from; empty if it changes
    nothing."""
    with _opened(path) as image:
        profile = image.info.get("icc_profile")
    if not profile:
        return ""
    try:
        if _srgb_transform(profile)[1] is None:
            return ""
    except (OSError, ValueError, TypeError, ImportError, MemoryError):
        return ""  # it is ignored, with a warning
    from PIL import ImageCms

    try:
        name = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile)))
    except ImageCms.PyCMSError:
        name = ""
    return name.strip()[:60] or "another colour profile"


@lru_cache(maxsize=16)
def _srgb_transform(profile: bytes) -> tuple[str, Any]:
    """The mode of images that an ICC ``profile`` is for, and Pillow's transform of them to sRGB; None if it
    changes nothing. ValueError if the profile is broken, or of no such images."""
    from PIL import Image, ImageCms

    if len(profile) > MAX_PROFILE:
        raise ValueError(f"{len(profile):,} bytes are too many")
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        mode = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}[source.profile.xcolor_space.strip()]
        transform = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, "RGB")
    except (ImageCms.PyCMSError, KeyError) as error:
        raise ValueError(f"not a profile of colours: {error}") from None
    if mode == "RGB":
        steps = np.arange(0, 256, 51, dtype=np.uint8)
        colors = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(1, -1, 3)
        changed = np.asarray(transform.apply(Image.fromarray(colors)))
        if np.abs(changed.astype(int) - colors).max() <= ROUNDING:
            return mode, None
    return mode, transform


def read_shot(path: Path) -> Shot:
    """How a photograph was taken. FileFormatError if it is broken: it is decoded, a JPEG coarsely."""
    with _opened(path) as image, _decoding(path):
        size, kind = _stored_size(image), str(image.format)
        is_panorama = size[0] == 2 * size[1] and _is_equirectangular(image)
        # EXIF data of TIFF are in the file, which older versions of Pillow close as they load it; those of
        # PNG may be behind the pixels.
        lens = _lens(image) if kind == "TIFF" else None
        image.draft("RGB", (1, 1))
        image.load()
        return Shot(size, kind, _lens(image) if lens is None else lens, is_panorama)


def _lens(image: Any) -> tuple[str, ...]:
    """``Shot.lens``."""
    try:
        exif = image.getexif()
        more = exif.get_ifd(_EXIF_IFD)
        names = (exif.get(_MAKE), exif.get(_MODEL), more.get(_LENS))
        numbers = (more.get(_FOCAL), more.get(_FOCAL_OF_FILM), more.get(_ZOOM))
        lens = (*(str(name or "") for name in names), *map(_positive, numbers))
        return lens if any(lens) else ()
    except Exception:  # any program may write there what it likes
        return ()


def _positive(value: Any) -> str:
    """A number of EXIF data; empty for one that says nothing, as a zoom of 1. To three digits: some cameras
    write the last ones anew for each photograph, as they focus."""
    number = float(value or 0)
    text = f"{number:.3g}" if 0 < number < math.inf else ""
    return "" if text == "1" else text


def read_exif(path: Path) -> bytes:
    """The EXIF data of an image; empty if it has none."""
    with _opened(path) as image, _decoding(path):
        return bytes(image.getexif().tobytes())


@contextmanager
def _decoding(path: str | os.PathLike[str]) -> Iterator[None]:
    """Within the block, whatever goes wrong is a FileFormatError: decoders raise errors of any type."""
    try:
        yield
    except (FileFormatError, DataWarning):
        raise
    except Exception as error:
        raise FileFormatError(f"{path}: a broken image: {str(error)[:120]}") from None


def _formats(path: str | os.PathLike[str], data: bytes | None) -> tuple[str, ...]:
    """The formats to try. Raises MissingDependencyError for HEIF without its library, and for AVIF with a
    Pillow that does not read it."""
    if data is None:
        with open(path, "rb") as file:
            head = file.read(12)
    else:
        head = data[:12]
    if _AVIF.match(head):
        if not _reads_avif():
            raise MissingDependencyError(
                f"{path}: an AVIF image, which needs Pillow 11.3 or later, built with AVIF: pip install -U"
                " pillow; or convert it to JPEG"
            )
        return (*FORMATS, "AVIF")
    if not _HEIF.match(head):
        return FORMATS
    try:
        from pillow_heif import register_heif_opener
    except ModuleNotFoundError:
        raise MissingDependencyError(
            f"{path}: a HEIF image (.heic), which needs the library pillow-heif: pip install"
            ' "meshsplats[heic]"; or convert it to JPEG'
        ) from None
    register_heif_opener()
    return (*FORMATS, "HEIF")


@lru_cache(maxsize=1)
def _reads_avif() -> bool:
    from PIL import features

    return "avif" in features.get_supported_modules()  # ``check`` warns of what older versions do not know


def _opened(path: str | os.PathLike[str], data: bytes | None = None) -> Any:
    try:
        from PIL import Image
    except ModuleNotFoundError:
        raise MissingDependencyError("reading images needs Pillow: pip install pillow") from None
    try:
        formats = _formats(path, data)
        image = Image.open(path if data is None else io.BytesIO(data), formats=formats)
    except (FileNotFoundError, PermissionError, MissingDependencyError):
        raise
    except Exception as error:  # of any type, as in ``_decoding``
        raise FileFormatError(
            f"{path}: not an image of a known format ({', '.join(FORMATS)}): {str(error)[:120]}"
        ) from None
    width, height = image.size
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE or min(width, height) < 1:
        image.close()
        raise FileFormatError(
            f"{path}: {width} x {height} pixels; up to {MAX_PIXELS:,} pixels and {MAX_SIDE} a side are read."
            " Make it smaller"
        )
    return image


def _orientation(image: Any) -> int:
    """``Header.orientation``."""
    # pillow-heif turns the pixels itself. Pillow looks for EXIF behind the pixels if none is before.
    if image.format == "HEIF" or (image.format != "TIFF" and "exif" not in image.info):
        return 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # EXIF that is broken says nothing
        try:
            found = image.getexif().get(_ORIENTATION)
            return int(found) if found in _UNTURNED else 1
        except Exception:
            return 1


def _stored_size(image: Any) -> tuple[int, int]:
    """Width and height in pixels as they are stored; Pillow may give those of a TIFF upright."""
    if image.format == "TIFF":
        return int(image.tag_v2[_WIDTH]), int(image.tag_v2[_HEIGHT])
    return image.width, image.height


def _as_stored(image: Any) -> Any:
    """``image`` with its pixels as they are stored: Pillow turns those of a TIFF upright."""
    method = _UNTURNED.get(_orientation(image)) if image.format == "TIFF" else None
    if method is None:
        return image
    from PIL import Image

    return image.transpose(Image.Transpose[method])


def _is_equirectangular(image: Any) -> bool:
    """Whether the XMP data of a photograph says that it shows all sides, one angle a pixel."""
    parts = [content for name, content in getattr(image, "applist", ()) if name == "APP1"]  # of JPEG
    texts = [*parts, image.info.get("xmp")]
    return any(isinstance(t, bytes) and b"GPano" in t and b"equirectangular" in t for t in texts)


def _has_alpha(image: Any) -> bool:
    return image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info
