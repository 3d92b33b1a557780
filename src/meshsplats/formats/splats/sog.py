"""SOG: splats as images. A folder or a zip archive with ``meta.json`` and one lossless WebP for each
attribute.

Pixel i (row by row) belongs to splat i. Version 2 looks bytes up in codebooks, version 1 (no version number)
maps them between a least and a largest value. Specification: developer.playcanvas.com, "The SOG Format".
"""

from __future__ import annotations

import io
import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from meshsplats._common.json_files import can_be_named, json_object
from meshsplats.errors import FileFormatError, MissingDependencyError
from meshsplats.formats._validation import Budget
from meshsplats.formats._zipped import MAX_META_BYTES, Archive
from meshsplats.formats.content import Content
from meshsplats.formats.reading import FormatReader
from meshsplats.formats.splats._cloud_builder import Fill, SplatReader, SplatRows, decode_smallest_three
from meshsplats.scene.gaussians import Kernel
from meshsplats.scene.origin import SAMPLE

T = TypeVar("T")
_SECTIONS = (b'"means"', b'"quats"', b'"sh0"')
"""Words of every meta.json."""
_MAX_SPLATS = 1 << 28
_MAX_IMAGE_BYTES = 4 * _MAX_SPLATS
_AT_ONCE = 1 << 16
_COEFFICIENTS = {1: 3, 2: 8, 3: 15}
_PALETTE_COLUMNS = 64
"""Palette entries of harmonics in each row of their image."""


def read_sog(
    content: Content, budget: Budget, ranges: Sequence[tuple[int, int]] | None = None
) -> SplatReader:
    """The splats of a `.sog` archive, or of the folder of a meta.json; errors as ``load_gaussians``.

    Images are unpacked as a whole, 4 bytes for each splat and image. ``ranges`` selects splats by first and
    end; ranges may overlap. None selects all.
    """
    return _reader(content, budget).read(ranges)


def sog_corners(path: Path) -> np.ndarray:
    """(2, 3) float64: the least and the greatest coordinates of the splats that ``read_sog`` reads."""
    with Content(path) as content:
        return _reader(content, Budget(path)).corners()


def _reader(content: Content, budget: Budget) -> _Reader:
    path = content.path
    files = _Archive(content.archive) if content.is_archive else _Folder(path.parent, path, budget)
    return _Reader(files, path, budget)


def _matches(content: Content) -> bool:
    if content.is_archive:
        try:
            return content.archive.meta is not None
        except FileFormatError:  # broken: the reader says so
            return True
    text = content.json_text
    if all(name in text for name in _SECTIONS):  # some name their generator in an asset, as glTF does
        return True
    return b'"means"' in text and not any(
        name in text for name in (b'"lodLevels"', b'"asset"', b'"totalLevel"')
    )


class _Folder:
    """Files beside meta.json."""

    def __init__(self, folder: Path, meta: Path, budget: Budget) -> None:
        self._folder, self._meta, self._budget = folder, meta, budget

    def read_meta(self) -> bytes:
        with open(self._meta, "rb") as file:
            return file.read(MAX_META_BYTES + 1)

    def read(self, name: str) -> bytes:
        found = self._folder / name
        if not (can_be_named(found) and found.is_file()):
            raise FileFormatError(f"{self._meta}: the file {name!r} that it names is missing")
        size = os.stat(found).st_size
        if size > _MAX_IMAGE_BYTES:
            raise FileFormatError(f"{self._meta}: {name!r} has over {_MAX_IMAGE_BYTES:,} bytes; refused")
        self._budget.extend(size)
        return found.read_bytes()


class _Archive:
    """Files in a zip archive, beside its meta.json."""

    def __init__(self, archive: Archive) -> None:
        self._archive, self._names = archive, set(archive.names)
        if archive.meta is None:
            listed = ", ".join(sorted(self._names)[:5])[:200]
            raise FileFormatError(
                f"{archive.path}: a zip archive without meta.json is no SOG file (it holds {listed})"
            )
        self._meta = archive.meta
        # Images are compressed already: more than this is a decompression bomb.
        self._limit = (16 << 20) + 4 * os.stat(archive.path).st_size

    def read_meta(self) -> bytes:
        return self._archive.bytes(self._meta, MAX_META_BYTES)

    def read(self, name: str) -> bytes:
        full = self._meta[: -len("meta.json")] + name
        if full not in self._names:
            raise FileFormatError(
                f"{self._archive.path}: the file {name!r} that meta.json names is not in the archive"
            )
        return self._archive.bytes(full, self._limit)


