"""Tilesets of splats: 3D Tiles whose tiles are glTF with KHR_gaussian_splatting. The finest tiles are read.

A tileset is a tree of boxes. Children replace the content of their tile (REPLACE) or add to it (ADD); a tile
may be another tileset file. Tiles are glTF with y up, which viewers turn to the z up of tilesets, and each
tile moves all below it. Tilesets on the globe are in metres from its centre. Specification:
https://docs.ogc.org/cs/22-025r4/22-025r4.html.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from meshsplats._common.geometry import away_from_ground
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats._orientation import Y_DOWN_FROM_Z_UP, Z_UP_FROM_Y_UP, tile_frame
from meshsplats.formats._validation import Budget
from meshsplats.formats.content import Content
from meshsplats.formats.gltf.splats import names_splats, placed_clouds, splat_document
from meshsplats.formats.gltf.tileset_file import (
    check_tree,
    entry_of,
    file_below,
    numbers,
    object_in,
    objects_in,
    read_tileset,
)
from meshsplats.formats.opened import Splats
from meshsplats.formats.reading import FormatReader
from meshsplats.formats.splats._cloud_builder import joined_within
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.origin import choose_origin, sampled

_TO_Z_UP = np.eye(4)
_TO_Z_UP[:3, :3] = Z_UP_FROM_Y_UP
_LOOKED_AT = 8
"""Tiles that tell whether a tileset is one of splats."""
_LEGACY = {b"b3dm", b"i3dm", b"pnts", b"cmpt", b"subt"}


class _Tile(NamedTuple):
    """A glTF file of the tree."""

    path: Path
    matrix: np.ndarray
    """(4, 4) float64 from its frame to the tileset's."""


def axes_of(value: object, path: Path) -> np.ndarray:
    """(3, 3) float64 turn from the axes of a globe to those of the world, of the note of a tileset."""
    rows = value if isinstance(value, list) else []
    axes = np.array([numbers(row, 3, "a row of the axes", path) for row in rows])
    if axes.shape != (3, 3) or not np.abs(axes @ axes.T - np.eye(3)).max() < 1e-6:
        raise FileFormatError(f"{path}: the axes must be a rotation, 3 rows of 3 numbers")
    return axes


