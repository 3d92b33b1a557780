"""COLMAP's sparse models: ``cameras`` and ``images``, binary or text. Points are only counted.

Specification: colmap.github.io/format.html; the binary layout as in src/colmap/scene/reconstruction_io.
"""

from __future__ import annotations

import math
import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np

from meshsplats._common.choices import MAX_SIDE
from meshsplats._common.geometry import rotation_rows
from meshsplats.datasets.image_files import MAX_NAME, Frame
from meshsplats.datasets.lens import MODELS, Lens
from meshsplats.errors import FileFormatError

MAX_FRAMES = 200_000
"""More cameras or images than this are refused."""
MODEL_FILES = tuple(
    name + suffix for name in ("cameras", "images", "points3D") for suffix in (".bin", ".txt")
)
_MODEL_NAMES = list(MODELS)
_BOM = b"\xef\xbb\xbf"
"""Begins text files of some programs for Windows."""
_LONGEST_IMAGE_LINE = 4 * MAX_NAME + 400
"""Bytes that suffice for the line of an image."""
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT_BYTES = 24
_LEAST_POINT = 43
"""Bytes of a point in three dimensions without the images that see it."""


def find_model(folder: Path, places: tuple[str, ...]) -> Path | None:
    """The first of ``places`` in ``folder`` that holds a sparse model, binary or text."""
    for place in places:
        for suffix in (".bin", ".txt"):
            if all((folder / place / (name + suffix)).is_file() for name in ("cameras", "images")):
                return folder / place
    return None


def read_model(model: Path, images: str) -> list[Frame]:
    """The images of a sparse model, sorted by name; their files lie in the folder ``images``; if it is empty,
    in that of the data set itself.

    Raises FileFormatError, which names file and record, for what is broken.
    """
    if _is_binary(model):
        lenses = _binary_cameras(model / "cameras.bin")
        frames = _binary_images(model / "images.bin", lenses, images)
    else:
        lenses = _text_cameras(model / "cameras.txt")
        frames = _text_images(model / "images.txt", lenses, images)
    frames.sort(key=lambda frame: frame.name)
    for before, after in pairwise(frames):
        if before.name == after.name:
            raise FileFormatError(f"{model}: two images have the name {after.name[:200]!r}")
    return frames


def image_names(model: Path) -> list[str]:
    """The names of the images of a sparse model, in the order of the file. Raises FileFormatError for what is
    broken."""
    if _is_binary(model):
        return [name for _, name, *_ in _binary_records(model / "images.bin")]
    return [name for _, name, *_ in _text_records(model / "images.txt")]


def _is_binary(model: Path) -> bool:
    return (model / "cameras.bin").is_file() and (model / "images.bin").is_file()


def count_points(model: Path) -> int | None:
    """Number of points of a sparse model; None if it has none, or if the file is too short for it."""
    binary, text = model / "points3D.bin", model / "points3D.txt"
    if binary.is_file():
        with open(binary, "rb") as file:
            count = int.from_bytes(file.read(8), "little")
        return count if count * _LEAST_POINT <= binary.stat().st_size - 8 else None
    if text.is_file():
        with open(text, "rb") as file:
            return sum(1 for line in file if line.strip() and not line.startswith(b"#"))
    return None


# ---- Binary


@contextmanager
def _mapped(path: Path) -> Iterator[_Bytes]:
    with open(path, "rb") as file:
        try:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except ValueError:
            raise FileFormatError(f"{path}: the file is empty") from None
        with mapped:
            yield _Bytes(mapped, path)


class _Bytes:
    """A file read in order; nothing of it is in memory but what was asked for."""

    def __init__(self, data: mmap.mmap, path: Path) -> None:
        self._data, self._path, self._at = data, path, 0

    def unpack(self, layout: struct.Struct, what: str) -> tuple[Any, ...]:
        self._need(layout.size, what)
        values = layout.unpack_from(self._data, self._at)
        self._at += layout.size
        return values

    def count(self, least_bytes: int, what: str) -> int:
        """A count of records of at least ``least_bytes`` each, checked against the remaining bytes."""
        (count,) = self.unpack(struct.Struct("<Q"), f"the number of {what}")
        left = len(self._data) - self._at
        if count * least_bytes > left:
            raise FileFormatError(
                f"{self._path}: says it holds {count:,} {what}, but only {left:,} bytes follow (truncated, or"
                " not a file of COLMAP?)"
            )
        if count > MAX_FRAMES:
            raise FileFormatError(f"{self._path}: {count:,} {what}, more than the {MAX_FRAMES:,} accepted")
        return count

    def text(self, what: str) -> str:
        """Text up to a zero byte."""
        end = self._data.find(b"\0", self._at, self._at + MAX_NAME + 1)
        if end < 0:
            raise FileFormatError(f"{self._path}: {what} does not end within {MAX_NAME} bytes")
        raw = self._data[self._at : end]
        self._at = end + 1
        return _decoded(raw, self._path, what)

    def skip(self, count: int, what: str) -> None:
        self._need(count, what)
        self._at += count

    def _need(self, count: int, what: str) -> None:
        if self._at + count > len(self._data):
            raise FileFormatError(f"{self._path}: ends within {what} (truncated?)")


def _binary_cameras(path: Path) -> dict[int, Lens]:
    lenses = {}
    with _mapped(path) as data:
        for i in range(data.count(_CAMERA.size + 16, "cameras")):
            what = f"camera {i}"
            number, model, width, height = data.unpack(_CAMERA, what)
            if not 0 <= model < len(_MODEL_NAMES):
                raise FileFormatError(
                    f"{path}: {what} has model number {model}; known are 0 to {len(_MODEL_NAMES) - 1}"
                )
            layout = struct.Struct(f"<{MODELS[_MODEL_NAMES[model]].parameters}d")
            values = data.unpack(layout, what)
            lenses[number] = _lens(_MODEL_NAMES[model], width, height, values, f"{path}: {what}")
    return lenses


