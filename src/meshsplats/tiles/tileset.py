"""tileset.json of 3D Tiles 1.1: writing an octree of tiles, and reading it again.

Specification: https://docs.ogc.org/cs/22-025r4/22-025r4.html. Boxes are in the frame of the tileset, whose z
axis points up. On every third level of the octree, tiles with children are the roots of tileset files, each
in a folder of its own, so that no file grows with the scene.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats import __version__
from meshsplats._common.geometry import away_from_ground
from meshsplats._common.kinds import need_path
from meshsplats._files.atomic import write_text
from meshsplats.cameras.framing import has_northing_along_z
from meshsplats.errors import FileFormatError
from meshsplats.formats._orientation import tile_frame
from meshsplats.formats.gltf.splat_tiles import CONTENT
from meshsplats.formats.gltf.splat_tilesets import axes_of
from meshsplats.formats.gltf.tileset_file import (
    LARGEST,
    check_tree,
    entry_of,
    file_below,
    is_number,
    numbers,
    object_in,
    objects_in,
    read_tileset,
)
from meshsplats.formats.meshes import load_mesh
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.origin import FAR
from meshsplats.tiles import NAME

LEVELS_PER_FILE = 3
GROW = 1e-6
"""Boxes are larger than their content by this share, so that rounding leaves nothing outside."""
_TILE_FILE = re.compile(r"([0-7]+/)*(tileset\.json|(root|[0-7]+)\.glb)")
"""Paths of ``tile_path`` and of tileset files."""


@dataclass(frozen=True)
class Node:
    """A tile as it is written."""

    key: str
    """Path in the octree, a digit a level."""
    low: list[float]
    """Least corner of everything in the tile and below it, in the frame of the tileset."""
    high: list[float]
    error: float
    """Geometric error, scene units; 0 for a leaf."""
    splats: int
    triangles: int
    vertices: int
    children: list[str]
    """Keys."""


def tile_path(key: str) -> str:
    """Name of the GLB of a tile in the folder of the tileset."""
    return "/".join([*_folders(key), f"{key[len(_group(key)) :] or 'root'}.glb"])


def is_tile_file(path: str) -> bool:
    """Whether a tileset of ours has a file of this name: its path in the folder, with slashes."""
    return _TILE_FILE.fullmatch(path) is not None


def is_ours(folder: Path) -> bool:
    """Whether ``build_tiles`` has written the tileset.json in ``folder``."""
    try:
        return isinstance(_load(folder / NAME)["extras"]["meshsplats"], dict)
    except (FileFormatError, FileNotFoundError, KeyError, TypeError):
        return False


def write_tilesets(
    folder: Path,
    nodes: dict[str, Node],
    root: str,
    up: np.ndarray,
    splats: int,
    origin: np.ndarray,
    axes: np.ndarray | None = None,
    *,
    of_splats: bool = False,
) -> None:
    """Writes the tileset files of ``nodes`` (by key) below ``root``; that of the root last. ``of_splats``:
    tiles are no meshes.

    Tiles are relative to the point ``origin`` (3,) of the world, to which the transform of the root moves
    them, with z up; or on the globe to their place in its own axes, from which ``axes`` (3, 3) lead to the
    world's.
    """
    note: dict[str, Any] = {"up": [float(x) for x in up], "splats": splats}
    if of_splats:
        note["contents"] = "splats"
    if origin.any():
        note["origin"] = origin.tolist()
    if axes is not None:
        note["axes"] = axes.tolist()
    boxes = _boxes(nodes)
    files = [key for key in sorted(nodes) if key != root and _starts_file(key, nodes, root)]
    for key in [*files, root]:
        own = "" if key == root else _group(key)
        tile = _tile(nodes[key], nodes, own, boxes)
        box = np.array(nodes[key].high) - np.array(nodes[key].low)
        document: dict[str, Any] = {
            "asset": {"version": "1.1", "generator": f"MeshSplats {__version__}"},
            "geometricError": max(nodes[key].error, float(np.linalg.norm(box)) if key == root else 0.0),
            "root": {"refine": "REPLACE", **tile},
            **(CONTENT if of_splats else {}),
        }
        if key == root:
            document["extras"] = {"meshsplats": note}
        if key == root and origin.any():
            document["root"] |= {"transform": _transform(up, origin, axes)}
        path = folder.joinpath(*_folders(own), NAME)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(document, separators=(",", ":"), allow_nan=False) + "\n")


def on_globe(origin: np.ndarray, up: np.ndarray) -> bool:
    """Whether ``origin`` (3,) is a point on the ground of the Earth, in metres from its middle along the axes
    of the globe (ECEF), not projected coordinates with a height above it: one far from the plane of the
    equator and the poles, or from whose ground ``up`` (3,), a unit vector, points away."""
    away = away_from_ground(origin)
    if away is None:
        return False
    return bool(away @ up > 0.99 or (abs(origin[2]) > FAR and not has_northing_along_z(origin)))


def _transform(up: np.ndarray, origin: np.ndarray, axes: np.ndarray | None) -> list[float]:
    """The transform of the root, column by column: a translation to ``origin``, after a turn back from z up
    where there are ``axes``, those of the globe."""
    matrix = np.eye(4)
    matrix[:3, 3] = tile_frame(up) @ origin
    if axes is not None:
        matrix[:3] = axes.T @ np.column_stack([tile_frame(up).T, origin])
    return [float(x) + 0.0 for x in matrix.T.ravel()]


def _group(key: str) -> str:
    """The part of a key that names the folder of its tileset file."""
    return key[: len(key) // LEVELS_PER_FILE * LEVELS_PER_FILE]


def _folders(key: str) -> list[str]:
    group = _group(key)
    return [group[i : i + LEVELS_PER_FILE] for i in range(0, len(group), LEVELS_PER_FILE)]


def _starts_file(key: str, nodes: dict[str, Node], root: str) -> bool:
    """Whether a tile is the root of a tileset file: it has children, and its folder is not that of the tile
    above."""
    above = _above(key, nodes)
    return bool(nodes[key].children) and _group(key) != ("" if above == root else _group(above))


def _above(key: str, nodes: dict[str, Node]) -> str:
    return next(key[:n] for n in range(len(key) - 1, -1, -1) if key[:n] in nodes)


def _tile(node: Node, nodes: dict[str, Node], group: str, boxes: dict[str, list[float]]) -> dict[str, Any]:
    """The entry of a tile in the file of the folder ``group``."""
    tile: dict[str, Any] = {
        "boundingVolume": {"box": boxes[node.key]},
        "geometricError": node.error,
        "content": {"uri": _relative(tile_path(node.key), group)},
        "extras": {"splats": node.splats},
    }
    if node.triangles:
        tile["extras"] |= {"triangles": node.triangles, "vertices": node.vertices}
    children = []
    for key in node.children:
        if _group(key) == group or not nodes[key].children:
            children.append(_tile(nodes[key], nodes, group, boxes))
        else:
            uri = _relative("/".join([*_folders(key), NAME]), group)
            children.append(
                {
                    "boundingVolume": {"box": boxes[key]},
                    "geometricError": nodes[key].error,
                    "content": {"uri": uri},
                }
            )
    return tile | ({"children": children} if children else {})


def _relative(path: str, group: str) -> str:
    """``path``, which lies below the folder of ``group``, as that folder sees it."""
    prefix = "".join(f"{part}/" for part in _folders(group))
    assert path.startswith(prefix)
    return path[len(prefix) :]


def _boxes(nodes: dict[str, Node]) -> dict[str, list[float]]:
    """The box of each tile by its key, a little larger than its content; those of its children lie inside."""
    found: dict[str, list[float]] = {}
    corners: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for key in sorted(nodes, key=len, reverse=True):  # children first
        node = nodes[key]
        low, high = np.array(node.low), np.array(node.high)
        grow = GROW * max(float((high - low).max()) / 2, float(np.abs(low + high).max()) / 2, 1e-30)
        below = [corners[child] for child in node.children]
        low = np.min([low - grow, *(least for least, _ in below)], axis=0)
        high = np.max([high + grow, *(most for _, most in below)], axis=0)
        center = (low + high) / 2
        half = np.nextafter(np.maximum(high - center, center - low), np.inf)  # no corner is rounded inwards
        corners[key] = center - half, center + half
        found[key] = [float(x) for x in (*center, *np.diag(half).ravel())]
    return found


# ---- Reading


@dataclass(eq=False)
class Tile:
    """A tile as it is read."""

    center: np.ndarray
    """(3,) float64 centre of its box, along the axes of the world, relative to the tileset's origin."""
    axes: np.ndarray
    """(3, 3) float64 rows: half the edges of its box, along the axes of the world."""
    error: float
    """Geometric error, scene units."""
    content: Path
    """A mesh, or another tileset file."""
    splats: int
    triangles: int
    vertices: int
    children: list[Tile] = field(default_factory=list)
    is_file: bool = False
    """Whether the content is another tileset file."""
    depth: int = 0
    """Tiles above it."""

    def corners(self) -> np.ndarray:
        """(8, 3) float64 corners of its box, in the coordinates of ``center``."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return self.center + signs @ self.axes

    def load(self) -> SplatMesh:
        """The mesh of the tile, relative to the tileset's origin."""
        mesh = load_mesh(self.content, origin=(0, 0, 0))
        if len(mesh.faces) != self.triangles or len(mesh.vertices) != self.vertices:
            raise FileFormatError(
                f"{self.content}: {len(mesh.faces):,} triangles and {len(mesh.vertices):,} vertices, the"
                f" tileset says {self.triangles:,} and {self.vertices:,}"
            )
        return mesh


