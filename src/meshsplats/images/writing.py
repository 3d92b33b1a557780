"""Writing image files: images, 16-bit depth PNG, animations; and images side by side.

Values are display-referred (sRGB-encoded) RGB, as splats have them, and are stored as they are: value v
becomes the byte round(255 v). Pillow is imported where it is used.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from meshsplats._common.arrays import check_units
from meshsplats._common.kinds import need_array, need_path
from meshsplats._files.atomic import write_bytes

if TYPE_CHECKING:
    from PIL import Image

ANIMATIONS = (".webp", ".gif", ".png")
"""Suffixes of the animations that can be written; .png is an animated PNG."""
_ENCODERS: dict[str, dict[str, Any]] = {
    # Runs of equal bytes alone (zlib's Z_RLE), which PNG's filters make of most images, take a third of the
    # time that Pillow's default takes; files are as large to a fifth larger.
    ".png": {"format": "PNG", "compress_level": 1, "compress_type": 3},
    ".jpg": {"format": "JPEG", "quality": 95, "subsampling": 0},
    ".jpeg": {"format": "JPEG", "quality": 95, "subsampling": 0},
    ".webp": {"format": "WEBP", "lossless": True, "exact": True},
}
"""Pillow's options for each suffix of an image."""
GAP = 8
"""Pixels between and around the images of a strip."""
CAPTION = 22
"""Height of the line of text above a strip, in pixels."""


def to_bytes(image: np.ndarray) -> np.ndarray:
    """uint8 array of the same shape: ``round(255 * clip(image, 0, 1))``. TypeError for whole numbers,
    ValueError for values not finite."""
    kind = np.asarray(image).dtype
    if kind.kind in "iu":
        raise TypeError(f"an image must hold float values from 0 to 1, got {kind}: divide bytes by 255")
    image = np.asarray(image, np.float32)
    if not np.isfinite(image).all():
        raise ValueError("an image holds values that are not finite")
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


