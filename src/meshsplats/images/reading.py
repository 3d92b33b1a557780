"""Image files from strangers: their size from the header, their pixels within limits."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.camera import MAX_SIDE
from meshsplats.errors import FileFormatError, MissingDependencyError

MAX_PIXELS = 1 << 26
"""Pictures of more pixels than this (67 million) are refused: a small file can claim any size."""
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")
"""What Pillow may read here. Other formats of its start programs, or hold no photographs."""


@dataclass(frozen=True)
class Header:
    """What the start of a picture file tells."""

    width: int
    height: int
    has_alpha: bool


def read_header(path: Path) -> Header:
    """Size and kind of a picture. FileFormatError for what is none, or too large."""
    with _opened(path) as image:
        return Header(image.width, image.height, _has_alpha(image))


def load_image(path: Path, data: bytes | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """uint8 (h, w, 3) RGB, and uint8 (h, w) straight alpha or None. FileFormatError for a broken picture.

    ``data`` is a picture that lies inside another file, which ``path`` then names in messages."""
    with _opened(path, data) as image:
        try:
            if image.mode.startswith("I;16") or image.mode == "I":
                grey = np.asarray(image, np.int64)
                if grey.min(initial=0) < 0 or grey.max(initial=0) > 65535:
                    raise FileFormatError(f"{path}: integers beyond 16 bits are no picture")
                return np.repeat(np.rint(grey / 257).astype(np.uint8)[..., None], 3, axis=2), None
            if image.mode == "F":
                raise FileFormatError(f"{path}: holds floating-point values; convert it to 8 bits")
            if _has_alpha(image):
                pixels = np.asarray(image.convert("RGBA"))
                return pixels[..., :3], pixels[..., 3]
            return np.asarray(image.convert("RGB")), None
        except FileFormatError:
            raise
        except (OSError, ValueError, SyntaxError, EOFError, MemoryError) as error:
            raise FileFormatError(f"{path}: a broken picture: {str(error)[:120]}") from None


def _opened(path: Path, data: bytes | None = None) -> Any:
    try:
        from PIL import Image
    except ImportError:
        raise MissingDependencyError("reading photographs needs Pillow: pip install pillow") from None
    try:
        image = Image.open(path if data is None else io.BytesIO(data), formats=FORMATS)
    except FileNotFoundError:
        raise
    except PermissionError:
        raise
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError, Warning) as error:
        raise FileFormatError(
            f"{path}: not a picture of a known kind ({', '.join(FORMATS)}): {str(error)[:120]}"
        ) from None
    width, height = image.size
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE or min(width, height) < 1:
        image.close()
        raise FileFormatError(
            f"{path}: {width} x {height} pixels; up to {MAX_PIXELS:,} pixels and {MAX_SIDE} a side are read."
            " Make it smaller"
        )
    return image


def _has_alpha(image: Any) -> bool:
    return image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info