class Tileset:
    """A tileset that ``build_tiles`` has written; tileset files inside are read when they are needed.

    Args:
        path: the folder, or its tileset.json.

    Raises:
        FileFormatError: the file is broken, or of another program.
    """

    def __init__(self, path: str | Path) -> None:
        need_path(path=path)
        self.path = Path(path) / NAME if Path(path).is_dir() else Path(path)
        document = _load(self.path)
        note = _object(_object(document, "extras", self.path), "meshsplats", self.path)
        if note.get("contents") == "splats":
            raise FileFormatError(f"{self.path}: a tileset of splats, not of meshes: load_gaussians reads it")
        up = numbers(note.get("up"), 3, "the up direction", self.path)
        if not up.any():
            raise FileFormatError(f"{self.path}: the up direction must not be 0")
        self.up = up / np.linalg.norm(up)
        """(3,) float64 unit direction that points up in the world frame."""
        self.splats = _whole(note.get("splats"), "splats", self.path)
        """Count of the splats in all leaves."""
        self.origin = np.zeros(3)
        """(3,) float64 point of the world that the tiles are relative to."""
        if "origin" in note:
            self.origin = numbers(note["origin"], 3, "the origin", self.path)
        self._axes: np.ndarray | None = None
        if "axes" in note:
            self._axes = axes_of(note["axes"], self.path)
        _error(document, self.path)
        self._to_world = tile_frame(self.up).T
        self._count = 0
        self._read = {entry_of(self.path)}
        self._coarsest: np.ndarray | None = None
        self.root = self._tile(self._root_entry(document), self.path, 0)

    def seen_by(self, camera: Camera) -> Camera:
        """``camera`` with its near plane in front of the coarsest tile, whatever tiles it needs."""
        if camera.near is not None:
            return camera
        if self._coarsest is None:
            self._coarsest = self.root.load().vertices
        return camera.with_near_plane(self._coarsest)

    def children(self, tile: Tile) -> list[Tile]:
        """The tiles that take the place of ``tile``; none for a leaf. A tileset file is read once."""
        for i, child in enumerate(tile.children):
            tile.children[i] = self._opened(child)
        return tile.children

    def tiles(self) -> Iterator[tuple[Tile, int]]:
        """Every tile and its level, 1 for the root; each before those below it."""
        todo = [(self.root, 1)]
        while todo:
            tile, level = todo.pop()
            yield tile, level
            todo += ((child, level + 1) for child in reversed(self.children(tile)))

    def _opened(self, tile: Tile) -> Tile:
        if not tile.is_file:
            return tile
        entry = entry_of(tile.content)
        if entry in self._read:
            name = tile.content.name
            raise FileFormatError(f"{self.path}: its tree names {name!r} twice; a tileset file is read once")
        document = _load(tile.content)
        root = self._tile(_object(document, "root", tile.content), tile.content, tile.depth)
        if root.is_file:
            raise FileFormatError(f"{tile.content}: its root must have a mesh, not another tileset")
        self._read.add(entry)
        return root

    def _root_entry(self, document: dict[str, Any]) -> dict[str, Any]:
        """The entry of the root without its transform, which must be the one to the origin."""
        entry = dict(_object(document, "root", self.path))
        if "transform" in entry or self.origin.any():
            found = numbers(entry.pop("transform", None), 16, "the transform of the root", self.path)
            wanted = np.array(_transform(self.up, self.origin, self._axes))
            if np.abs(found - wanted).max() > 1e-9 * max(1.0, float(np.abs(wanted).max())):
                raise FileFormatError(
                    f"{self.path}: the transform of the root is not the one to the tileset's origin: another"
                    " program has moved it; only tilesets in their place are read"
                )
        return entry

    def _tile(self, entry: dict[str, Any], file: Path, depth: int) -> Tile:
        self._count += 1
        check_tree(depth, self._count, file)
        if entry.get("refine", "REPLACE") != "REPLACE" or "transform" in entry or "implicitTiling" in entry:
            raise FileFormatError(f"{file}: only explicit tiles that replace their parents are read")
        box = numbers(_object(entry, "boundingVolume", file).get("box"), 12, "a bounding box", file)
        content = _content(entry, file)
        is_file = content.suffix == ".json"
        extras = {} if is_file else _object(entry, "extras", file)
        children = objects_in(entry, "children", file)
        if is_file and children:
            raise FileFormatError(f"{file}: a tile whose content is a tileset must have no children")
        tile = Tile(
            center=self._to_world @ box[:3],
            axes=box[3:].reshape(3, 3) @ self._to_world.T,
            error=_error(entry, file),
            content=content,
            splats=0 if is_file else _whole(extras.get("splats"), "splats", file),
            triangles=0 if is_file else _whole(extras.get("triangles"), "triangles", file),
            vertices=0 if is_file else _whole(extras.get("vertices"), "vertices", file),
            children=[self._tile(child, file, depth + 1) for child in children],
            is_file=is_file,
            depth=depth,
        )
        worst = max((child.error for child in tile.children), default=0.0)
        if worst > tile.error:
            raise FileFormatError(f"{file}: a tile of error {worst:g} below one of {tile.error:g}")
        return tile


