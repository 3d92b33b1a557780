"""Textures of glTF files, of the colours that materials show, with their coordinates, for base meshes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.errors import DataWarning
from meshsplats.formats.gltf.document import GltfDocument, dict_or_empty
from meshsplats.formats.gltf.looks import Look, look_of
from meshsplats.formats.gltf.reader import (
    POINTS_TO_LINES,
    linear_colors,
    placed_faces,
)
from meshsplats.formats.gltf.scene_parts import shown_meshes
from meshsplats.scene.base_mesh import Texture, Wrap

_WRAPS: dict[object, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_SOURCES = ("EXT_texture_webp",)
"""Extensions that name an alternative image of a texture, of a format that Pillow can read."""


def gltf_textures(
    path: Path, read: Callable[[Path, bytes], np.ndarray], override: Texture | None = None
) -> tuple[np.ndarray, np.ndarray, tuple[Texture, ...], np.ndarray | None] | None:
    """Texture coordinates (m, 3, 2) float32, v down, and texture index (m,) int32, -1 for none, of each
    triangle in the order of ``read_gltf``; the textures; and what the vertices multiply them by, (n, 4)
    float32 linear RGBA in [0, 1], None where all are white. None if no triangle has a texture.

    ``override`` is a texture for all triangles that have coordinates, as it is. A DataWarning counts what is
    left out. Raises FileFormatError.
    """
    document = GltfDocument(path)
    document.unflagged.add("COLOR_0")  # which ``read_gltf`` has said
    found = _Textures(document, read)
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    tints: list[tuple[int, np.ndarray | None]] = []
    for place in shown_meshes(document):
        for primitive in document.objects(place.mesh.get("primitives"), "primitives of a mesh"):
            if primitive.get("mode", 4) in POINTS_TO_LINES:
                continue
            attributes = dict_or_empty(primitive.get("attributes"))
            v = document.whole(
                document.item("accessors", attributes.get("POSITION"), "POSITION"), "count", "POSITION"
            )
            faces = placed_faces(document, place, primitive, v)
            look = look_of(document, primitive)
            uv = None
            if look.texture or override is not None:
                uv = _coordinates(document, attributes, look.texture, v)
            index = -1
            if uv is not None:
                index = 0 if override is not None else found.index_of(look)
                document.budget.spend(24 * len(faces), "texture coordinates")
            corners = np.zeros((len(faces), 3, 2), np.float32) if uv is None else uv[faces]
            parts.append((corners, np.full(len(faces), index, np.int32)))
            plain = index < 0 or override is not None
            tints.append((v, None if plain else found.tint_of(look, attributes, v)))
    if found.unread:
        warnings.warn(
            f"{path}: {found.unread} textures are of a kind that is not read; their faces have none",
            DataWarning,
            stacklevel=4,
        )
    if found.uncut:
        warnings.warn(
            f"{path}: opacities of the vertices of {found.uncut} primitives were left out: textures alone"
            " cut these out",
            DataWarning,
            stacklevel=4,
        )
    if not parts or all((number < 0).all() for _, number in parts):
        return None
    textures = tuple(found.textures) if override is None else (override,)
    tinted = None
    if any(tint is not None for _, tint in tints):
        tinted = np.concatenate([np.ones((v, 4), np.float32) if tint is None else tint for v, tint in tints])
    return np.concatenate([c for c, _ in parts]), np.concatenate([n for _, n in parts]), textures, tinted


def cut_out(pixels: np.ndarray, factor: float, cutoff: float) -> np.ndarray:
    """``pixels`` (h, w, 4) uint8 RGBA, opaque where ``factor`` times their alpha, 0 to 1, is at least
    ``cutoff``, and transparent elsewhere: themselves if they are so, else a copy."""
    alpha = np.where(pixels[..., 3] * (factor / 255) >= cutoff, np.uint8(255), np.uint8(0))
    if (alpha == pixels[..., 3]).all():
        return pixels
    return np.concatenate([pixels[..., :3], alpha[..., None]], axis=2)


def _coordinates(
    document: GltfDocument, attributes: dict[str, Any], info: dict[str, Any], v: int
) -> np.ndarray | None:
    """(v, 2) float32 after KHR_texture_transform; None if there are none."""
    transform = dict_or_empty(dict_or_empty(info.get("extensions")).get("KHR_texture_transform"))
    chosen = document.whole(transform if "texCoord" in transform else info, "texCoord", "a texture", 0)
    name = f"TEXCOORD_{chosen}"
    if name not in attributes:
        return None
    # KHR_mesh_quantization alone admits coordinates that are whole numbers.
    quantized = document.uses("KHR_mesh_quantization")
    uv = document.floats(attributes[name], name, fractions=not quantized)
    if uv.shape != (v, 2) or not np.isfinite(uv).all():
        raise document.error(f"{name} must be {v:,} finite pairs, got shape {uv.shape}")
    if transform:
        offset = document.numbers(transform.get("offset", [0, 0]), 2, "offset of a texture")
        scale = document.numbers(transform.get("scale", [1, 1]), 2, "scale of a texture")
        turn = float(document.numbers([transform.get("rotation", 0)], 1, "rotation of a texture")[0])
        u, w = (uv * scale).T
        cos, sin = np.cos(turn), np.sin(turn)
        with np.errstate(over="ignore"):
            moved = np.stack([cos * u + sin * w, cos * w - sin * u], axis=1) + offset
            uv = moved.astype(np.float32)
        if not np.isfinite(uv).all():
            raise document.error("the transform of a texture leads to infinite coordinates")
    return uv


@dataclass
class _Textures:
    """The textures that have been used so far."""

    document: GltfDocument
    read: Callable[[Path, bytes], np.ndarray]
    textures: list[Texture] = field(default_factory=list)
    unread: int = 0
    uncut: int = 0
    """Primitives whose vertices have opacities, too, by which they should be cut out."""
    _indices: dict[tuple[Any, ...], int] = field(default_factory=dict)
    _images: dict[int, np.ndarray] = field(default_factory=dict)
    _cut: dict[tuple[int, float, float], np.ndarray] = field(default_factory=dict)

    def index_of(self, look: Look) -> int:
        """Index of the texture of ``look``; -1 if it is of an unknown kind."""
        document = self.document
        texture = document.item("textures", look.texture.get("index"), "the texture of a material")
        source = texture.get("source")
        for name in _SOURCES:
            source = dict_or_empty(dict_or_empty(texture.get("extensions")).get(name)).get("source", source)
        if source is None:
            self.unread += 1
            return -1
        document.item("images", source, "a texture")
        sampler: dict[str, Any] = {}
        if "sampler" in texture:
            sampler = document.item("samplers", texture["sampler"], "a texture")
        ways = [sampler.get(way, 10497) for way in ("wrapS", "wrapT")]
        wraps = [_WRAPS.get(way) if isinstance(way, (int, float)) else None for way in ways]
        if None in wraps:
            raise document.error(f"unknown wrapping of a texture: {str(sampler)[:80]}")
        factor = np.ones(4) if look.factor is None else look.factor.copy()
        mode, cutoff = look.alpha_mode, look.cutoff
        key = (source, *wraps, *factor, mode, cutoff)
        if key not in self._indices:
            pixels = self._image(source)
            if mode != "BLEND":
                pixels = self._cut_out(
                    source, pixels, factor[3], -math.inf if mode == "OPAQUE" else look.cutoff
                )
                factor[3] = 1
            self._indices[key] = len(self.textures)
            self.textures.append(Texture(pixels, (wraps[0], wraps[1]), tuple(factor)))  # type: ignore[arg-type]
        return self._indices[key]

    def tint_of(self, look: Look, attributes: dict[str, Any], v: int) -> np.ndarray | None:
        """(v, 4) float32 linear RGBA in [0, 1]: what the vertices of a primitive multiply the texture of
        ``look`` by (glTF 2.0, 3.9.2); None where they are white."""
        if "COLOR_0" not in attributes or look.emits:
            return None
        self.document.budget.spend(16 * v, "vertex colours")
        tint = linear_colors(self.document, attributes, v).clip(0, 1)
        if look.alpha_mode != "BLEND":
            self.uncut += look.alpha_mode == "MASK" and bool((tint[:, 3] != 1).any())
            tint[:, 3] = 1
        return None if (tint == 1).all() else tint

    def _cut_out(self, source: int, pixels: np.ndarray, factor: float, cutoff: float) -> np.ndarray:
        """``cut_out``, once for all materials that cut the image ``source`` alike."""
        key = source, 1.0 if cutoff == -math.inf else factor, cutoff
        if key not in self._cut:
            cut = cut_out(pixels, factor, cutoff)
            if cut is not pixels:
                self.document.budget.spend(cut.nbytes, "a texture")
            self._cut[key] = cut
        return self._cut[key]

    def _image(self, source: object) -> np.ndarray:
        document = self.document
        image = document.item("images", source, "a texture")
        assert isinstance(source, int)
        if source not in self._images:
            if "bufferView" in image:
                data = bytes(document.view_bytes(image["bufferView"], "an image")[0])
            elif isinstance(image.get("uri"), str):
                data = bytes(document.uri_bytes(image["uri"], f"image {source}"))
            else:
                raise document.error(f"image {source} has neither data nor URI")
            pixels = self.read(document.path, data)
            document.budget.spend(pixels.nbytes, "an image")
            self._images[source] = pixels
        return self._images[source]
