"""What a run of ``build_tiles`` is about: noted when it begins, compared when it is resumed."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from meshsplats import __version__
from meshsplats._common.json_files import read_json
from meshsplats._common.words import plural
from meshsplats.errors import DataWarning, FileFormatError, OverwritingError
from meshsplats.formats.splat_paths import subject_name
from meshsplats.formats.streaming import SplatStream
from meshsplats.scene.origin import in_words
from meshsplats.tiles.options import TileOptions
from meshsplats.tiles.tileset import is_tile_file

_NAMING = (".json", ".gltf", ".lcc")
"""Suffixes of documents beside whose files the splats are."""
_UNNAMED = ("index.bin", "data.bin", "shcoef.bin")
"""Files of an LCC scene, which its document does not name."""
_MAX_BYTES = 1 << 30


def need_each_once(paths: Sequence[Path]) -> None:
    """ValueError if two of ``paths`` are one file."""
    seen: dict[str, Path] = {}
    for path in paths:
        other = seen.setdefault(os.path.realpath(path), path)
        if other is not path:
            names = f"{path} is given twice" if other == path else f"{other} and {path} are one file"
            raise ValueError(f"{names}: its splats would be there twice; give it once")


def need_other_folder(paths: Sequence[Path], folder: Path) -> None:
    """OverwritingError if one of ``paths`` is of the tileset ``folder``: what else lies there stays."""
    root = Path(os.path.realpath(folder))
    for path in paths:
        real = Path(os.path.realpath(path))
        if real.is_relative_to(root) and is_tile_file(real.relative_to(root).as_posix()):
            raise OverwritingError(f"{path} is read, and a part of the tileset {folder}: give another folder")


def warn_of_copies(source: SplatStream) -> None:
    """A DataWarning for files of one name and folder, in different formats, with splats in the same places:
    one scene, which a folder of files has twice."""
    seen: dict[tuple[Path, str], list[Path]] = {}
    for path in source.paths:
        alike = seen.setdefault((path.parent, subject_name(path)), [])
        same = (one for one in alike if _in_one_place(source.world_samples[one], source.world_samples[path]))
        other = next(same, None)
        alike.append(path)
        if other is not None:
            warnings.warn(
                f"{other} and {path} look like one scene in two formats: the tiles have the splats of both;"
                " name the one to take",
                DataWarning,
                stacklevel=3,
            )


def _in_one_place(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two samples (n, 3) of positions are spread in the same way, but for chance."""
    finite = [part[np.isfinite(part).all(axis=1)] for part in (one, other)]
    if not all(map(len, finite)):
        return False
    first, second = (np.quantile(part, (0.1, 0.5, 0.9), axis=0) for part in finite)
    return bool((np.abs(first - second) <= 0.05 * np.linalg.norm(first[2] - first[0])).all())


def start_facts(source: SplatStream, options: TileOptions) -> dict[str, Any]:
    """What the tiles depend on, for JSON."""
    axes, strict, *more = source.reading
    given = json.loads(json.dumps(asdict(options)))
    given = (given.pop("conversion") or {}) | given  # max_triangles is of tiles
    return {
        "version": __version__,
        "files": [_state(path) for path in source.paths],
        "reading": {"axes": axes, "strict": strict, **(more[0] if more else {})},
        "options": {name: value for name, value in given.items() if value is not None},
        "origin": source.origin.tolist(),
    }


def need_same_start(before: Mapping[str, Any], now: Mapping[str, Any], folder: Path) -> None:
    """FileFormatError, which says what differs, unless the unfinished run in ``folder`` with the facts
    ``before`` is the one of ``now``."""
    if before.get("version") != now["version"]:
        raise FileFormatError(
            f"{folder} was begun by MeshSplats {before.get('version', 'of an earlier version')}, this is"
            f" {now['version']}: tiles of both would be mixed; ``resume`` with the version that began, or"
            " begin again with ``replace_old``"
        )
    for name, value in now.items():
        if before.get(name) != value:
            raise FileFormatError(
                f"{folder} was started with other {name}: {_difference(name, before.get(name), value)};"
                " ``resume`` with the same, or begin again with ``replace_old``"
            )


def _difference(name: str, old: Any, new: Any) -> str:
    """How two facts of one ``name`` differ, in words."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = [key for key in dict.fromkeys((*new, *old)) if old.get(key) != new.get(key)]
        # A place is no option of commands, which say it by that of the origin.
        shown = {key: key if key == "place" else f"``{key}``" for key in keys}
        return ", ".join(f"{shown[key]} {_shown(old.get(key))}, not {_shown(new.get(key))}" for key in keys)
    if name == "origin" and isinstance(old, list):
        return f"{in_words(map(float, old))}, not {in_words(new)}"
    if name == "files" and isinstance(old, list):
        if len(old) != len(new):
            return f"{plural(len(old), 'file')}, not {len(new):,}"
        was, is_now = next(pair for pair in zip(old, new, strict=True) if pair[0] != pair[1])
        if was[:1] != is_now[:1]:
            return f"{was[0]}, not {is_now[0]}"
        return f"{is_now[0]} has changed" + (", or a file beside it" if is_now[3] else "")
    return f"{_shown(old)}, not {_shown(new)}"


def _shown(value: Any) -> str:
    """The value of an option in words."""
    if value is None:
        return "not given"
    values = value if isinstance(value, list) else [value]
    return " ".join(f"{x:.10g}" if isinstance(x, float) else str(x)[:80] for x in values)


def _state(path: Path) -> list[Any]:
    """Path, size and time of a file, and a digest of those of the files that it names; empty without any."""
    found = os.stat(path)
    beside = [[str(file), os.stat(file).st_size, os.stat(file).st_mtime_ns] for file in _named_by(path)]
    digest = hashlib.sha256(json.dumps(sorted(beside)).encode()).hexdigest()[:16] if beside else ""
    return [str(path), found.st_size, found.st_mtime_ns, digest]


def _named_by(path: Path) -> set[Path]:
    """The files below the folder of ``path`` that it names, and those that they name."""
    found: set[Path] = set()
    todo = [path]
    while todo:
        document = todo.pop()
        if document.suffix.lower() not in _NAMING:
            continue
        try:
            names = {*_UNNAMED, *_texts(read_json(document, _MAX_BYTES))}
        except FileFormatError:  # of another format than its name says
            continue
        files = {document.parent / unquote(name) for name in names if 0 < len(name) < 1024}
        new = {file for file in files if os.path.isfile(file)} - found - {path}
        found |= new
        todo += new
    return found


def _texts(document: Any) -> Iterator[str]:
    """All texts in a JSON document."""
    todo = [document]
    while todo:
        value = todo.pop()
        if isinstance(value, str):
            yield value
        elif isinstance(value, (list, dict)):
            todo += value.values() if isinstance(value, dict) else value
