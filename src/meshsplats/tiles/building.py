"""build_tiles: splats of any number as a 3D Tiles tileset, in bounded memory.

The tileset is an octree. Its leaves hold the triangles that ``convert`` makes of the whole scene, each of
them once. An inner tile stands for its children when it is seen from afar: their splats are merged to a
quarter, and its geometric error says how far the merged ones lie from those of the file. Tiles of splats
have the splats themselves.
"""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from meshsplats._common.kinds import need, need_path
from meshsplats._common.words import plural
from meshsplats._core.library import check_threads
from meshsplats._files.atomic import atomic_path, replace_folder
from meshsplats._files.locks import locked
from meshsplats.cameras.framing import DEFAULT_UP, default_up, unit_up
from meshsplats.cameras.trajectories import orbit
from meshsplats.cluster import Shared, Workers
from meshsplats.conversion.driver import worth_drawing
from meshsplats.conversion.options import ConversionOptions
from meshsplats.conversion.streaming import Survey, survey
from meshsplats.errors import DataWarning, EarlierRunError, FileFormatError
from meshsplats.evaluation.viewers import SIDE, TRIANGLES, VIEWS, AlphaChoice, choose_by_views
from meshsplats.formats.gltf.writer import change_alpha
from meshsplats.formats.outputs import check_resumption
from meshsplats.formats.streaming import SplatStream
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.tiles.buckets import BUCKET, Buckets, Cube, records_of
from meshsplats.tiles.drawing import choose_tiles, join_tiles
from meshsplats.tiles.journal import Journal
from meshsplats.tiles.making import SURVEY, TileWriter, build_cell, harmonics_degree, stored_survey
from meshsplats.tiles.options import TileOptions
from meshsplats.tiles.start import (
    need_each_once,
    need_other_folder,
    need_same_start,
    start_facts,
    warn_of_copies,
)
from meshsplats.tiles.tileset import (
    Node,
    Tileset,
    is_ours,
    is_tile_file,
    on_globe,
    tile_path,
    write_tilesets,
)

JOURNAL = Path("work", "journal.jsonl")
"""Inside the folder of an unfinished tileset."""
Show = Callable[[str, "float | None"], None]
"""Takes the name of a phase and the share of it that is done, 0 to 1, None where that is not known."""


@dataclass(frozen=True)
class TilesetSummary:
    """A finished tileset."""

    splats: int
    """Count of the splats in its leaves."""
    triangles: int
    """Count of the triangles of its leaves; 0 for tiles of splats."""
    tiles: int
    levels: int
    bytes: int
    """Of all files."""
    error: float
    """Geometric error of the root, scene units."""
    alpha: AlphaChoice | None
    """The alpha mode of the tiles; None for tiles of splats."""
    on_globe: bool = False
    """Whether the transform of its root leads to a place on the Earth, as CesiumJS takes it."""

    def in_words(self) -> str:
        """Counts and size."""
        made = f" -> {plural(self.triangles, 'triangle')}" if self.alpha else ""
        return (
            f"{plural(self.splats, 'splat')}{made} in {plural(self.tiles, 'tile')} of"
            f" {plural(self.levels, 'level')}, {self.bytes / 1e6:,.1f} MB"
        )


def build_tiles(
    source: SplatStream,
    folder: str | os.PathLike[str],
    options: TileOptions | None = None,
    *,
    resume: bool = False,
    replace_old: bool = False,
    threads: int | None = None,
    workers: Workers | None = None,
    on_progress: Show | None = None,
) -> TilesetSummary:
    """Writes the splats of ``source`` as the tileset ``folder``, whole or not at all.

    Tiles are relative to the origin of the splats (``SplatStream.origin``), to which the transform of the
    root moves them.

    Until it is complete the tileset lies in ``FOLDER.partial`` with a journal, so that a run that was ended
    at any moment can be resumed. The result has the same bits with any number of threads and workers, and
    after any number of interruptions. Memory does not grow with the scene; the disk holds 60 bytes a splat
    besides the tiles, and 12 for each harmonic.

    Args:
        source: the splats.
        folder: of the tileset.
        options: what it should be like.
        resume: go on with an interrupted run of the same splats, options and version of MeshSplats.
        replace_old: replace a tileset that ``build_tiles`` has written, of which files that are none of its
            tiles stay, and begin again where an earlier run left a partial one.
        threads: at most this many; all processors by default.
        workers: build the cells of the octree, each in a task; this process by default. All of them have the
            folder at the same path.
        on_progress: called with the name of a phase (passes over the splats, tiles, alpha mode) and the share
            of it that is done, 0 to 1; None where that is not known.

    Returns:
        Counts of the tileset.

    Raises:
        FileExistsError: the folder or a partial one exists, or with ``replace_old`` one of another program.
        FileNotFoundError: there is nothing to resume.
        ValueError: the splats are those of the tileset that it would replace; options out of range, or other
            ones than the interrupted run had; no splat to convert; a file that is given twice; files that are
            too far apart for one origin.
        FileFormatError: the interrupted run has lost some of what it had done.
        OSError: a full disk; finished work is kept, for ``resume``.
        ClusterError: the workers are lost; finished work is kept.
    """
    need(SplatStream, source=source)
    need_path(folder=folder)
    need(TileOptions, options=options, optional=True)
    need(Workers, workers=workers, optional=True)
    check_threads(threads)
    chosen = options or TileOptions()
    need_each_once(source.paths)
    warn_of_copies(source)
    usual = default_up(source.origin)  # whose errors come before anything is written
    if chosen.up is None:
        up = (usual if source.up is None else source.up).astype(float).tolist()
        chosen = replace(chosen, up=(up[0], up[1], up[2]))
    conversion = chosen.resolved()
    target = Path(folder)
    unfinished = partial_folder(target)
    with locked(target.with_name(f".{target.name}.lock")) as ours:
        if not ours:
            raise FileExistsError(f"{unfinished}: another process is at work on this tileset")
        need_other_folder(source.paths, target)
        _check_folders(target, unfinished, resume, replace_old)
        build = _Build(source, unfinished, chosen, conversion, threads, workers, on_progress)
        try:
            summary = build.run()
        except ValueError:
            if not resume and build.journal.find("survey") is None:
                shutil.rmtree(unfinished)  # nothing to go on with
            raise
        build.place(target)
    return summary


