"""build_tiles: splats of any number as a 3D Tiles tileset, in bounded memory.

The tileset is an octree. Its leaves hold the triangles that ``convert`` makes of the whole scene, each of
them once. An inner tile stands for its children when it is seen from afar: their splats are merged to a
quarter, and its geometric error says how far the merged ones lie from those of the file.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from meshsplats._files.atomic import atomic_path, replace_folder, write_bytes, write_text
from meshsplats._files.locks import locked
from meshsplats._kinds import need, need_path
from meshsplats._options import check_choices
from meshsplats.camera import Camera
from meshsplats.cameras.framing import DEFAULT_UP, unit_up, weighted_quantile
from meshsplats.cameras.trajectories import orbit
from meshsplats.cluster import Shared, Workers
from meshsplats.conversion import Fans
from meshsplats.conversion.budget import triangles_each
from meshsplats.conversion.merging import FILTER_PX2, merge
from meshsplats.conversion.options import ConversionOptions, Preset
from meshsplats.conversion.streaming import ScenePixels, Survey, refuse_whole, survey, worth_drawing
from meshsplats.evaluation.viewers import SIDE, TRIANGLES, VIEWS, AlphaChoice, choose_by_views
from meshsplats.formats.cutting import CUTOFF, cut_mesh
from meshsplats.formats.gaussians import SplatStream
from meshsplats.formats.gltf.writer import Alpha, change_alpha
from meshsplats.formats.meshes import save_mesh
from meshsplats.gaussians import GaussianCloud, Kernel
from meshsplats.mesh import SplatMesh
from meshsplats.tiles.buckets import BUCKET, DEPTH, RECORD, Buckets, Cube, cloud_of, read_records, records_of
from meshsplats.tiles.drawing import choose_tiles, join_tiles
from meshsplats.tiles.journal import Journal
from meshsplats.tiles.tileset import Node, Tileset, tile_frame, tile_path, write_tilesets

TilesAlpha = Literal["auto", "blend", "mask", "opaque"]

MAX_TRIANGLES = 1 << 16
"""Triangles of a tile."""
SHARE = 4
"""Splats of the children for each one of an inner tile: surfaces, seen from twice as far, cover a quarter."""
ERROR_SHARE = 0.99
"""Share of the mass of an inner tile that its geometric error speaks for."""
JOURNAL = Path("work", "journal.jsonl")
"""Inside the folder of an unfinished tileset."""
SURVEY = "survey.npz"
"""Beside the journal."""
_MERGED = np.dtype([*RECORD.descr, ("spread", "<f8")])
"""A splat of a tile; the variance of the centres of the file's splats around it, square scene units."""


@dataclass(frozen=True)
class TileOptions:
    """Options of ``build_tiles``."""

    max_triangles: int = MAX_TRIANGLES
    """Largest number of triangles of a tile."""
    preset: Preset = "default"
    """Preset of the conversion."""
    conversion: ConversionOptions | None = None
    """What to do otherwise than the preset does; not ``max_splats``, ``max_triangles``, ``detail='cameras'``,
    ``colors='cameras'``, and of the footprints framing, distance and none."""
    up: tuple[float, float, float] | None = None
    """Direction that points up in the world frame. None: that of the splat files, where they name it, else
    (0, -1, 0)."""
    lit: bool = False
    """A material that scene lights shade, instead of an unlit one."""
    alpha: TilesAlpha = "auto"
    """How viewers treat opacity, as in ``save_mesh``, the same in all tiles. auto: 'blend' or 'mask',
    whichever is nearer to the sorted image in viewers that do not sort (``choose_alpha``), by images of the
    tiles from around the scene."""
    place: Literal["world", "local"] = "world"
    """'world': the tileset stands at the origin of the splats, to which the transform of its root moves it;
    'local': that transform is left out."""

    def resolved(self) -> ConversionOptions:
        """The checked options of the conversion. Raises ValueError."""
        check_choices(self, {"alpha": get_args(TilesAlpha), "place": ("world", "local")})
        chosen = (self.conversion or ConversionOptions()).resolved(self.preset, has_cameras=False)
        refuse_whole(chosen)
        if chosen.footprint == "filter":
            raise ValueError("footprint='filter' is for this project's renderer, tiles are for others")
        least = triangles_each(chosen)
        if isinstance(self.max_triangles, bool) or self.max_triangles < 8 * least:
            raise ValueError(
                f"max_triangles of a tile must be at least {8 * least}, got {self.max_triangles!r}"
            )
        return chosen


