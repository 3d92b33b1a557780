"""Small good files that our own commands write and read again: configurations, checkpoints, tilesets, chains
of levels, journals, cameras and the data of pages."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Callable
from contextlib import redirect_stderr
from dataclasses import replace
from pathlib import Path

import numpy as np
from _meshes import random_mesh
from fuzz.seeds import Seed, in_gzip

from meshsplats import load_cameras, orbit, save_cameras, save_mesh
from meshsplats._common import toml
from meshsplats.blender.levels import read_chain
from meshsplats.cli import arguments
from meshsplats.cli.arguments import Command
from meshsplats.cli.convert import Convert
from meshsplats.cli.finetune import Finetune
from meshsplats.cli.messages import UsageError
from meshsplats.finetuning.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.finetuning.journal import CHECKPOINT, METRICS
from meshsplats.finetuning.journal import Journal as Metrics
from meshsplats.finetuning.pace import RECORD, StartRecord
from meshsplats.finetuning.state import State
from meshsplats.tiles.journal import Journal
from meshsplats.tiles.tileset import LEVELS_PER_FILE, NAME, Node, Tileset, tile_path, write_tilesets
from meshsplats.viewer.packing import pack_mesh
from meshsplats.viewer.quantise import PRECISIONS
from meshsplats.viewer.unpacking import unpack_mesh

_MESH = replace(random_mesh(np.random.default_rng(0), 6, 5), normals=None)
_VIEWS = 3


def _files(write: Callable[[Path], object]) -> dict[str, bytes]:
    """What ``write`` leaves in the folder that it is given, by names relative to it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder)
        found = sorted(path for path in folder.rglob("*") if path.is_file())
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def _configurations(command: type[Command], name: str, options: dict[str, object]) -> list[Seed]:
    """A configuration alone, and, slowly, within a command line."""
    record = {"command": name, "version": "0.1.0", "options": options, "resolved": {"sides": 6}}
    files = {"a.toml": toml.dumps(record).encode()}
    errors = (UsageError, ValueError, OSError)

    def read(path: Path) -> None:
        values, resolved = arguments._read(command, path, name)
        arguments._warn_of_changes(command, path, values, resolved)

    def parse(path: Path) -> Command:
        words = ["other.ply", "-o", "other.npz", "--config", str(path)]
        try:
            with redirect_stderr(io.StringIO()):
                return arguments.parse(command, f"meshsplats {name}", words)
        except SystemExit as stop:
            raise UsageError(f"exit code {stop.code}") from None

    return [
        Seed(f"config-{name}", files, "a.toml", load=read, errors=errors),
        Seed(f"command-{name}", files, "a.toml", load=parse, errors=errors, slow=True),
    ]


def _checkpoint(folder: Path) -> None:
    config = FinetuneConfig(exposure=True)
    state = State.begin(_MESH, _VIEWS, config, 1)
    state.frozen = np.arange(len(_MESH.vertices)) < 2
    save_checkpoint(
        Checkpoint(3, 1.5, config.to_dict(), "m", "d", state.arrays(), (0.5, 0.25)), folder / CHECKPOINT
    )


def _resumed(folder: Path) -> State:
    found = load_checkpoint(folder / CHECKPOINT)
    return State.resume(found.arrays, "display", "fragment", _VIEWS, FinetuneConfig(exposure=True), 1)


def _tileset(folder: Path, origin: tuple[float, float, float]) -> None:
    """A root with two tiles, one of which goes on in a tileset file of its own."""
    counts = (9, len(_MESH.faces), len(_MESH.vertices))
    deep = ["0" * n for n in range(1, LEVELS_PER_FILE + 2)]
    children = {"": ["0", "1"], "1": [], **{key: [key + "0"] for key in deep[:-1]}, deep[-1]: []}
    nodes = {
        key: Node(key, [-1, -1, -1], [1, 1, 1], 2.0 ** -len(key), *counts, below)
        for key, below in children.items()
    }
    write_tilesets(folder, nodes, "", np.array([0.0, 0, 1]), 9, np.array(origin))
    for key in nodes:
        path = folder / tile_path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_mesh(_MESH, path)


def _tileset_seed(name: str, origin: tuple[float, float, float]) -> Seed:
    def load(folder: Path) -> None:
        for tile, _ in Tileset(folder).tiles():
            if not tile.is_file:
                tile.load()

    files = _files(lambda folder: _tileset(folder, origin))
    changed = tuple(path for path in files if path.endswith(NAME))
    return Seed(name, files, ".", load=load, changed=changed)


def _chain(folder: Path) -> None:
    rows = [{"file": f"{i}.glb", "screen_size": 800 >> i, "triangles": 12} for i in range(2)]
    (folder / "levels.json").write_text(json.dumps({"levels": rows}))
    for row in rows:
        (folder / str(row["file"])).write_bytes(b"")


def _steps(path: Path) -> None:
    journal = Journal(path)
    journal.find("survey")
    journal.keys("cell")


_LINES = b'{"step": "survey", "low": [0, 1], "splats": 9}\n{"step": "cell", "key": "01"}\n{"step": "c'
_METRICS = b'{"step": 1, "loss": 0.5, "time": "2026-01-01T00:00:00+00:00"}\n{"step": 2, "loss": 0.25}\n'
_3DGS = [
    {
        "id": i,
        "img_name": f"a{i}",
        "width": 12,
        "height": 8,
        "position": [i, 0.5, -1],
        "rotation": np.eye(3).tolist(),
        "fx": 10.0,
        "fy": 11.0,
    }
    for i in range(2)
]
RECORD_SEEDS = [
    *_configurations(
        Convert,
        "convert",
        {"input": ["scene.ply"], "look": "area", "sides": 6, "crop": [0.0, 0.5, 0, 1, 1, 1.5], "lit": True},
    ),
    *_configurations(
        Finetune, "finetune", {"minutes": 2.5, "opacity": "cutoff", "data": "../photos", "threads": 1}
    ),
    Seed("checkpoint", _files(_checkpoint), ".", load=_resumed),
    _tileset_seed("tileset", (0, 0, 0)),
    _tileset_seed("tileset-origin", (5e5, 4.5e6, 100)),
    Seed("levels", _files(_chain), "levels.json", load=read_chain, changed=("levels.json",)),
    Seed("journal", {"journal.jsonl": _LINES}, "journal.jsonl", load=_steps),
    Seed("metrics", {METRICS: _METRICS}, ".", load=lambda folder: Metrics(folder).metrics()),
    Seed(
        "start",
        {RECORD: b'{"max_splats": 500, "images": 8, "brief_steps": null}'},
        ".",
        load=StartRecord.load,
    ),
    Seed(
        "page-mesh",
        {"a.gz": pack_mesh(_MESH, PRECISIONS[0], 1.0)},
        "a.gz",
        in_gzip,
        load=lambda path: unpack_mesh(path.read_bytes()),
        errors=(ValueError,),
    ),
    Seed(
        "cameras",
        _files(lambda folder: save_cameras(orbit(_MESH, 2, width=12, height=8), folder / "a.json")),
        "a.json",
        load=load_cameras,
    ),
    Seed("cameras-3dgs", {"cameras.json": json.dumps(_3DGS).encode()}, "cameras.json", load=load_cameras),
]