class _Reader:
    def __init__(self, files: _Folder | _Archive, where: Path, budget: Budget) -> None:
        self._files, self._where, self._budget = files, where, budget
        self._meta = json_object(files.read_meta(), MAX_META_BYTES, f"{where}: meta.json")

    def _error(self, message: str) -> FileFormatError:
        return FileFormatError(f"{self._where}: {message}")

    def read(self, ranges: Sequence[tuple[int, int]] | None) -> SplatReader:
        version = self._meta.get("version")
        if version not in (None, 2):
            raise self._error(f"SOG version {str(version)[:20]}; known are 2, and 1, which has no number")
        stored = self._count(version)
        rest = self._section("shN") if "shN" in self._meta else None
        files = {
            name: self._files_of(name, n)
            for name, n in (("means", 2), ("scales", 1), ("quats", 1), ("sh0", 1))
        }
        palette, labels = np.empty((0, 0, 3), np.float32), None
        if rest is not None:
            files["shN"] = self._files_of("shN", 2)
        data = {name: [self._files.read(n) for n in names] for name, names in files.items()}
        self._budget.spend(64 * stored, f"its {stored:,} splats")
        chosen, count = self._chosen(ranges, stored)
        if rest is not None:
            palette = self._palette(data["shN"][0], rest, version)
            labels = self._pixels(data["shN"][1], "shN labels", stored)[chosen]
            self._budget.spend(24 * palette.shape[1] * count, "its spherical harmonics")
        pixels = {
            name: [self._pixels(d, name, stored)[chosen] for d in data[name]]
            for name in data
            if name != "shN"
        }
        coefficients = 1 + palette.shape[1]
        if labels is not None:
            palette = np.concatenate([palette, np.zeros((1, *palette.shape[1:]), np.float32)])
        maps = self._maps(version)
        chunks = partial(self._chunks, count, pixels, labels, palette, maps)
        step = max(1, count // SAMPLE)
        few = [image[::step] for image in pixels["means"]]
        positions = partial(_positions, few, maps.positions)
        note = self._note()
        return SplatReader(
            count,
            coefficients,
            self._kernel(),
            self._where,
            chunks,
            positions,
            float32=False,
            up=note.get("up"),
            origin=note.get("origin"),
        )

    def corners(self) -> np.ndarray:
        """(2, 3) float64: the least and the greatest coordinates, by meta.json alone."""
        ends = np.stack(self._range("means", 3))
        with np.errstate(over="ignore"):
            return np.sign(ends) * np.expm1(np.abs(ends))

    def _chunks(
        self,
        count: int,
        pixels: dict[str, list[np.ndarray]],
        labels: np.ndarray | None,
        palette: np.ndarray,
        maps: _Maps,
        origin: np.ndarray,
    ) -> Iterator[tuple[int, Fill]]:
        for start in range(0, count, _AT_ONCE):
            part = slice(start, min(start + _AT_ONCE, count))
            own = {name: [image[part] for image in images] for name, images in pixels.items()}
            index = None
            if labels is not None:
                index = labels[part, 0] + labels[part, 1].astype(np.int32) * 256
                np.minimum(index, len(palette) - 1, out=index)  # a label beyond the palette: no harmonics
            yield part.stop - start, partial(_fill, own, maps, palette, index, origin)

    def _maps(self, version: int | None) -> _Maps:
        """Checks and reads what the values of pixels mean."""
        positions = self._range("means", 3)
        if version is None:
            return _Maps(positions, ranges={"scales": self._range("scales", 3), "sh0": self._range("sh0", 4)})
        return _Maps(positions, books={name: self._codebook(name) for name in ("scales", "sh0")})

    def _chosen(
        self, ranges: Sequence[tuple[int, int]] | None, stored: int
    ) -> tuple[np.ndarray | slice, int]:
        """Index of the splats of ``ranges`` among all rows, and their count."""
        if ranges is None:
            return slice(None), stored
        edges = np.zeros(stored + 1, np.int64)  # ranges may overlap
        for first, end in ranges:
            if end > stored:
                raise self._error(f"splats {first:,} to {end:,} are requested, but it has {stored:,}")
            edges[first] += 1
            edges[end] -= 1
        chosen = np.cumsum(edges[:-1]) > 0
        return chosen, int(np.count_nonzero(chosen))

    # -- meta.json

    def _section(self, name: str) -> dict[str, Any]:
        section = self._meta.get(name)
        if not isinstance(section, dict):
            raise self._error(f"meta.json has no object {name!r}, which SOG needs")
        return section

    def _count(self, version: int | None) -> int:
        if version is None:
            shape = self._section("means").get("shape")
            count = shape[0] if isinstance(shape, list) and shape else None
        else:
            count = self._meta.get("count")
        if not isinstance(count, int) or isinstance(count, bool) or not 0 <= count <= _MAX_SPLATS:
            raise self._error(
                f"meta.json must give a number of splats up to {_MAX_SPLATS:,}, got {str(count)[:30]}"
            )
        return count

    def _files_of(self, name: str, n: int) -> list[str]:
        names = self._section(name).get("files")
        if not isinstance(names, list) or len(names) != n or not all(isinstance(x, str) for x in names):
            raise self._error(f"meta.json must name {n} file(s) of {name!r}, got {str(names)[:80]}")
        for file_name in names:
            # A plain name in the folder: nothing that could lead out of it on any system.
            if not re.fullmatch(r"[^/\\:\0]{1,255}", file_name) or file_name in (".", ".."):
                raise self._error(
                    f"meta.json refers to {file_name[:80]!r}, which is no plain file name; refused"
                )
        return names

    def _numbers(self, section: str, key: str, lengths: tuple[int, ...]) -> np.ndarray:
        return self._checked(self._section(section).get(key), section, key, lengths)

    def _checked(self, value: Any, section: str, key: str, lengths: tuple[int, ...]) -> np.ndarray:
        listed = value if isinstance(value, list) else [value]
        if len(listed) in lengths and all(isinstance(x, (int, float)) and abs(x) < 1e300 for x in listed):
            return np.array(listed, np.float64)
        wanted = " or ".join(map(str, lengths))
        raise self._error(f"{section}.{key} in meta.json must be {wanted} numbers, got {str(value)[:60]}")

    def _range(self, section: str, n: int) -> tuple[np.ndarray, np.ndarray]:
        return self._numbers(section, "mins", (n,)), self._numbers(section, "maxs", (n,))

    def _codebook(self, section: str) -> np.ndarray:
        book = self._section(section).get("codebook")
        if isinstance(book, list) and len(book) == 256 and book[0] is None:
            # Some writers left the first entry empty; PlayCanvas extrapolates it from the others.
            rest = self._checked(book[1:], section, "codebook", (255,))
            numbers = np.concatenate([rest[:1] + (rest[0] - rest[-1]) / 255, rest])
        else:
            numbers = self._checked(book, section, "codebook", (256,))
        return numbers.astype(np.float32)

    def _kernel(self) -> Kernel:
        known: dict[str, Kernel] = {"antialiased": "antialiased", "2dgs": "2dgs"}
        if self._meta.get("antialias") is True:
            return "antialiased"
        return known.get(str(self._meta.get("model")), "3dgs")

    def _note(self) -> dict[str, np.ndarray]:
        """The 'up' and 'origin' of our own files, each (3,)."""
        note = self._meta.get("meshsplats", {})
        if not isinstance(note, dict):
            raise self._error(f"'meshsplats' in meta.json must be an object, got {str(note)[:40]}")
        found = {
            name: self._checked(note[name], "meshsplats", name, (3,))
            for name in ("up", "origin")
            if name in note
        }
        if "up" in found and not found["up"].any():
            raise self._error("meshsplats.up in meta.json must be a direction, got 0 0 0")
        return found

    # -- images

    def _palette(self, data: bytes, section: dict[str, Any], version: int | None) -> np.ndarray:
        """(p, k - 1, 3) harmonics that labels refer to."""
        image = self._image(data, "shN centroids", 1 << 24)
        n = next((c for c in _COEFFICIENTS.values() if c * _PALETTE_COLUMNS == image.shape[1]), 0)
        bands = section.get("bands")  # early files of version 2 have neither bands nor count
        stated = version == 2 and bands is not None
        if not n or (stated and (not isinstance(bands, int) or _COEFFICIENTS.get(bands) != n)):
            raise self._error(
                f"the image of harmonics is {image.shape[1]} pixels wide, which does not fit"
                f" {str(bands)[:20]} bands (192, 512, 960 pixels for 1, 2, 3)"
            )
        entries = image[..., :3].reshape(-1, n, 3)
        if version is None:
            return _between(self._range("shN", 1), entries)
        size = section.get("count", len(entries))
        if not isinstance(size, int) or not 0 <= size <= len(entries):
            raise self._error(f"a palette of {str(size)[:20]} harmonics in an image of {len(entries):,}")
        return self._codebook("shN")[entries[:size]]

    def _pixels(self, data: bytes, name: str, count: int) -> np.ndarray:
        """(count, 4) bytes of the first ``count`` pixels."""
        image = self._image(data, name, 2 * count + (1 << 16))
        if image.shape[0] * image.shape[1] < count:
            raise self._error(
                f"the image of {name} has {image.shape[1]} x {image.shape[0]} pixels, too few for"
                f" {count:,} splats"
            )
        return image.reshape(-1, 4)[:count]

    def _image(self, data: bytes, name: str, most: int) -> np.ndarray:
        """(height, width, 4) RGBA; refuses images of more than ``most`` pixels before unpacking them."""
        from PIL import Image, features

        if data[:4] == b"RIFF" and not features.check("webp"):
            raise MissingDependencyError(
                f"{self._where}: this Pillow was built without WebP, which SOG needs"
            )
        try:
            with warnings.catch_warnings(), Image.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as opened:
                warnings.simplefilter("ignore")  # Pillow warns of large images; the limit below is narrower
                width, height = opened.size
                if width * height > most:
                    raise self._error(
                        f"the image of {name} has {width} x {height} pixels, expected at most {most:,}"
                    )
                self._budget.spend(12 * width * height, f"the image of {name}")
                return np.asarray(opened.convert("RGBA"))
        except FileFormatError:
            raise
        except Exception as error:  # Pillow's decoders raise errors of any type
            raise self._error(
                f"the image of {name} cannot be read: {type(error).__name__} {str(error)[:100]}"
            ) from None


class _Maps(NamedTuple):
    """What the values of pixels mean."""

    positions: tuple[np.ndarray, np.ndarray]
    """Least and largest logarithmic position."""
    ranges: Mapping[str, tuple[np.ndarray, np.ndarray]] = MappingProxyType({})
    """Version 1: least and largest values of scales and sh0."""
    books: Mapping[str, np.ndarray] = MappingProxyType({})
    """Version 2: their codebooks."""


def _fill(
    pixels: dict[str, list[np.ndarray]],
    maps: _Maps,
    palette: np.ndarray,
    index: np.ndarray | None,
    origin: np.ndarray,
    rows: SplatRows,
) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        rows.means[:] = _positions(pixels["means"], maps.positions) - origin
        scales, colors = pixels["scales"][0], pixels["sh0"][0]
        if maps.ranges:
            rows.scales[:] = np.exp(_between(maps.ranges["scales"], scales[:, :3]))
            stored = _between(maps.ranges["sh0"], colors)
            rows.sh[:, 0] = stored[:, :3]
            rows.opacities[:] = 1 / (1 + np.exp(-stored[:, 3]))
        else:
            rows.scales[:] = np.exp(maps.books["scales"])[scales[:, :3]]
            rows.sh[:, 0] = maps.books["sh0"][colors[:, :3]]
            rows.opacities[:] = colors[:, 3] / np.float32(255)
    turns = pixels["quats"][0]
    small = (turns[:, :3] / np.float32(127.5) - 1) / np.float32(np.sqrt(2))
    # The fourth byte is 252 + the index of the largest component; other values leave the quaternion zero.
    rows.quaternions[:] = 0
    decode_smallest_three(rows.quaternions, small, turns[:, 3].astype(np.int32) - 252)
    if index is not None:
        rows.sh[:, 1:] = palette[index]


def _positions(images: Sequence[np.ndarray], ends: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(m, 3) float64 from the lower and upper bytes of (m, 4) pixels; ``ends``: as ``_Maps.positions``."""
    low, high = images
    steps = (low[:, :3] + high[:, :3].astype(np.uint16) * 256) / 65535
    least, most = ends
    logs = least + (most - least) * steps
    with np.errstate(over="ignore", invalid="ignore"):
        return np.sign(logs) * np.expm1(np.abs(logs))


def _between(range_: tuple[np.ndarray, np.ndarray], pixels: np.ndarray) -> np.ndarray:
    least, most = range_
    return (least + (most - least) * (pixels / np.float64(255))).astype(np.float32)


READER = FormatReader(_matches, lambda content, _file, _reading: read_sog(content, Budget(content.path)))