def _load(path: Path) -> dict[str, Any]:
    return read_tileset(path, ("1.1",))


def _object(owner: dict[str, Any], key: str, path: Path) -> dict[str, Any]:
    """``object_in`` of a tileset of ours: one of others has no notes."""
    if key in ("extras", "meshsplats") and not isinstance(owner.get(key), dict):
        raise FileFormatError(
            f"{path}: a tileset of another program; only those of 'meshsplats tiles' are read"
        )
    found: dict[str, Any] = object_in(owner, key, path)
    return found


def _error(owner: dict[str, Any], path: Path) -> float:
    value: Any = owner.get("geometricError")
    if not is_number(value) or not 0 <= value < LARGEST:
        raise FileFormatError(f"{path}: geometricError must be a number >= 0, got {str(value)[:40]}")
    return float(value)


def _whole(value: Any, what: str, path: Path) -> int:
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 40:
        return value
    raise FileFormatError(f"{path}: the count of {what} must be a whole number, got {str(value)[:40]}")


def _content(tile: dict[str, Any], file: Path) -> Path:
    """The mesh of a ``tile`` of ``file``, or another tileset file."""
    path = file_below(file, object_in(_object(tile, "content", file), "uri", file, str))
    if path.suffix not in (".glb", ".json"):
        raise FileFormatError(f"{file}: tiles must be .glb files, got {path.name[:80]!r}")
    return path