@dataclass(frozen=True)
class TilesetSummary:
    """A finished tileset."""

    splats: int
    """Count of the splats in its leaves."""
    triangles: int
    """Count of the triangles of its leaves."""
    tiles: int
    levels: int
    bytes: int
    """Of all files."""
    error: float
    """Geometric error of the root, scene units."""
    alpha: AlphaChoice
    """The alpha mode of the tiles."""


def build_tiles(
    source: SplatStream,
    folder: str | os.PathLike[str],
    options: TileOptions | None = None,
    *,
    resume: bool = False,
    replace_old: bool = False,
    threads: int | None = None,
    workers: Workers | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> TilesetSummary:
    """Writes the splats of ``source`` as the tileset ``folder``, whole or not at all.

    Tiles are relative to the origin of the splats (``SplatStream.origin``), to which the transform of the
    root moves them.

    Until it is complete the tileset lies in ``FOLDER.partial`` with a journal, so that a run that was ended
    at any moment can be resumed. The result has the same bits with any number of threads and workers, and
    after any number of interruptions. Memory does not grow with the scene; the disk holds 60 bytes a splat
    besides the tiles.

    Args:
        source: the splats.
        folder: of the tileset.
        options: what it should be like.
        resume: go on with an interrupted run of the same splats and options.
        replace_old: replace a tileset, and begin again where an earlier run left a partial one.
        threads: at most this many; all processors by default.
        workers: build the cells of the octree, each in a task; this process by default. All of them have the
            folder at the same path.
        on_progress: called with the count of finished splats and that of all.

    Returns:
        Counts of the tileset.

    Raises:
        FileExistsError: the folder or a partial one exists.
        FileNotFoundError: there is nothing to resume.
        ValueError: options out of range, or other ones than the interrupted run had; no splat to convert.
        OSError: a full disk; what is done stays, for ``resume``.
        ClusterError: the workers are lost; what is done stays.
    """
    need(SplatStream, source=source)
    need_path(folder=folder)
    need(TileOptions, options=options, optional=True)
    need(Workers, workers=workers, optional=True)
    chosen = options or TileOptions()
    if chosen.up is None:
        up = DEFAULT_UP if source.up is None else source.up.astype(float).tolist()
        chosen = replace(chosen, up=(up[0], up[1], up[2]))
    conversion = chosen.resolved()
    target = Path(folder)
    unfinished = partial_folder(target)
    with locked(target.with_name(f".{target.name}.lock")) as ours:
        if not ours:
            raise FileExistsError(f"{unfinished}: another process is at work on this tileset")
        _check_folders(target, unfinished, resume, replace_old)
        build = _Build(source, unfinished, chosen, conversion, threads, workers, on_progress)
        summary = build.run()
        replace_folder(unfinished / "tileset", target)
        shutil.rmtree(unfinished)
    return summary


def partial_folder(folder: Path) -> Path:
    """Where the tileset ``folder`` lies until it is complete."""
    return folder.with_name(f"{folder.name}.partial")


def _check_folders(target: Path, unfinished: Path, resume: bool, replace_old: bool) -> None:
    """Refuses folders that must not be written, and removes what an earlier run has left."""
    if target.exists():
        if not (target / "tileset.json").is_file():
            raise FileExistsError(f"{target} is there and holds no tileset.json: give another folder")
        if not (replace_old or resume):
            raise FileExistsError(f"{target} exists: give another folder, or have it replaced")
    if resume:
        if not (unfinished / JOURNAL).is_file():
            raise FileNotFoundError(f"nothing to resume in {unfinished}")
    elif unfinished.exists():
        if not replace_old:
            raise FileExistsError(f"{unfinished} is left from an earlier run: resume it, or remove it")
        if not (unfinished / JOURNAL).is_file():
            raise FileExistsError(f"{unfinished} exists and is not of this command: remove it")
        shutil.rmtree(unfinished)


class _Build:
    """One run; its steps leave files and lines in the journal, and are skipped where these exist."""

    def __init__(
        self,
        source: SplatStream,
        folder: Path,
        options: TileOptions,
        conversion: ConversionOptions,
        threads: int | None,
        workers: Workers | None,
        on_progress: Callable[[int, int], None] | None,
    ) -> None:
        self._source, self._options, self._conversion = source, options, conversion
        self._workers, self._on_progress = workers or Workers(threads), on_progress
        self._folder, self._threads = folder, threads
        self._work, self._out = folder / "work", folder / "tileset"
        for part in (self._work / "done", self._work / "splats", self._out):
            part.mkdir(parents=True, exist_ok=True)
        self.journal = Journal(folder / JOURNAL)

    def run(self) -> TilesetSummary:
        self._check_start()
        scene = self._survey()
        buckets = Buckets(self._work / "splats", Cube(scene.low, scene.high), self.journal, BUCKET)
        buckets.fill(self._records(), scene.kept)
        cells = buckets.cells()
        done = {line["key"]: line["splats"] for line in self.journal.steps if line["step"] == "cell"}
        finished = 0

        def ended(cell: str) -> None:
            nonlocal finished
            buckets.remove(cells[cell])
            finished += done[cell]
            if self._on_progress:
                self._on_progress(finished, scene.kept)

        for cell in done:
            ended(cell)
        todo = [(cell, buckets.paths(files)) for cell, files in cells.items() if cell not in done]
        build = partial(_build_cell, self._tiles(self._workers.threads))
        for i, count in self._workers.run(build, todo):
            cell = todo[i][0]
            done[cell] = count
            self.journal.add("cell", key=cell, splats=count)
            ended(cell)
        for leftover in self._out.rglob(".*"):  # temporary files of workers that were killed
            leftover.unlink()
        tiles = self._tiles(self._threads).get()
        root = tiles.root_of(tiles.upper(sorted(cells), self.journal)).key
        nodes: dict[str, Node] = {}
        for path in sorted((self._work / "done").glob("*.json")):
            for fields in json.loads(path.read_text(encoding="utf-8")):
                nodes[fields["key"]] = Node(**fields)
        leaves = [node for node in nodes.values() if not node.children]
        splats = sum(node.splats for node in leaves)
        up = unit_up(self._options.up or DEFAULT_UP)
        write_tilesets(self._out, nodes, root, up, splats, self._origin)
        alpha = self._alpha(scene, nodes)
        triangles = sum(node.triangles for node in leaves)
        size = sum(path.stat().st_size for path in self._out.rglob("*") if path.is_file())
        levels = _height(nodes, root)
        return TilesetSummary(splats, triangles, len(nodes), levels, size, nodes[root].error, alpha)

    def _alpha(self, scene: Survey, nodes: dict[str, Node]) -> AlphaChoice:
        """The alpha mode of the tiles, after choosing it if that is asked for. They are written with 'mask',
        in whose place the choice fits."""
        if self._options.alpha != "auto":
            return AlphaChoice(self._options.alpha)
        noted = self.journal.find("alpha")
        if noted is None:
            choice = self._chosen(scene)
            self.journal.add("alpha", **asdict(choice))
        else:
            choice = AlphaChoice(**{name: value for name, value in noted.items() if name != "step"})
        for key in nodes:
            change_alpha(self._out / tile_path(key), **choice.options)
        return choice

    def _chosen(self, scene: Survey) -> AlphaChoice:
        """The alpha mode that suits what viewers load of the tileset, far tiles drawn before near ones."""
        tileset = Tileset(self._out)
        cameras = orbit(
            scene.sample,
            VIEWS,
            elevation=20,
            width=SIDE,
            height=SIDE,
            up=unit_up(self._options.up or DEFAULT_UP),
        )

        def views() -> Iterator[tuple[SplatMesh, Camera]]:
            for camera in (*cameras[::2], *cameras[1::2]):
                tiles, _ = choose_tiles(tileset, [camera], most=TRIANGLES)
                tiles = tiles or [tileset.root]
                depth = [camera.world_to_camera[2, :3] @ tile.center for tile in tiles]
                order = np.argsort(depth, kind="stable")[::-1]
                yield join_tiles(tileset, [tiles[i] for i in order]), camera

        return choose_by_views(views(), threads=self._threads)

    @property
    def _origin(self) -> np.ndarray:
        """Where the tileset stands in its world."""
        return self._source.origin if self._options.place == "world" else np.zeros(3)

    def _tiles(self, threads: int | None) -> Shared[_Tiles]:
        return Shared(partial(_Tiles, self._folder, self._options, threads))

    def _check_start(self) -> None:
        """Notes what the run is about, or refuses to resume another one."""
        files = [[str(path), os.stat(path).st_size, os.stat(path).st_mtime_ns] for path in self._source.paths]
        options = json.loads(json.dumps(asdict(self._options)))
        facts: dict[str, Any] = {"files": files, "reading": self._source.reading, "options": options}
        if self._source.origin.any():
            facts["origin"] = self._source.origin.tolist()
        before = self.journal.find("start")
        if before is None:
            self.journal.add("start", **facts)
            return
        for name, value in facts.items():
            if before.get(name) != value:
                raise ValueError(
                    f"{self._work.parent} was started with other {name} ({str(before.get(name))[:200]}):"
                    " resume with the same, or begin again"
                )

    def _survey(self) -> Survey:
        """The survey of the scene; that of the interrupted run if there is one."""
        path = self._work / SURVEY
        if self.journal.find("survey") is None:
            found = survey(self._source, self._conversion)
            with atomic_path(path) as temporary:
                arrays = {
                    "counts": np.array([found.kept, found.step]),
                    "bounds": np.stack([found.low, found.high, found.origin]),
                    "kernel": np.array(found.kernel),
                    "sample": records_of(found.sample, np.zeros(len(found.sample), np.int32)),
                }
                np.savez(temporary, **arrays)  # type: ignore[arg-type]
            self.journal.add("survey", kept=found.kept)
        return _stored_survey(path)

    def _records(self) -> Iterator[np.ndarray]:
        passed = 0
        for block in self._source:
            rows = worth_drawing(block, self._conversion)
            yield records_of(block.take(rows), (rows + passed).astype(np.int32))
            passed += len(block)
            if passed > np.iinfo(np.int32).max:
                raise ValueError(f"{passed:,} splats are more than tiles can number")


def _stored_survey(path: Path) -> Survey:
    """The survey that a run has written."""
    with np.load(path) as stored:
        kept, step = (int(n) for n in stored["counts"])
        low, high, origin = stored["bounds"]
        kernel: Kernel = str(stored["kernel"])  # type: ignore[assignment]
        return Survey(kept, kernel, low, high, cloud_of(stored["sample"], kernel), step, origin)


def _build_cell(tiles: Shared[_Tiles], cell: tuple[str, list[Path]]) -> int:
    """Writes the tiles of a cell of that key, with the splats of these files; their count."""
    key, files = cell
    records = read_records(files)
    tiles.get().keep(key, *tiles.get().subtree(key, records))
    return len(records)


class _Tiles:
    """Writes tiles into the folder of a run whose survey is done. Keeps nothing of them."""

    def __init__(self, folder: Path, options: TileOptions, threads: int | None) -> None:
        self._options, self._threads = options, threads
        self._conversion = options.resolved()
        self._work, self._out = folder / "work", folder / "tileset"
        self._most = options.max_triangles // triangles_each(self._conversion)
        self._up = unit_up(options.up or DEFAULT_UP)
        self._frame = tile_frame(self._up)
        scene = _stored_survey(self._work / SURVEY)
        self._kernel = scene.kernel
        self._pixels = ScenePixels(scene, self._conversion, None, self._up)
        self._cube = Cube(scene.low, scene.high)

    # -- cells in memory

    def subtree(self, key: str, records: np.ndarray) -> tuple[list[Node], np.ndarray]:
        """Writes the tiles of a cell; their nodes, its own last, and the splats that stand for it."""
        codes = self._cube.codes(records["means"])
        order = np.lexsort((records["row"], codes))
        return self._tree(key, records[order], codes[order])

    def _tree(self, key: str, records: np.ndarray, codes: np.ndarray) -> tuple[list[Node], np.ndarray]:
        if len(records) <= self._most:
            return self._leaf(key, records)
        starts = self._starts(key, codes)
        groups = self._groups(starts)
        if len(groups) == 1:  # a cell with one child is that child
            return self._tree(f"{key}{groups[0][0]}", records, codes)
        nodes: list[Node] = []
        children, parts = [], []
        for octant, part in groups:
            found, merged = self._tree(f"{key}{octant}", records[part], codes[part])
            nodes += found
            children.append(found[-1])
            parts.append(merged)
        node, merged = self._inner(key, children, parts)
        return [*nodes, node], merged

    def _groups(self, starts: np.ndarray) -> list[tuple[int, slice]]:
        """The children of a cell: first octant and splats of each. Octants with few splats share a leaf."""
        groups: list[tuple[int, slice]] = []
        for octant in np.flatnonzero(np.diff(starts)):
            begin, end = int(starts[octant]), int(starts[octant + 1])
            if groups and end - groups[-1][1].start <= self._most:
                groups[-1] = (groups[-1][0], slice(groups[-1][1].start, end))
            else:
                groups.append((int(octant), slice(begin, end)))
        return groups

    def _starts(self, key: str, codes: np.ndarray) -> np.ndarray:
        """(9,) first splat of each octant of a cell whose ``codes`` are ascending, and their count."""
        if len(key) >= DEPTH:
            return np.arange(9) * len(codes) // 8
        octants = (codes >> np.uint64(3 * (DEPTH - 1 - len(key)))) & np.uint64(7)
        return np.searchsorted(octants, np.arange(9, dtype=np.uint64))

    def _leaf(self, key: str, records: np.ndarray) -> tuple[list[Node], np.ndarray]:
        records = records[np.argsort(records["row"], kind="stable")]
        cloud = cloud_of(records, self._kernel)
        node = self._write(key, cloud, records["row"], self._pixels.at(cloud.means), 0.0, [])
        return [node], _merged_from(records)

    def _inner(
        self, key: str, children: Sequence[Node], parts: Sequence[np.ndarray]
    ) -> tuple[Node, np.ndarray]:
        """Writes the tile that stands for ``children``, which show the splats ``parts``."""
        below = np.concatenate(list(parts))
        below = below[np.argsort(below["row"], kind="stable")]
        cloud = cloud_of(below, self._kernel)
        count = max(1, min(self._most, -(-len(below) // SHARE)))
        finest = max(child.error for child in children)
        pixel = np.full(len(below), finest, np.float32)
        if not finest:
            own = self._pixels.at(cloud.means)
            pixel = np.zeros_like(pixel) if own is None else own
        result = merge(cloud, count, np.sqrt(FILTER_PX2) * pixel.astype(np.float64), threads=self._threads)
        first = np.unique(result.group, return_index=True)[1]
        rows = below["row"][first]
        merged = _merged_from(records_of(result.cloud, rows))
        weights, totals = _weights(result.group, result.masses)
        away = np.square(cloud.means.astype(np.float64) - result.cloud.means[result.group]).sum(axis=1)
        merged["spread"] = np.bincount(result.group, weights * (below["spread"] + away), len(rows))
        apart = np.sqrt(merged["spread"])
        # None counts for more than the whole tile: else one stray, of any size, would speak for all.
        usual = np.quantile(cloud.means.astype(np.float64), (0.01, 0.99), axis=0)
        totals = np.minimum(totals, float(np.ptp(usual, axis=0).max()) ** 2)
        error = weighted_quantile(apart, totals, ERROR_SHARE) if totals.any() else float(apart.max())
        error = max(error, finest)
        size = None if self._pixels.is_none else np.full(len(rows), error, np.float32)
        node = self._write(key, result.cloud, rows, size, error, [child.key for child in children], children)
        return node, merged

    def _write(
        self,
        key: str,
        cloud: GaussianCloud,
        rows: np.ndarray,
        pixel: np.ndarray | None,
        error: float,
        children: list[str],
        below: Sequence[Node] = (),
    ) -> Node:
        """Writes the mesh of a tile."""
        fans = Fans.of(cloud, self._conversion, pixel)
        vertices, faces, colors, owners = fans.build(cloud, rows, cloud.colors, self._conversion.compensation)
        mesh = SplatMesh(vertices, faces, colors, face_splat=owners, up=self._up)
        alpha: Alpha = "mask" if self._options.alpha == "auto" else self._options.alpha
        if alpha == "opaque":
            # A tile of nothing but fog keeps its densest part: glTF has no empty meshes.
            mesh = cut_mesh(mesh, min(CUTOFF, 0.9 * float(colors[:, 3].max())))
        path = self._out / tile_path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        lit = True if self._options.lit else None
        save_mesh(mesh, path, lit=lit, alpha=None if alpha == "opaque" else alpha)
        corners = mesh.vertices.astype(np.float64) @ self._frame.T
        low = np.min([corners.min(axis=0), *(node.low for node in below)], axis=0)
        high = np.max([corners.max(axis=0), *(node.high for node in below)], axis=0)
        return Node(
            key=key,
            low=[float(x) for x in low],
            high=[float(x) for x in high],
            error=float(error),
            splats=len(cloud),
            triangles=len(mesh.faces),
            vertices=len(mesh.vertices),
            children=children,
        )

    # -- cells above those in memory

    def keep(self, cell: str, nodes: list[Node], merged: np.ndarray) -> None:
        """Files what is done of a cell, for the ones above it and for a resumed run."""
        # Not by tofile, whose errors do not say that the disk is full.
        write_bytes(self._merged(cell), merged.view(np.uint8).data)
        write_text(
            self._work / "done" / f"cell-{cell}.json", json.dumps([asdict(node) for node in nodes]) + "\n"
        )

    def _merged(self, cell: str) -> Path:
        return self._work / "done" / f"cell-{cell}.merged"

    def upper(self, cells: Sequence[str], journal: Journal) -> str:
        """Writes the tiles above ``cells``, ascending; the cell that holds all of them."""
        top = os.path.commonprefix(list(cells))  # noqa: RUF071 - a character is a level
        if len(cells) == 1:
            return top
        parts = [
            self.upper([cell for cell in cells if cell.startswith(top + octant)], journal)
            for octant in sorted({cell[len(top)] for cell in cells})
        ]
        if top not in journal.keys("above"):
            merged = [np.fromfile(self._merged(place), _MERGED) for place in parts]
            node, own = self._inner(top, [self.root_of(place) for place in parts], merged)
            self.keep(top, [node], own)
            journal.add("above", key=top)
        return top

    def root_of(self, cell: str) -> Node:
        """The uppermost tile of a cell that is done."""
        nodes = json.loads((self._work / "done" / f"cell-{cell}.json").read_text(encoding="utf-8"))
        return Node(**nodes[-1])


def _merged_from(records: np.ndarray) -> np.ndarray:
    """``records`` with a spread of 0."""
    merged = np.zeros(len(records), _MERGED)
    for name in RECORD.names or ():
        merged[name] = records[name]
    return merged


def _weights(group: np.ndarray, masses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) share of each splat in the mass of its group, and (g,) masses of the groups. In a group without
    mass, all members count alike."""
    totals = np.bincount(group, masses)
    sizes = np.bincount(group)
    own = totals[group]
    shares = np.divide(masses, own, out=np.zeros_like(masses), where=own > 0)
    return np.where(own > 0, shares, 1 / sizes[group]), totals


def _height(nodes: dict[str, Node], key: str) -> int:
    return 1 + max((_height(nodes, child) for child in nodes[key].children), default=0)
