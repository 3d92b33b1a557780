"""Bare photographs before their cameras are found: which are whole, by which lens each was taken, and files
that pycolmap reads."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.images.reading import Shot, load_image, read_exif, read_shot

NATIVE = ("JPEG", "MPO", "PNG", "BMP", "TIFF")
"""Formats that pycolmap reads in all its versions, as Pillow names them."""
COPIED_AT_ONCE = 4
"""Photographs that are copied at the same time, at most: one of 48 million pixels takes half a gigabyte."""
MOST_EXIF = 65_000
"""Bytes of EXIF data that a JPEG can hold."""


def read_shots(photographs: Sequence[Path], threads: int) -> tuple[dict[Path, Shot], dict[Path, str]]:
    """How each of ``photographs`` was taken, in their order, and what is wrong with those that are broken."""

    def read(path: Path) -> Shot | str:
        try:
            return read_shot(path)
        except FileFormatError as error:
            return str(error)

    with ThreadPoolExecutor(threads) as pool:
        found = dict(zip(photographs, pool.map(read, photographs), strict=True))
    whole = {path: shot for path, shot in found.items() if isinstance(shot, Shot)}
    return whole, {path: reason for path, reason in found.items() if isinstance(reason, str)}


def by_lens(shots: Sequence[Shot]) -> tuple[list[list[int]], list[int]]:
    """The places of ``shots`` that share a lens, of each lens that several have, and of those that have one
    alone: photographs of one size, by one camera and lens, at one focal length and digital zoom."""
    groups: dict[object, list[int]] = {}
    for i, shot in enumerate(shots):
        groups.setdefault((shot.size, shot.lens), []).append(i)
    return [group for group in groups.values() if len(group) > 1], [
        group[0] for group in groups.values() if len(group) == 1
    ]


def needs_copy(shot: Shot) -> bool:
    """Whether pycolmap may not read the format of the photograph."""
    return shot.format not in NATIVE


def for_pycolmap(shots: dict[Path, Shot], work: Path, threads: int) -> list[Path]:
    """Files that pycolmap reads, in one folder, one for each photograph of ``shots``: themselves, or in the
    folder ``work`` copies of those in formats that it may not read, and links where names have blanks, which
    its lists of pairs do not allow."""
    if all(
        not needs_copy(shot) and " " not in path.name and not path.name.startswith("#")
        for path, shot in shots.items()
    ):
        return list(shots)
    folder = work / "images"
    folder.mkdir()

    def made(i: int, path: Path, shot: Shot) -> Path:
        if needs_copy(shot):
            return _copied(path, folder / f"{i:06d}.jpg")
        file = folder / f"{i:06d}{path.suffix}"
        for link in (os.symlink, os.link):  # Windows lets only some users make the first kind
            with suppress(OSError):
                link(path.absolute(), file)
                return file
        shutil.copyfile(path, file)
        return file

    with ThreadPoolExecutor(min(threads, COPIED_AT_ONCE)) as pool:
        return list(pool.map(made, range(len(shots)), shots, shots.values()))


def _copied(path: Path, file: Path) -> Path:
    """``file``, a JPEG of the photograph at ``path`` with its EXIF data, which has the focal length."""
    from PIL import Image

    exif = read_exif(path)
    pixels = np.ascontiguousarray(load_image(path)[..., :3])
    Image.fromarray(pixels).save(file, quality=95, exif=exif if len(exif) < MOST_EXIF else b"")
    return file
