"""tileset.json of 3D Tiles from strangers: what it names and its numbers are checked, its tiles are limited.
Errors begin with the name of the file."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from meshsplats._common.json_files import can_be_named, json_object
from meshsplats.errors import FileFormatError

MAX_BYTES = 64 << 20
MAX_TILES = 1 << 22
MAX_DEPTH = 64
LARGEST = 1e39
"""Numbers are smaller: what is beyond float32 is no place of a tile."""
_PLAIN = re.compile(r"[^/\\:\0?#]{1,255}(/[^/\\:\0?#]{1,255}){0,15}")


def read_tileset(path: Path, versions: Sequence[str]) -> dict[str, Any]:
    """The document in the file ``path``, which is of one of the ``versions`` of 3D Tiles."""
    with open(path, "rb") as file:
        document = json_object(file.read(MAX_BYTES + 1), MAX_BYTES, path)
    if not isinstance(document.get("asset"), dict):
        raise FileFormatError(f"{path}: no tileset file: it has no object 'asset'")
    version = document["asset"].get("version")
    if version not in versions:
        known = f"{' and '.join(versions)} {'is' if len(versions) == 1 else 'are'} read"
        raise FileFormatError(f"{path}: 3D Tiles of version {str(version)[:20]!r}; {known}")
    return document


def check_tree(depth: int, count: int, file: Path) -> None:
    """FileFormatError for a tile of ``file`` so deep in the tree, or after so many."""
    if depth > MAX_DEPTH or count > MAX_TILES:
        limits = f"{MAX_DEPTH} levels and {MAX_TILES:,} tiles"
        raise FileFormatError(f"{file}: tiles are nested too deeply, or too many: {limits} are read")


def entry_of(path: Path) -> str:
    """``path``, which is read once, by its real folder: links to folders lead to one file by endless names.
    Those to files are kept apart, as caches of downloads keep files that are alike as links to one."""
    return os.path.join(os.path.realpath(path.parent), path.name)


def object_in(owner: dict[str, Any], key: str, file: Path, kind: type = dict) -> Any:
    """The object, or the text for ``kind`` str, that ``owner`` has of that name."""
    value = owner.get(key)
    if not isinstance(value, kind):
        what = "a text" if kind is str else "an object"
        raise FileFormatError(f"{file}: {key!r} must be {what}, got {str(value)[:40]}")
    return value


def objects_in(tile: dict[str, Any], key: str, file: Path) -> list[dict[str, Any]]:
    """The list of objects that ``tile`` has of that name; none if it has none."""
    found = tile.get(key, [])
    if not isinstance(found, list) or not all(isinstance(x, dict) for x in found):
        raise FileFormatError(f"{file}: {key} of a tile must be a list of objects")
    return found


def is_number(value: object) -> bool:
    """Whether ``value`` is a finite number; true and false are none."""
    if isinstance(value, float):
        return math.isfinite(value)
    return isinstance(value, int) and not isinstance(value, bool)  # of any length


def numbers(value: object, length: int, what: str, file: Path) -> np.ndarray:
    """(length,) float64 of a list."""
    listed: list[Any] = value if isinstance(value, list) else []
    if len(listed) != length or not all(is_number(x) and abs(x) < LARGEST for x in listed):
        raise FileFormatError(f"{file}: {what} must be {length} numbers, got {str(value)[:60]}")
    return np.array(listed, np.float64)


def file_below(file: Path, uri: str) -> Path:
    """The file that ``uri`` in ``file`` names, if it is a plain path below the folder of ``file``."""
    plain = unquote(uri)
    steps = [step for step in plain.split("/") if step != "."]
    path = file.parent.joinpath(*steps)
    if not _PLAIN.fullmatch(plain) or ".." in steps or not can_be_named(path):
        raise FileFormatError(
            f"{file}: it refers to {uri[:80]!r}, which is no path below its folder; refused"
        )
    return path