def partial_folder(folder: Path) -> Path:
    """Where the tileset ``folder`` lies until it is complete."""
    return folder.with_name(f"{folder.name}.partial")


def _check_folders(target: Path, unfinished: Path, resume: bool, replace_old: bool) -> None:
    """Refuses folders that must not be written, and removes what an earlier run has left."""
    if target.exists():
        if not (target / "tileset.json").is_file():
            raise FileExistsError(f"{target} is there and holds no tileset.json: give another folder")
        if not is_ours(target):
            raise FileExistsError(f"{target} holds a tileset of another program: give another folder")
    work = unfinished / JOURNAL.parent
    if work.is_dir() and all(path.is_dir() for path in unfinished.rglob("*")):
        shutil.rmtree(unfinished)  # of a run that was killed before its first step
    check_resumption(target, unfinished, JOURNAL, resume=resume, replace_old=replace_old)
    if target.exists() and not (replace_old or resume):
        raise EarlierRunError(f"{target} exists: give another folder, or ``replace_old`` to replace it")
    if unfinished.exists() and not resume:
        _remove(unfinished)


def _remove(unfinished: Path) -> None:
    """Removes the folder of a run; the journal, by which it is known, last."""
    for part in ("tileset", "work/done", "work/splats"):
        shutil.rmtree(unfinished / part, ignore_errors=True)
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
        on_progress: Show | None,
    ) -> None:
        self._source, self._options, self._conversion = source, options, conversion
        self._workers, self._show = workers or Workers(threads), on_progress or (lambda phase, share: None)
        self._passes = _Passes(source, self._show)
        self._folder, self._threads = folder, threads
        self._work, self._out = folder / "work", folder / "tileset"
        self._work.mkdir(parents=True, exist_ok=True)
        self.journal = Journal(folder / JOURNAL)

    def run(self) -> TilesetSummary:
        """Makes the tileset, beside what the run needs."""
        self._check_start()
        noted = self.journal.find("finished")
        if noted is None:
            summary = self._made()
            self.journal.add("finished", **asdict(summary))
            return summary
        fields = {name: value for name, value in noted.items() if name != "step"}
        return TilesetSummary(**fields | {"alpha": fields["alpha"] and AlphaChoice(**fields["alpha"])})

    def place(self, target: Path) -> None:
        """Gives the finished tileset its name, and removes what the run has needed."""
        if not self._out.is_dir():  # the run was killed after that
            if not is_ours(target):
                raise EarlierRunError(
                    f"{self._folder}: its tileset had become {target}, which is gone: begin again with"
                    " ``replace_old``"
                )
            os.rename(target, self._out)  # for what an older one may still have to hand over
        replace_folder(self._out, target, is_tile_file)
        _remove(self._folder)

    def _made(self) -> TilesetSummary:
        for part in (self._work / "done", self._work / "splats", self._out):
            part.mkdir(exist_ok=True)
        scene = self._survey()
        if self._options.as_splats and scene.kernel == "2dgs":
            text = "SPZ leaves out the kernel '2dgs': the tiles are drawn as '3dgs'"
            warnings.warn(f"{self._folder}: {text}", DataWarning, stacklevel=3)
        degree = harmonics_degree(scene, self._conversion)
        cube = Cube(scene.low, scene.high)
        buckets = Buckets(self._work / "splats", cube, self.journal, BUCKET, degree)
        buckets.fill(self._records(degree), scene.kept)
        self._show("making the tiles", None)
        cells = buckets.cells()
        done = {line["key"]: line["splats"] for line in self.journal.steps if line["step"] == "cell"}
        finished = 0

        def ended(cell: str) -> None:
            nonlocal finished
            buckets.remove(cells[cell])
            finished += done[cell]
            self._show("making the tiles", finished / scene.kept)

        for cell in done:
            ended(cell)
        todo = buckets.paths({cell: files for cell, files in cells.items() if cell not in done})
        build = partial(build_cell, self._tiles(self._workers.threads))
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
        self._check_whole(nodes, splats, scene.kept)
        up = unit_up(self._options.up or DEFAULT_UP)
        of_splats = self._options.as_splats
        turn = self._source.from_file_axes if self._origin.any() else np.eye(3)
        axes = turn if on_globe(turn.T @ self._origin, turn.T @ up) else None
        write_tilesets(self._out, nodes, root, up, splats, self._origin, axes, of_splats=of_splats)
        alpha = self._alpha(scene, nodes)
        triangles = sum(node.triangles for node in leaves)
        size = sum(path.stat().st_size for path in self._out.rglob("*") if path.is_file())
        levels, error = _height(nodes, root), nodes[root].error
        return TilesetSummary(splats, triangles, len(nodes), levels, size, error, alpha, axes is not None)

    def _check_whole(self, nodes: dict[str, Node], splats: int, kept: int) -> None:
        """FileFormatError where tiles, or some of their splats, are no longer there. A power cut leaves files
        empty."""
        gone = [key for key in nodes if not _holds_data(self._out / tile_path(key))]
        if gone or splats != kept:
            what = f"{splats:,} of {kept:,} splats are left"
            what = f"{tile_path(gone[0])} is missing or empty" if gone else what
            raise FileFormatError(
                f"{self._folder}: {what}, though the journal has all: begin again with ``replace_old``"
            )

    def _alpha(self, scene: Survey, nodes: dict[str, Node]) -> AlphaChoice | None:
        """The alpha mode of the tiles, after choosing it if that is asked for. They are written with 'mask',
        in whose place the choice fits."""
        if self._options.as_splats:
            return None
        if self._options.alpha != "auto":
            return AlphaChoice(self._options.alpha)
        noted = self.journal.find("alpha")
        if noted is None:
            self._show("choosing the alpha mode", None)
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

    def _tiles(self, threads: int | None) -> Shared[TileWriter]:
        return Shared(partial(TileWriter, self._folder, self._options, threads))

    def _check_start(self) -> None:
        """Notes what the run is about, or refuses to resume another one."""
        facts = start_facts(self._source, self._options)
        before = self.journal.find("start")
        if before is None:
            self.journal.add("start", **facts)
        else:
            need_same_start(before, facts, self._folder)

    def _survey(self) -> Survey:
        """The survey of the scene; that of the interrupted run if there is one."""
        path = self._work / SURVEY
        if self.journal.find("survey") is None:
            found = survey(self._passes.of("surveying the splats", 2), self._conversion)
            with atomic_path(path) as temporary:
                arrays = {
                    "counts": np.array([found.kept, found.step, found.sh_degree]),
                    "bounds": np.stack([found.low, found.high, found.origin]),
                    "kernel": np.array(found.kernel),
                    "sample": records_of(found.sample, np.zeros(len(found.sample), np.int32), 0),
                }
                np.savez(temporary, **arrays)  # type: ignore[arg-type]
            self.journal.add("survey", kept=found.kept)
        return stored_survey(path)

    def _records(self, degree: int) -> Iterator[np.ndarray]:
        passed = 0
        for block in self._passes.of("sorting the splats", 1):
            rows = worth_drawing(block, self._conversion)
            yield records_of(block.take(rows), (rows + passed).astype(np.int32), degree)
            passed += len(block)
            if passed > np.iinfo(np.int32).max:
                raise ValueError(f"{passed:,} splats are more than tiles can number")


class _Passes:
    """The splats of ``source``, passes over which are shown. How many there are is known after the first."""

    def __init__(self, source: SplatStream, show: Show) -> None:
        self._source, self._show = source, show
        self._splats = 0

    def of(self, phase: str, count: int) -> _Passes:
        """These splats for ``count`` passes, which are one ``phase``."""
        self._phase, self._count, self._past = phase, count, 0
        self._show(phase, None)
        return self

    def __iter__(self) -> Iterator[GaussianCloud]:
        done = 0
        for block in self._source:
            yield block
            done += len(block)
            if self._splats:
                self._show(self._phase, (self._past + min(1.0, done / self._splats)) / self._count)
        self._splats = done
        self._past += 1


def _holds_data(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def _height(nodes: dict[str, Node], key: str) -> int:
    return 1 + max((_height(nodes, child) for child in nodes[key].children), default=0)
