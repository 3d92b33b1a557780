"""Bare photographs before their cameras are found: which are whole, by which lens each was taken, and files
that pycolmap reads."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from meshsplats.errors import FileFormatError
from meshsplats.images.reading import Shot, load_image, read_exif, read_shot

NATIVE = ("JPEG", "MPO", "PNG", "BMP", "TIFF")
"""Formats that pycolmap reads in all its versions, as Pillow names them."""


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
    alone: photographs of one size, by one camera, at one focal length."""
    groups: dict[tuple[object, ...], list[int]] = {}
    for i, shot in enumerate(shots):
        groups.setdefault((shot.size, shot.camera, shot.focal), []).append(i)
    return [group for group in groups.values() if len(group) > 1], [
        group[0] for group in groups.values() if len(group) == 1
    ]


def for_pycolmap(shots: dict[Path, Shot], work: Path) -> list[Path]:
    """Files that pycolmap reads, in one folder, one for each photograph of ``shots``: themselves, or in the
    folder ``work`` copies of those in formats that it may not read, and links where names have blanks, which
    its lists of pairs do not allow."""
    if all(
        shot.format in NATIVE and " " not in path.name and not path.name.startswith("#")
        for path, shot in shots.items()
    ):
        return list(shots)
    from PIL import Image

    folder = work / "images"
    folder.mkdir()
    files = []
    for i, (path, shot) in enumerate(shots.items()):
        native = shot.format in NATIVE
        file = folder / f"{i:06d}{path.suffix if native else '.png'}"
        files.append(file)
        if not native:
            pixels = load_image(path)
            Image.fromarray(pixels[..., :3]).save(file, exif=read_exif(path), compress_level=1)
            continue
        try:
            file.symlink_to(path.absolute())
        except OSError:  # Windows lets only some users make links
            shutil.copyfile(path, file)
    return files