def straight_rgba(premultiplied: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """(h, w, 4) straight RGBA of an image on black, which is colour times opacity, with ``alpha`` (h, w).

    Composited over any background in display values, it gives the image rendered on that background.
    """
    covered = alpha > 0
    color = np.divide(
        premultiplied, alpha[..., None], out=np.zeros_like(premultiplied), where=covered[..., None]
    )
    return np.concatenate([np.clip(color, 0, 1), alpha[..., None]], axis=2).astype(np.float32)


def save_image(path: str | os.PathLike[str], image: np.ndarray) -> None:
    """Writes an image in the format that the suffix of ``path`` names; replaces an older file.

    Args:
        path: .png and .webp keep each byte, .jpg or .jpeg loses a little.
        image: (h, w, 3) RGB or, not for JPEG, (h, w, 4) straight RGBA, in [0, 1].

    Raises:
        TypeError: an image of whole numbers, such as bytes: divide them by 255.
        ValueError: the suffix or the shape is another, a value is not finite, or they are from 0 to 255.
    """
    need_path(path=path, instead={"ndarray": "the path comes first, save_image(path, image)"})
    need_array(image=image)
    content = encode_image(path, image)
    check_units("an image", np.asarray(image))
    write_bytes(path, content)


def encode_image(path: str | os.PathLike[str], image: np.ndarray) -> bytes:
    """The content of the file that ``save_image`` writes to ``path``; its errors, but for values from
    0 to 255: images of splats may be as bright."""
    from PIL import Image

    encoder = _ENCODERS.get(Path(path).suffix.lower())
    if encoder is None:
        raise ValueError(f"an image is written as {', '.join(_ENCODERS)}, got {Path(path).name!r}")
    channels = (3,) if encoder["format"] == "JPEG" else (3, 4)
    if np.ndim(image) != 3 or np.shape(image)[2] not in channels:
        wanted = " or ".join(f"(h, w, {c})" for c in channels)
        raise ValueError(f"{encoder['format']} images must have shape {wanted}, got {np.shape(image)}")
    return _encoded(Image.fromarray(to_bytes(image)), **encoder)


def encode_depth_png(depth: np.ndarray, unit: float) -> bytes:
    """A file with ``depth`` (h, w) as 16-bit grey PNG: ``round(depth / unit)``, at most 65535; 0 means empty.

    ``unit`` is the depth of one step in scene units, > 0; a reader needs it to get depths back.
    """
    from PIL import Image

    if not (np.isfinite(unit) and unit > 0):
        raise ValueError(f"unit must be positive, got {unit}")
    steps = np.clip(np.rint(np.asarray(depth, np.float64) / unit), 0, 65535).astype(np.uint16)
    # A positive depth must not become 0, which means empty.
    steps[(depth > 0) & (steps == 0)] = 1
    return _encoded(Image.fromarray(steps), format="PNG")


def encode_array(array: np.ndarray) -> bytes:
    """A .npy file with ``array``."""
    encoded = io.BytesIO()  # as in _encoded: to a file, NumPy reports only how many numbers did not fit
    np.save(encoded, array, allow_pickle=False)
    return encoded.getvalue()


def save_animation(
    path: str | os.PathLike[str], frames: Iterable[np.ndarray], *, fps: float = 24.0, max_side: int = 640
) -> None:
    """Writes an endless animation as .webp, .gif or .png (APNG), by the suffix of ``path``.

    ``frames`` are uint8 images (h, w, 3) or, not for GIF, (h, w, 4) of one size. Their longer side is
    scaled down to ``max_side`` pixels, as animations are large. GIF has 256 colours; the others lose little
    or nothing.

    Raises ValueError for another suffix, no frames or a rate out of range (0.1 to 100 frames a second, of GIF
    to 50).
    """
    from PIL import Image

    suffix = Path(path).suffix.lower()
    if suffix not in ANIMATIONS:
        raise ValueError(f"an animation is written as {', '.join(ANIMATIONS)}, got {Path(path).name!r}")
    if not 0.1 <= fps <= 100:
        raise ValueError(f"fps must lie between 0.1 and 100 frames a second, got {fps}")
    if suffix == ".gif" and fps > 50:
        raise ValueError(f"browsers play GIF at 50 frames a second at most, got fps {fps:g}: take .webp")
    images = [_fitting(Image.fromarray(frame), max_side) for frame in frames]
    if not images:
        raise ValueError("an animation needs at least one frame")
    options: dict[str, dict[str, Any]] = {
        ".webp": {"quality": 85, "method": 4},
        ".gif": {"disposal": 1},
        ".png": {},
    }
    if suffix == ".gif":
        images = [_paletted(image) for image in images]
    unit = 10 if suffix == ".gif" else 1  # milliseconds
    ends = unit * np.rint(np.arange(len(images) + 1) * (1000 / fps / unit)).astype(int)
    encoded = _encoded(
        images[0],
        format={".webp": "WEBP", ".gif": "GIF", ".png": "PNG"}[suffix],
        save_all=True,
        append_images=images[1:],
        duration=np.diff(ends).tolist(),
        loop=0,
        **options[suffix],
    )
    write_bytes(path, encoded)


def _encoded(image: Image.Image, **options: Any) -> bytes:
    """Encodes in memory: Pillow's encoders lose the reason why a write to disk fails."""
    encoded = io.BytesIO()
    image.save(encoded, **options)
    return encoded.getvalue()


def strip(images: Sequence[np.ndarray], captions: Sequence[str] = ()) -> np.ndarray:
    """(h', w', 3) float32 in [0, 1]: ``images`` (h, w, 3) of one size side by side on white, each below its
    caption."""
    height, width = np.shape(images[0])[:2]
    if any(np.shape(image) != (height, width, 3) for image in images):
        raise ValueError(f"the images of a strip must have one shape, got {[np.shape(i) for i in images]}")
    top = CAPTION if captions else GAP
    sheet = np.ones((top + height + GAP, GAP + len(images) * (width + GAP), 3), np.float32)
    for i, image in enumerate(images):
        left = GAP + i * (width + GAP)
        sheet[top : top + height, left : left + width] = np.clip(image, 0, 1)
    if captions:
        sheet[:top] = _text(captions, width + GAP, sheet.shape[1])
    return sheet


def amplified_error(a: np.ndarray, b: np.ndarray, factor: float) -> np.ndarray:
    """(h, w, 3) float32 in [0, 1]: ``clip(factor * |a - b|)``; black where the images agree."""
    return np.clip(np.float32(factor) * np.abs(np.asarray(a, np.float32) - b), 0, 1)


def _text(captions: Sequence[str], step: int, width: int) -> np.ndarray:
    """(CAPTION, width, 3): the captions in dark grey, ``step`` pixels apart."""
    from PIL import Image, ImageDraw, ImageFont

    line = Image.new("RGB", (width, CAPTION), "white")
    draw = ImageDraw.Draw(line)
    font = ImageFont.load_default()
    for i, caption in enumerate(captions):
        if isinstance(font, ImageFont.ImageFont):  # before Pillow 10.1, or without FreeType
            caption = caption.encode("latin-1", "replace").decode("latin-1")
        draw.text((GAP + i * step, 6), caption, fill=(60, 60, 60), font=font)
    return np.asarray(line, np.float32) / 255


def _fitting(image: Image.Image, max_side: int) -> Image.Image:
    from PIL import Image

    factor = max_side / max(image.size)
    if factor >= 1:
        return image
    width, height = (max(1, round(side * factor)) for side in image.size)
    return image.resize((width, height), Image.Resampling.LANCZOS)


def _paletted(image: Image.Image) -> Image.Image:
    """256 colours chosen for this frame, dithered: smooth shades otherwise show bands."""
    from PIL import Image

    if image.mode != "RGB":
        raise ValueError("GIF has no translucency: write a .webp or .png animation of images with alpha")
    palette = image.quantize(255, method=Image.Quantize.MEDIANCUT)
    indices = np.array(image.quantize(255, palette=palette, dither=Image.Dither.FLOYDSTEINBERG))
    # A plain background would be tinted by a mean of similar colours: the commonest colour gets an index of
    # its own.
    counts = cast("list[tuple[int, tuple[int, int, int]]]", image.getcolors(image.width * image.height))
    commonest = max(counts)[1]
    indices[(np.asarray(image) == commonest).all(axis=2)] = 255
    colors = (palette.getpalette() or [])[: 255 * 3]
    result = Image.fromarray(indices)
    result.putpalette([*colors, *[0] * (255 * 3 - len(colors)), *commonest])
    return result