class _Tree:
    """The finest tiles of the tileset file ``path``, depth first. Errors name the file that is wrong."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read: set[str] = set()
        self._count = 0
        document = self._document(path)
        self.root = self._root(document, path)
        extras = document.get("extras")
        note = extras.get("meshsplats") if isinstance(extras, dict) else None
        self.own_up: np.ndarray | None = None
        """(3,) float64 direction that points up in the world of a tileset of ``meshsplats tiles``."""
        self.own_axes: np.ndarray | None = None
        """(3, 3) float64 from its frame to that world."""
        self.of_meshes = note is not None
        if isinstance(note, dict) and note.get("contents") == "splats":
            self.of_meshes = False
            self.own_up = numbers(note.get("up"), 3, "the up direction", path)
            if not self.own_up.any():
                raise FileFormatError(f"{path}: the up direction must not be 0")
            self.own_axes = axes_of(note["axes"], path) if "axes" in note else tile_frame(self.own_up).T

    def tiles(self) -> list[_Tile]:
        return self._below(self.root, self._path, np.eye(4), "", 0)

    def up(self) -> np.ndarray:
        """(3,) float64: z, or away from the ground for a tileset of others on the globe."""
        if self.own_up is not None and self.own_axes is not None:
            return np.asarray(self.own_axes.T @ (self.own_up / np.linalg.norm(self.own_up)))
        tile = self.root
        volume = object_in(tile, "boundingVolume", self._path)
        if isinstance(region := volume.get("region"), list):
            west, south, east, north, *_ = numbers(region, 6, "a region", self._path)
            east += 2 * np.pi if east < west else 0  # across the date line
            longitude, latitude = (west + east) / 2, (south + north) / 2
            flat = np.cos(latitude)
            return np.array([flat * np.cos(longitude), flat * np.sin(longitude), np.sin(latitude)])
        name, length = ("sphere", 4) if "sphere" in volume else ("box", 12)
        center = numbers(volume.get(name), length, f"a {name}", self._path)[:3]
        place = (self._matrix(tile, self._path) @ [*center, 1])[:3]
        away = away_from_ground(place)
        return np.array([0.0, 0, 1]) if away is None else away

    def _below(
        self, tile: dict[str, Any], file: Path, matrix: np.ndarray, refine: str, depth: int
    ) -> list[_Tile]:
        """The finest tiles at or below ``tile`` of ``file``, whose parent has this matrix and refinement."""
        self._count += 1
        check_tree(depth, self._count, file)
        if "implicitTiling" in tile:
            raise FileFormatError(f"{file}: implicit tiling is not read: list the tiles in the file")
        refine = str(tile.get("refine", refine)).upper()
        if refine not in ("ADD", "REPLACE"):
            raise FileFormatError(f"{file}: refine must be ADD or REPLACE, got {refine[:20]!r}")
        matrix = matrix @ self._matrix(tile, file)
        own, below = [], []
        for content in self._contents(tile, file):
            path = file_below(file, object_in(content, "uri", file, str))
            if self._is_tileset(path, file):
                below += self._below(self._root(self._document(path), path), path, matrix, refine, depth + 1)
            else:
                own.append(_Tile(path, matrix @ _TO_Z_UP))
        for child in objects_in(tile, "children", file):
            below += self._below(child, file, matrix, refine, depth + 1)
        return own + below if refine == "ADD" or not below else below

    def _contents(self, tile: dict[str, Any], file: Path) -> list[dict[str, Any]]:
        if "content" in tile:
            return [object_in(tile, "content", file)]
        return objects_in(tile, "contents", file)

    def _document(self, path: Path) -> dict[str, Any]:
        """A tileset file, which is read once."""
        self._once(path)
        return read_tileset(path, ("1.0", "1.1"))

    def _root(self, document: dict[str, Any], path: Path) -> dict[str, Any]:
        found: dict[str, Any] = object_in(document, "root", path)
        return found

    def _is_tileset(self, path: Path, file: Path) -> bool:
        """Whether the content ``path`` of a tile of ``file`` is another tileset file, not glTF."""
        if not path.is_file():
            raise FileFormatError(f"{file}: the tile {path.name!r} that it names is missing")
        with open(path, "rb") as opened:
            head = opened.read(4)
        if head in _LEGACY:
            raise FileFormatError(
                f"{file}: the tile {path.name!r} is of the kind {head.decode()}, which is not read; tiles of"
                " splats are glTF"
            )
        if head != b"glTF" and path.suffix.lower() == ".json":
            return True
        self._once(path)
        return False

    def _once(self, path: Path) -> None:
        entry = entry_of(path)
        if entry in self._read:
            raise FileFormatError(f"{self._path}: its tree names {path.name!r} twice; a tile is read once")
        self._read.add(entry)

    def _matrix(self, tile: dict[str, Any], file: Path) -> np.ndarray:
        if "transform" not in tile:
            return np.eye(4)
        matrix = numbers(tile["transform"], 16, "a transform", file).reshape(4, 4).T
        if (matrix[3] != (0, 0, 0, 1)).any():
            raise FileFormatError(f"{file}: a transform must end in 0 0 0 1 by rows, got {matrix[3]}")
        return matrix


class SplatTileset(Splats):
    """The splats of the finest tiles of the tileset file ``path``; one tile at a time is in memory, but for
    ``read``. Tiles without splats are left out, with a DataWarning."""

    def __init__(self, path: Path) -> None:
        self._path = path
        tree = _Tree(path)
        if tree.of_meshes:
            raise FileFormatError(f"{path}: a tileset, not splats; render and info take it")
        self._tiles = tree.tiles()
        self.up = tree.up()
        if tree.own_axes is not None:
            self.to_y_down = tree.own_axes

    @cached_property
    def _sample(self) -> np.ndarray:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they come when the tiles are read
            return np.concatenate([_sample(cloud, matrix) for cloud, matrix in self._placed(strict=False)])

    def world_sample(self) -> np.ndarray:
        return self._sample

    def chosen_origin(self) -> np.ndarray:
        return choose_origin(self._sample)

    def read(self, *, strict: bool, origin: np.ndarray | None = None) -> GaussianCloud:
        budget = Budget(self._path)
        placed = list(self._placed(strict=strict, budget=budget))
        if origin is None:
            origin = choose_origin(np.concatenate([_sample(cloud, matrix) for cloud, matrix in placed]))
        clouds = [self._moved(cloud, matrix, origin) for cloud, matrix in placed]
        return joined_within(clouds, budget)

    def blocks(self, size: int, *, strict: bool, origin: np.ndarray) -> Iterator[GaussianCloud]:
        for cloud, matrix in self._placed(strict=strict):
            moved = self._moved(cloud, matrix, origin)
            for start in range(0, len(moved), size):
                yield moved.take(slice(start, start + size))

    def _placed(
        self, *, strict: bool, budget: Budget | None = None
    ) -> Iterator[tuple[GaussianCloud, np.ndarray]]:
        """Each cloud and its (4, 4) matrix to the tileset's frame."""
        without = 0
        for tile in self._tiles:
            document = splat_document(tile.path)
            found = placed_clouds(document, strict=strict)
            without += not found
            if budget is not None:
                budget.extend(document.budget.file_bytes)
                for cloud, _ in found:
                    budget.spend(4 * (11 + 3 * cloud.sh.shape[1]) * len(cloud), f"splats of {tile.path.name}")
            yield from ((cloud, tile.matrix @ matrix) for cloud, matrix in found)
        if without == len(self._tiles):
            raise FileFormatError(
                f"{self._path}: a tileset without splats: none of its {without:,} finest tiles has any"
            )
        if without:
            warnings.warn(
                f"{self._path}: {without:,} of {len(self._tiles):,} tiles have no splats; they are left out",
                DataWarning,
                stacklevel=6,
            )

    def _moved(self, cloud: GaussianCloud, matrix: np.ndarray, origin: np.ndarray) -> GaussianCloud:
        try:
            return cloud.transformed(matrix[:3], origin=origin)
        except ValueError as error:
            raise FileFormatError(f"{self._path}: a tile cannot be moved to its place: {error}") from None


def _sample(cloud: GaussianCloud, matrix: np.ndarray) -> np.ndarray:
    """(k, 3) of the positions in the tileset's frame."""
    return (sampled(cloud.means) + cloud.origin) @ matrix[:3, :3].T + matrix[:3, 3]


def holds_splats(path: Path) -> bool:
    """Whether the tileset file ``path`` is one of splats: one of its first tiles holds some. A broken file
    raises FileFormatError."""
    tree = _Tree(path)
    if tree.of_meshes:
        return False
    return any(names_splats(splat_document(tile.path)) for tile in tree.tiles()[:_LOOKED_AT])


def _matches(content: Content) -> bool:
    text = content.json_text
    return b'"geometricError"' in text and b'"root"' in text


READER = FormatReader(
    _matches,
    lambda content, _file, _reading: SplatTileset(content.path),
    lambda content: holds_splats(content.path),
    up=lambda content: _Tree(content.path).up(),
    to_y_down=Y_DOWN_FROM_Z_UP,  # in tilesets of others; ours say from where they were turned
)
