"""Reading image files within limits: their size from the header, then their pixels."""

from __future__ import annotations

import io
import os
import re
import struct
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.choices import MAX_SIDE
from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError

MAX_PIXELS = 1 << 26
"""Images of more pixels than this (67 million) are refused: a small file can claim any size."""
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")
"""Formats that Pillow may read here. Others start programs, or hold no photographs."""
_ORIENTATION = 0x112
_TURNS = {3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}
"""``Header.turn`` by EXIF's orientation; 0 for others."""
MAX_PROFILE = 1 << 22
"""Bytes of a colour profile; those of printers have up to three million."""
ROUNDING = 3
"""Levels of 255 by which a profile that is sRGB by another name differs from it, at most."""
_HEIF = re.compile(rb"....ftyp(heic|heix|heim|heis|hevc|hevx|mif1|msf1)", re.DOTALL)
"""How HEIF files begin, as iPhones take photographs."""
_MODEL, _EXIF_IFD, _FOCAL, _FOCAL_OF_FILM = 0x0110, 0x8769, 0x920A, 0xA405
"""Tags of EXIF data: camera, the part about the photograph, focal length in mm, and in mm of 35 mm film."""


@dataclass(frozen=True)
class Header:
    """Size and kind of an image file."""

    width: int
    height: int
    has_alpha: bool
    turn: int = 0
    """Quarter turns clockwise after which the image, as it is stored, is upright: EXIF's orientation, without
    its mirroring."""


@dataclass(frozen=True)
class Shot:
    """How a photograph was taken, as far as its file tells."""

    size: tuple[int, int]
    """Width and height in pixels."""
    format: str
    """As Pillow names it."""
    camera: str = ""
    """Model; empty if it is not known."""
    focal: float = 0.0
    """Focal length in mm, of 35 mm film where that is known; 0 if none is."""


def read_header(path: Path) -> Header:
    """Size and kind of an image, without its pixels. FileFormatError if it is none, or too large."""
    with _opened(path) as image:
        return Header(image.width, image.height, _has_alpha(image), _turn(image))


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
    with _opened(path, data) as image:
        try:
            if image.mode.startswith("I;16") or image.mode == "I":
                grey = np.asarray(image, np.int64)
                if grey.min(initial=0) < 0 or grey.max(initial=0) > 65535:
                    raise FileFormatError(f"{path}: an image cannot hold integers beyond 16 bits")
                return np.repeat(np.rint(grey / 257).astype(np.uint8)[..., None], 3, axis=2)
            if image.mode == "F":
                raise FileFormatError(f"{path}: holds floating-point values; convert it to 8 bits")
            plain = image.convert("RGBA" if _has_alpha(image) else "RGB")
            return np.asarray(_in_srgb(image, plain, path) if to_srgb else plain)
        except FileFormatError:
            raise
        except (OSError, ValueError, SyntaxError, EOFError, MemoryError) as error:
            raise _broken(path, error) from None


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
    with _opened(path) as image:
        size, kind = image.size, str(image.format)
        try:
            image.draft("RGB", (1, 1))
            image.load()
        except (OSError, ValueError, SyntaxError, EOFError, MemoryError) as error:
            raise _broken(path, error) from None
        try:
            exif = image.getexif()
            more = exif.get_ifd(_EXIF_IFD)
            focal = float(more.get(_FOCAL_OF_FILM) or more.get(_FOCAL) or 0)
            return Shot(size, kind, str(exif.get(_MODEL, "")), focal if focal > 0 else 0.0)
        except (OSError, ValueError, SyntaxError, TypeError, ArithmeticError, LookupError, struct.error):
            return Shot(size, kind)  # as any program may write there what it likes


def read_exif(path: Path) -> bytes:
    """The EXIF data of an image; empty if it has none."""
    with _opened(path) as image:
        return bytes(image.getexif().tobytes())


def _broken(path: str | os.PathLike[str], error: BaseException) -> FileFormatError:
    return FileFormatError(f"{path}: a broken image: {str(error)[:120]}")


def _formats(path: str | os.PathLike[str], data: bytes | None) -> tuple[str, ...]:
    """The formats to try. Raises MissingDependencyError for HEIF without its library."""
    if data is None:
        with open(path, "rb") as file:
            head = file.read(12)
    else:
        head = data[:12]
    if not _HEIF.match(head):
        return FORMATS
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        raise MissingDependencyError(
            f"{path}: a HEIF image (.heic), which needs the library pillow-heif: pip install"
            " 'meshsplats[heic]'; or convert it to JPEG"
        ) from None
    register_heif_opener()
    return (*FORMATS, "HEIF")


def _opened(path: str | os.PathLike[str], data: bytes | None = None) -> Any:
    try:
        from PIL import Image
    except ImportError:
        raise MissingDependencyError("reading images needs Pillow: pip install pillow") from None
    try:
        formats = _formats(path, data)
        image = Image.open(path if data is None else io.BytesIO(data), formats=formats)
    except (FileNotFoundError, PermissionError):
        raise
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError, Warning) as error:
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


def _turn(image: Any) -> int:
    # Pillow turns the pixels of these formats itself, and looks for EXIF behind the pixels if none is before.
    if image.format in ("TIFF", "HEIF") or "exif" not in image.info:
        return 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # EXIF that is broken says nothing
        try:
            return _TURNS.get(image.getexif().get(_ORIENTATION), 0)
        except (OSError, ValueError, SyntaxError, TypeError, KeyError, struct.error):
            return 0


def _has_alpha(image: Any) -> bool:
    return image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info
