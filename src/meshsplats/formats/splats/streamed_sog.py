"""Streamed SOG: a folder of SOG parts in several levels of detail, with the index ``lod-meta.json``.

The index is a tree. Each leaf names, level by level, a range of the splats of a part. Level 0 has the most
detail. Specification: developer.playcanvas.com, "The Streamed SOG Format".
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.json_files import can_be_named, json_object
from meshsplats.errors import FileFormatError
from meshsplats.formats._validation import Budget
from meshsplats.formats.content import Content
from meshsplats.formats.opened import Splats
from meshsplats.formats.reading import FormatReader
from meshsplats.formats.splats._cloud_builder import SplatReader, joined_within
from meshsplats.formats.splats.sog import read_sog, sog_corners
from meshsplats.scene.gaussians import GaussianCloud, Kernel
from meshsplats.scene.origin import choose_origin

_MAX_INDEX_BYTES = 64 << 20
_MAX_DEPTH = 64
_PATH = re.compile(r"[^/\\:\0]{1,255}(/[^/\\:\0]{1,255}){0,7}")


class StreamedSog(Splats):
    """The splats of the index ``path`` at the finest level of each leaf, and those of its environment."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def world_sample(self) -> np.ndarray:
        """(2 n, 3) float64: the least and the greatest coordinates of each of the n parts; from their
        meta.json, so that no image is unpacked. Parts that cannot be read are left out: reading them says
        why."""
        found = [np.empty((0, 3))]
        for name in _Index(self._path).parts():
            with suppress(FileFormatError, FileNotFoundError):
                found.append(sog_corners(self._path.parent / name))
        return np.concatenate(found)

    def chosen_origin(self) -> np.ndarray:
        return choose_origin(self.world_sample())

    def read(self, *, strict: bool, origin: np.ndarray | None = None) -> GaussianCloud:
        origin = self.chosen_origin() if origin is None else origin
        budget = Budget(self._path)
        clouds = []
        for name, part, own in self._parts():
            cloud = part.read(strict=strict, origin=origin)
            budget.extend(own.file_bytes)
            budget.spend(4 * (11 + 3 * cloud.sh.shape[1]) * len(cloud), f"the splats of {name!r}")
            clouds.append(cloud)
        return joined_within(clouds, budget)

    def blocks(self, size: int, *, strict: bool, origin: np.ndarray) -> Iterator[GaussianCloud]:
        for _, part, _ in self._parts():
            yield from part.blocks(size, strict=strict, origin=origin)

    def _parts(self) -> Iterator[tuple[str, SplatReader, Budget]]:
        """Name, splats and budget of each part; only one part at a time is in memory."""
        path = self._path
        kernels: set[Kernel] = set()
        for name, ranges in _Index(path).parts().items():
            part = path.parent / name
            if not part.is_file():
                raise FileFormatError(f"{path}: the part {name!r} that it names is missing")
            # Only the splats stay in memory after a part has been read.
            own = Budget(part)
            with Content(part) as content:
                reader = read_sog(content, own, ranges)
            kernels.add(reader.kernel)
            if len(kernels) > 1:
                raise FileFormatError(
                    f"{path}: its parts are of several kinds of splats: {', '.join(sorted(kernels))}"
                )
            yield name, reader, own
        if not kernels:
            raise FileFormatError(f"{path}: no splats, its tree has none")


class _Index:
    """lod-meta.json; only what is read is checked."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with open(path, "rb") as file:
            raw = file.read(_MAX_INDEX_BYTES + 1)
        self._document = json_object(raw, _MAX_INDEX_BYTES, path)
        version = self._document.get("version", 1)
        if version != 1:
            raise self._error(f"streamed SOG of version {str(version)[:20]}, known is 1")

    def parts(self) -> dict[str, list[tuple[int, int]] | None]:
        """Ranges of splats to read (first, end), None for all, by the part's path beside the index."""
        names = self._document.get("filenames")
        if not isinstance(names, list):
            raise self._error(f"'filenames' must be a list, got {str(names)[:60]}")
        found: dict[str, list[tuple[int, int]] | None] = {}
        for number, first, end in self._finest():
            if number >= len(names):
                raise self._error(f"its tree names part {number}, but there are {len(names)}")
            if end > first:
                ranges = found.setdefault(self._checked(names[number]), [])
                assert ranges is not None  # only the environment has none
                ranges.append((first, end))
        if (environment := self._document.get("environment")) is not None:
            found[self._checked(environment)] = None
        return found

    def _finest(self) -> list[tuple[int, int, int]]:
        """Index of the part, first and end of its splats, leaf by leaf."""
        found = []
        stack: list[tuple[Any, int]] = [(self._document.get("tree"), 0)]
        while stack:
            node, depth = stack.pop()
            levels, children = (node.get("lods"), node.get("children")) if isinstance(node, dict) else (0, 0)
            if isinstance(levels, dict) and levels:
                found.append(self._entry(levels))
            elif isinstance(children, list) and depth < _MAX_DEPTH:
                stack += [(child, depth + 1) for child in reversed(children)]
            else:
                raise self._error(f"a node of its tree has neither 'lods' nor 'children': {str(node)[:60]}")
        return found

    def _entry(self, levels: dict[str, Any]) -> tuple[int, int, int]:
        if not all(re.fullmatch("[0-9]{1,6}", level) for level in levels):
            raise self._error(f"levels must be numbers, got {', '.join(levels)[:60]}")
        entry = levels[min(levels, key=int)]
        if not isinstance(entry, dict):
            raise self._error(f"a level must be an object, got {str(entry)[:80]}")

        def number(key: str) -> int:
            value = entry.get(key)
            if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 40:
                return value
            raise self._error(f"{key!r} of a level must be a whole number, got {str(value)[:40]}")

        first = number("offset")
        return number("file"), first, first + number("count")

    def _checked(self, name: Any) -> str:
        """``name`` if it is a path below the folder of the index, on any system; else FileFormatError."""
        plain = isinstance(name, str) and _PATH.fullmatch(name)
        if (
            not plain
            or any(step in (".", "..") for step in name.split("/"))
            or not can_be_named(self._path.parent / name)
        ):
            raise self._error(f"it refers to {str(name)[:80]!r}, which is no path below its folder; refused")
        return name

    def _error(self, message: str) -> FileFormatError:
        return FileFormatError(f"{self._path}: {message}")


READER = FormatReader(
    lambda content: b'"lodLevels"' in content.json_text,
    lambda content, _file, _reading: StreamedSog(content.path),
)
