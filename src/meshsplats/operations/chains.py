"""A chain of levels of detail in a folder, made level by level: interrupted, it can go on."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from meshsplats._common.kinds import as_path
from meshsplats._files.atomic import replace_folder, write_json
from meshsplats.conversion.gaps import without_gaps
from meshsplats.errors import FileFormatError
from meshsplats.evaluation.level_tables import TABLE, load_table
from meshsplats.evaluation.viewers import AlphaChoice, choose_alpha
from meshsplats.finetuning import FinetuneConfig, Progress, RunOptions
from meshsplats.finetuning.checkpoint import cloud_digest
from meshsplats.formats.meshes import save_mesh
from meshsplats.formats.outputs import CONFIGURATION, check_outputs, check_resumption
from meshsplats.levels import (
    SAMPLES,
    Level,
    level_targets,
    likeness,
    likeness_to_views,
    make_level,
    make_ordered_level,
    merged,
    merges_further,
    plan_levels,
    views_to_score,
)
from meshsplats.operations.options import ChainOptions
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

OnLevel = Callable[[int, Level], AbstractContextManager[Callable[[Progress], None] | None]]


def planned(options: ChainOptions, splats: int) -> list[Level]:
    """The levels of so many ``splats`` (``plan_levels``). ValueError for orders that contradict each
    other."""
    if options.alpha == "ordered" and options.order not in (None, "fragment"):
        raise ValueError("alpha 'ordered' has an order of its own: leave out order")
    most = splats if options.max_splats is None else min(options.max_splats, splats)
    return plan_levels(most, options.levels, factor=options.factor, width=options.width)


def partial_folder(folder: Path) -> Path:
    """Where the chain ``folder`` lies until it is complete."""
    return folder.with_name(f"{folder.name}.partial")


def check_folder(folder: Path, *, resume: bool = False, replace_old: bool = False) -> None:
    """Checks whether ``folder`` can become a chain: a new one, one in place of an older, or with ``resume``
    that of an interrupted run.

    Raises:
        FileExistsError: it exists and is not to be replaced or is no chain, or a partial one is left.
        FileNotFoundError: there is nothing to resume.
        OSError: it cannot be written.
    """
    unfinished = partial_folder(folder)
    _older_levels(folder)
    check_resumption(folder, unfinished, CONFIGURATION, resume=resume, replace_old=replace_old)
    check_outputs([folder], replace_old or resume)


def _older_levels(folder: Path) -> list[dict[str, Any]]:
    """The rows of the chain in ``folder``, none if it does not exist. FileExistsError if it is no chain."""
    if not folder.exists():
        return []
    if not (folder / TABLE).is_file():
        raise FileExistsError(f"{folder} is there and holds no {TABLE}: give another folder")
    try:
        rows: list[dict[str, Any]] = load_table(folder / TABLE)["levels"]
        return rows
    except FileFormatError as error:
        raise FileExistsError(f"{error}: give another folder") from None


def begin_folder(folder: Path) -> Path:
    """Makes ``partial_folder(folder)``, empty, and returns it. FileExistsError for one that is no chain's."""
    unfinished = partial_folder(folder)
    if unfinished.exists():
        check_resumption(folder, unfinished, CONFIGURATION, resume=False, replace_old=True)
        shutil.rmtree(unfinished)
    unfinished.mkdir()
    return unfinished


