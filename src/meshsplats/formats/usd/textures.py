"""Textures of USD files with their coordinates, for base meshes: those that a UsdPreviewSurface shows.

Images lie in the folder of the file or below, or in the same .usdz package. USD names them; they are read
here.
"""

from __future__ import annotations

import posixpath
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats._beside import file_beside, shown_name, warn_of_missing
from meshsplats.formats._validation import Budget
from meshsplats.formats.content import Content
from meshsplats.formats.gltf.textures import cut_out
from meshsplats.formats.usd.reader import extracted
from meshsplats.scene.base_mesh import Texture
from meshsplats.scene.colors import linear_to_srgb

_KINDS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".heic")
"""Images that are read; USD may name others, such as .exr."""


def usd_textures(
    path: Path, read: Callable[[Path, bytes | None], np.ndarray], override: Texture | None = None
) -> tuple[np.ndarray, np.ndarray, tuple[Texture, ...]]:
    """Texture coordinates (m, 3, 2) float32, v down, and texture index (m,) int32, -1 for none, of each
    triangle in the order of ``read_usd``; and the textures.

    ``override`` is a texture for all triangles that have coordinates. A DataWarning names images that are
    missing, or of a kind that is not read. FileFormatError for a name that leads out of the package, or out
    of the folder of ``path`` (unless ``file_beside`` finds the image there), and for broken files.
    """
    report, arrays = extracted(path, "meshsplats.formats.usd.texture_extraction")
    uv, index = arrays["uv"], arrays["texture"]
    if override is None:
        for message in report["warnings"]:
            warnings.warn(f"{path}: {message}", DataWarning, stacklevel=4)
        numbers, textures = _textures(path, report["textures"], read)
        index = np.array([*numbers, -1], np.int32)[index]
    else:
        index, textures = np.zeros(len(uv), np.int32), (override,)
    complete = np.isfinite(uv).all(axis=(1, 2))
    return np.nan_to_num(uv, posinf=0, neginf=0), np.where(complete, index, -1).astype(np.int32), textures


def _textures(
    path: Path, uses: list[dict[str, Any]], read: Callable[[Path, bytes | None], np.ndarray]
) -> tuple[list[int], tuple[Texture, ...]]:
    """The index of the texture of each of ``uses``, -1 for none, and the textures."""
    textures: list[Texture] = []
    known: dict[tuple[Any, ...], int] = {}
    numbers = []
    with Content(path) as content:
        images = _Images(content, read)
        for use in uses:
            factor, cutoff, wrap = use["factor"], use["cutoff"], use["wrap"]
            key = (use["file"], *wrap, *factor, cutoff, use["raw"])
            if key not in known:
                shown = images.shown(use["file"], use["raw"], cutoff)
                known[key] = -1 if shown is None else len(textures)
                if shown is not None:
                    textures.append(Texture(shown, (wrap[0], wrap[1]), tuple(factor)))
            numbers.append(known[key])
    warn_of_missing(path, images.missing, 5)
    if images.unread:
        warnings.warn(
            f"{path}: {images.unread} textures are of a kind that is not read; their faces have none",
            DataWarning,
            stacklevel=5,
        )
    return numbers, tuple(textures)


def _display(pixels: np.ndarray) -> np.ndarray:
    """``pixels`` (h, w, 4) uint8 whose colours are linear, as display values."""
    table = np.rint(255 * linear_to_srgb(np.arange(256) / 255)).astype(np.uint8)
    return np.concatenate([table[pixels[..., :3]], pixels[..., 3:]], axis=2)


class _Images:
    """The images that a file names, each read once, and made once for each way in which it is used."""

    def __init__(self, content: Content, read: Callable[[Path, bytes | None], np.ndarray]) -> None:
        self.missing: list[str] = []
        self.unread = 0
        self._content, self._read = content, read
        self._budget = Budget(content.path)
        self._packed = frozenset(content.archive.names if content.usd_layer else ())
        self._known: dict[str, np.ndarray | None] = {}
        self._shown: dict[tuple[str, bool, float | None], np.ndarray | None] = {}

    def shown(self, name: str, raw: bool, cutoff: float | None) -> np.ndarray | None:
        """(h, w, 4) uint8 display RGBA of the image of this ``name``, used as ``TextureUse`` says; None, and
        counted, where there is none."""
        key = name, raw, cutoff
        if key not in self._shown:
            pixels = self._pixels(name)
            if pixels is not None:
                self._budget.spend(pixels.nbytes, "a texture")
                pixels = _display(pixels) if raw else pixels
                pixels = pixels if cutoff is None else cut_out(pixels, 1, cutoff)
            self._shown[key] = pixels
        return self._shown[key]

    def _pixels(self, name: str) -> np.ndarray | None:
        if name not in self._known:
            self._known[name] = None
            if not name.lower().endswith(_KINDS):
                self.unread += 1
            elif (pixels := self._inside(name) if self._packed else self._beside(name)) is None:
                self.missing.append(shown_name(name.encode()))
            else:
                self._budget.spend(pixels.nbytes, "an image")
                self._known[name] = pixels
        return self._known[name]

    def _beside(self, name: str) -> np.ndarray | None:
        image = file_beside(self._content.path, name.encode())
        if not image.is_file():
            return None
        self._budget.extend(image.stat().st_size)
        return self._read(image, None)

    def _inside(self, name: str) -> np.ndarray | None:
        """An entry of the package, whose name is relative to that of the layer."""
        path, layer = self._content.path, self._content.usd_layer or ""
        entry = posixpath.normpath(posixpath.join(posixpath.dirname(layer), name.replace("\\", "/")))
        if entry.startswith(("/", "../")):
            raise FileFormatError(
                f"{path}: refers to {shown_name(name.encode())!r} outside the package; refused. Put it inside"
            )
        if entry not in self._packed:
            return None
        with self._content.archive.open(entry) as file:
            data = file.read()
        self._budget.spend(len(data), "an image")
        return self._read(path, data)