def _binary_images(path: Path, lenses: dict[int, Lens], images: str) -> list[Frame]:
    return [
        _frame(name, pose, camera, lenses, images, f"{path}: {what} ({name[:60]!r})")
        for what, name, pose, camera in _binary_records(path)
    ]


def _binary_records(path: Path) -> Iterator[tuple[str, str, list[float], int]]:
    """Of each image: what to call it in messages, its name, its pose and the number of its camera."""
    with _mapped(path) as data:
        for i in range(data.count(_IMAGE.size + 9, "images")):
            what = f"image {i}"
            _, *pose, camera = data.unpack(_IMAGE, what)
            name = data.text(f"the name of {what}")
            (points,) = data.unpack(struct.Struct("<Q"), what)
            data.skip(points * _POINT_BYTES, f"the points of {what}")
            yield what, name, pose, camera


# ---- Text


def _lines(file: IO[bytes]) -> Iterator[bytes]:
    """Lines of up to 64 KiB; what a line has beyond that, thousands of points, is dropped."""
    if file.read(len(_BOM)) != _BOM:
        file.seek(0)
    while line := file.readline(1 << 16):
        rest = line
        while not rest.endswith(b"\n") and (rest := file.readline(1 << 16)):
            pass
        yield line.strip()


def _text_cameras(path: Path) -> dict[int, Lens]:
    lenses: dict[int, Lens] = {}
    with open(path, "rb") as file:
        for row, line in enumerate(_lines(file), 1):
            if not line or line.startswith(b"#"):
                continue
            where = f"{path}: line {row}"
            words = line.split()
            if len(words) < 4:
                raise FileFormatError(f"{where}: a camera is 'ID MODEL WIDTH HEIGHT PARAMETERS'")
            number, width, height = (_whole(words[k], where) for k in (0, 2, 3))
            model = _decoded(words[1], path, f"line {row}")
            lenses[number] = _lens(model, width, height, _floats(words[4:], where), where)
            if len(lenses) > MAX_FRAMES:
                raise FileFormatError(f"{path}: more than {MAX_FRAMES:,} cameras")
    return lenses


def _text_images(path: Path, lenses: dict[int, Lens], images: str) -> list[Frame]:
    return [
        _frame(name, pose, camera, lenses, images, where) for where, name, pose, camera in _text_records(path)
    ]


def _text_records(path: Path) -> Iterator[tuple[str, str, list[float], int]]:
    """Of each image: how messages about it begin, its name, its pose and the number of its camera.

    The line of an image is followed by one of its points, which may be blank. Some programs leave it out.
    """
    count, points_due = 0, False
    with open(path, "rb") as file:
        for row, line in enumerate(_lines(file), 1):
            if line.startswith(b"#"):
                continue
            if not line or (points_due and not _is_image_line(line)):
                points_due = False
                continue
            where = f"{path}: line {row}"
            words = line.split(None, 9)
            if len(words) < 10:
                raise FileFormatError(
                    f"{where}: an image is 'ID QW QX QY QZ TX TY TZ CAMERA NAME', then a line of points"
                )
            name = _decoded(words[9], path, f"line {row}")
            count, points_due = count + 1, True
            if count > MAX_FRAMES:
                raise FileFormatError(f"{path}: more than {MAX_FRAMES:,} images")
            yield where, name, list(_floats(words[1:8], where)), _whole(words[8], where)


def _is_image_line(line: bytes) -> bool:
    """Whether a line is that of an image, where points may be expected. Points are numbers, three for each;
    an image has ten words, the last of them a name, which may be a number or contain blanks."""
    if len(line) > _LONGEST_IMAGE_LINE:
        return False
    words = line.split()
    if len(words) < 10 or not (words[0].isdigit() and words[8].isdigit()):
        return False
    return len(words) == 10 or not all(map(_is_number, words[9:]))


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _decoded(raw: bytes, path: Path, what: str) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: {what} is not UTF-8 text") from None


def _whole(word: bytes, where: str) -> int:
    if not (word.isdigit() and len(word) < 19):
        raise FileFormatError(f"{where}: expected a whole number, got {word[:40]!r}")
    return int(word)


def _floats(words: list[bytes], where: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words)
    except ValueError:
        shown = b" ".join(words)[:60]
        raise FileFormatError(f"{where}: expected numbers, got {shown!r}") from None


# ---- Both


def _lens(model: str, width: int, height: int, parameters: tuple[float, ...], where: str) -> Lens:
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise FileFormatError(
            f"{where}: an image of {width} x {height} pixels; sides go from 1 to {MAX_SIDE}"
        )
    try:
        return Lens.from_colmap(model, width, height, parameters)
    except ValueError as error:
        raise FileFormatError(f"{where}: {error}") from None


def _frame(
    name: str, pose: list[float], camera: int, lenses: dict[int, Lens], images: str, where: str
) -> Frame:
    if camera not in lenses:
        raise FileFormatError(f"{where}: refers to camera {camera}, which the model does not have")
    length = math.hypot(*pose[:4])
    if not (all(map(math.isfinite, pose)) and 1e-6 < length < 1e6):
        raise FileFormatError(f"{where}: its pose is no rotation and translation: {pose}")
    w, x, y, z = (q / length for q in pose[:4])
    matrix = np.eye(4)
    matrix[:3, :3] = list(rotation_rows(w, x, y, z))
    matrix[:3, 3] = pose[4:7]
    return Frame(name, f"{images}/{name}" if images else name, lenses[camera], matrix)