def make_chain(
    cloud: GaussianCloud,
    folder: str | os.PathLike[str],
    options: ChainOptions | None = None,
    config: FinetuneConfig | None = None,
    *,
    source: str = "",
    place: Callable[[SplatMesh], SplatMesh] = lambda mesh: mesh,
    on_level: OnLevel = lambda number, level: nullcontext(),
) -> dict[str, Any]:
    """Makes the chain of ``cloud`` in ``partial_folder(folder)`` and renames that to ``folder``, in place of
    an older one, of which files that are none of the chain stay. Levels that are finished there are kept.
    Returns the table of ``levels.json``.

    Args:
        cloud: the splats, which become larger if gaps would show between them (DataWarning).
        folder: where the chain appears when all its levels are done.
        options: of the meshes and files.
        config: of the fine-tuning of each level; None: converted only.
        source: the name of ``cloud`` in the table.
        place: makes of a mesh the one that is written.
        on_level: entered for each level that is made; what it gives is shown the progress.

    Raises Interrupted after Ctrl-C in a level, whose predecessors stay, FileExistsError for a ``folder`` that
    is no chain, FileFormatError where levels of other splats are finished, and what ``plan_levels`` raises.
    """
    folder = as_path("folder", folder)
    _older_levels(folder)  # an error before the work
    chosen, unfinished = options or ChainOptions(), partial_folder(folder)
    chain = planned(chosen, len(cloud))
    digest = cloud_digest(cloud)
    cloud = without_gaps(cloud, chosen.threads)
    unfinished.mkdir(exist_ok=True)
    rows, records = [], []
    splats, waiting = cloud, list[Level]()  # splats that are merged further, and for which levels
    for number, level in enumerate(chain):
        records.append(unfinished / f"level_{number}.json")
        waiting.append(level)
        if not records[-1].is_file():
            path = unfinished / f"level_{number}.{chosen.format}"
            with on_level(number, level) as show:
                row, splats = _made(cloud, splats, waiting, path, chosen, config, place, show)
            waiting = []
            write_json(records[-1], row | {"scene": digest})
        rows.append(json.loads(records[-1].read_text(encoding="utf-8")))
        if rows[-1].pop("scene", digest) != digest:
            raise FileFormatError(
                f"{unfinished}: level {number} was made of other splats: ``resume`` with the same, or begin"
                " again with ``replace_old``"
            )
    table = {
        "source": source,
        "splats": len(cloud),
        "factor": chosen.factor,
        "look": "area",
        "samples": SAMPLES,
        "levels": rows,
    }
    write_json(unfinished / TABLE, table)
    older = [Path(row["file"]) for row in _older_levels(folder)]
    own = {TABLE, CONFIGURATION, *(name for file in older for name in (file.name, f"{file.stem}.json"))}
    replace_folder(unfinished, folder, own.__contains__)
    for record in records:  # last: without them a run that is interrupted here would begin again
        (folder / record.name).unlink()
    return table


def _as_first(choice: AlphaChoice, record: Path) -> AlphaChoice:
    """``choice`` with the mode of the first level, of ``record``, where there is one: nothing becomes
    see-through when a viewer changes levels."""
    if not record.is_file():
        return choice
    first = json.loads(record.read_text(encoding="utf-8"))["alpha"]["alpha"]
    return replace(choice, alpha=first) if {first, choice.alpha} == {"blend", "mask"} else choice


def _made(
    cloud: GaussianCloud,
    splats: GaussianCloud,
    waiting: Sequence[Level],
    path: Path,
    chosen: ChainOptions,
    config: FinetuneConfig | None,
    place: Callable[[SplatMesh], SplatMesh],
    show: Callable[[Progress], None] | None,
) -> tuple[dict[str, Any], GaussianCloud]:
    """Writes the mesh of the last level ``waiting`` to ``path``; its row of the table, and the splats that
    the next levels are made of. ``splats``: those of this one and the levels before it that wait."""
    start, level, threads = time.perf_counter(), waiting[-1], chosen.threads
    drawn = {"up": chosen.up, "sh_degree": chosen.sh_degree, "threads": threads}
    targets = level_targets(cloud, level, config, **drawn)
    cameras = [view.camera for view in targets.test]
    own = splats
    for each in waiting if config is None else ():
        if each is level or merges_further(each):
            seen = level_targets(cloud, each, config, **drawn).views
            own = merged(splats, each, [view.camera for view in seen], threads)
            splats = own if merges_further(each) else splats
    run = RunOptions(threads=threads, spent=time.perf_counter() - start)
    if chosen.order is not None and config is not None:
        config = replace(config, order=chosen.order)
    how: dict[str, Any] = {"run": run, "on_progress": show, "up": chosen.up}
    order = None
    if chosen.alpha == "ordered":
        mesh, order = make_ordered_level(own, level, targets, config, **how)
    else:
        mesh = make_level(own, level, targets, config, **how)
    if chosen.order is not None:
        mesh = replace(mesh, order=chosen.order)
    choice = None
    if chosen.alpha == "auto" and chosen.format == "glb":
        choice = _as_first(choose_alpha(mesh, cameras, threads=threads), path.with_name("level_0.json"))
    asked = {} if chosen.alpha == "auto" else {"alpha": chosen.alpha}
    scored = cameras if config is not None else cameras[: views_to_score(len(mesh.faces), len(cloud))]
    if order is None:
        save_mesh(place(mesh), path, **(asked if choice is None else choice.options))
        score = likeness(mesh, cloud, scored, sh_degree=chosen.sh_degree, threads=threads)
    else:
        save_mesh(place(mesh), path, order=order)
        score = likeness_to_views(mesh, targets.test[: len(scored)], threads, order)
    row = {
        "file": path.name,
        "splats": mesh.splat_count,
        "triangles": len(mesh.faces),
        "bytes": path.stat().st_size,
        "screen_size": level.width,
        "psnr": round(score, 3),
        "views": len(scored),
        "alpha": asdict(choice) if choice else asked or None,
        "seconds": round(time.perf_counter() - start, 2),
    }
    return row, splats
