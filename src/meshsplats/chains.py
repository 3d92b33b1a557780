"""A chain of levels of detail in a folder, made level by level: interrupted, it can go on."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from meshsplats._files.atomic import in_words, replace_folder, write_text
from meshsplats._options import check_options
from meshsplats.errors import OptionsError
from meshsplats.evaluation.viewers import choose_alpha
from meshsplats.finetuning import FinetuneConfig, Progress, RunOptions, make_config
from meshsplats.formats.mesh_formats import takes
from meshsplats.formats.meshes import save_mesh
from meshsplats.formats.outputs import CONFIGURATION, MeshEnding, check_outputs
from meshsplats.gaussians import GaussianCloud
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
from meshsplats.mesh import SplatMesh
from meshsplats.order import Order
from meshsplats.rendering.looks import comparison_in_words

TABLE = "levels.json"
MINUTES = 2.0
"""Default length of the fine-tuning of a level."""
OnLevel = Callable[[int, Level], AbstractContextManager[Callable[[Progress], None] | None]]


@dataclass(frozen=True)
class ChainOptions:
    """The meshes of a chain and their files."""

    levels: int = 4
    """Number of meshes."""
    factor: Literal[2, 4] = 4
    """Splats of each level per splat of the next: 4, for half the size on the screen, or 2."""
    width: int = 800
    """Screen size of the finest level: side in pixels of images that just hold the subject."""
    max_splats: int | None = None
    """Maximum number of splats of the finest level. Default: all."""
    format: MeshEnding = "glb"
    """File format of the meshes."""
    alpha: Literal["auto", "blend", "mask", "opaque", "ordered"] = "auto"
    """.glb: auto: blend or mask for each level, whichever is nearer to the sorted image in viewers that do
    not sort; mask: viewers draw as solid what is at least 20 % opaque. opaque (any format): solid triangles,
    cut there. ordered: in an order of blending, tuned through it, for web viewers and engines that cull."""
    order: Order | None = None
    """In which triangles are blended and tuned; None: that of the meshes and of the configuration."""
    sh_degree: int | None = None
    """Render the splats with spherical harmonics up to this degree. Default: all that are stored."""
    up: Sequence[float] | np.ndarray | None = None
    """Direction that points up in the world; None: that of the splats."""
    threads: int | None = None
    """Maximum number of threads; None: all processors."""

    def check(self) -> None:
        """OptionsError for options that are out of range or have no effect."""
        check_options(self)
        if self.levels < 1:
            raise OptionsError(f"``levels`` must be at least 1, got {self.levels}")
        if self.max_splats is not None and self.max_splats < 1:
            raise OptionsError(f"``max_splats`` must be at least 1, got {self.max_splats}")
        if self.alpha not in ("auto", "opaque") and not takes(f"level.{self.format}", "alpha"):
            raise OptionsError(f"``alpha`` {self.alpha} is for .glb files, not .{self.format}")

    def plan(self, splats: int) -> list[Level]:
        """The levels of so many ``splats`` (``plan_levels``). ValueError for orders that contradict each
        other."""
        if self.alpha == "ordered" and self.order not in (None, "fragment"):
            raise ValueError("alpha 'ordered' has an order of its own: leave out order")
        most = splats if self.max_splats is None else min(self.max_splats, splats)
        return plan_levels(most, self.levels, factor=self.factor, width=self.width)


@dataclass(frozen=True)
class LevelTuning:
    """How long each level is fine-tuned."""

    no_tune: bool = False
    """Convert only: seconds in place of minutes."""
    minutes: float | None = None
    """Length of the fine-tuning of each level. Default: 2."""
    steps: int | None = None
    """Length of the fine-tuning of each level, in place of ``minutes``."""

    def config(self) -> FinetuneConfig | None:
        """The configuration for ``make_chain``. OptionsError for lengths that contradict each other."""
        if self.no_tune and (self.minutes is not None or self.steps is not None):
            raise OptionsError("``minutes`` and ``steps`` have no effect with ``no_tune``")
        if self.minutes is not None and self.steps is not None:
            raise OptionsError("give ``minutes`` or ``steps``, not both")
        if self.no_tune:
            return None
        if self.steps is not None:
            return make_config("default", steps=self.steps)
        return make_config("default", minutes=MINUTES if self.minutes is None else self.minutes)


def partial_folder(folder: Path) -> Path:
    """Where the chain ``folder`` lies until it is complete."""
    return folder.with_name(f"{folder.name}.partial")


def check_folder(folder: Path, *, resume: bool = False, replace_old: bool = False) -> None:
    """Checks whether ``folder`` can become a chain: a new one, one in place of an older, or with ``resume``
    that of an interrupted run.

    Raises:
        FileExistsError: it exists and is not to be replaced or holds something else, or a partial one is
            left.
        FileNotFoundError: there is nothing to resume.
        OSError: it cannot be written.
    """
    unfinished = partial_folder(folder)
    check_outputs([folder], replace_old)
    if folder.exists() and not (folder / TABLE).is_file():
        raise FileExistsError(f"{folder} is there and holds no {TABLE}: give another folder")
    if resume and not (unfinished / CONFIGURATION).is_file():
        raise FileNotFoundError(f"nothing to resume in {unfinished}: leave out --resume to start again")
    if unfinished.exists() and not resume and not replace_old:
        raise FileExistsError(
            f"{unfinished} is left from an earlier run: --resume continues it, --force starts again"
        )


def begin_folder(folder: Path) -> Path:
    """Makes ``partial_folder(folder)``, empty, and returns it. FileExistsError for one that is no chain's."""
    unfinished = partial_folder(folder)
    if unfinished.exists():
        if not (unfinished / CONFIGURATION).is_file():
            raise FileExistsError(f"{unfinished} exists and is not of this command: remove it")
        shutil.rmtree(unfinished)
    unfinished.mkdir()
    return unfinished


def make_chain(
    cloud: GaussianCloud,
    folder: Path,
    options: ChainOptions | None = None,
    config: FinetuneConfig | None = None,
    *,
    source: str = "",
    place: Callable[[SplatMesh], SplatMesh] = lambda mesh: mesh,
    on_level: OnLevel = lambda number, level: nullcontext(),
) -> dict[str, Any]:
    """Makes the chain of ``cloud`` in ``partial_folder(folder)`` and renames that to ``folder``, in place of
    an older one. Levels that are finished there are kept. Returns the table of ``levels.json``.

    Args:
        cloud: the splats.
        folder: where the chain appears when all its levels are done.
        options: of the meshes and files.
        config: of the fine-tuning of each level; None: converted only.
        source: the name of ``cloud`` in the table.
        place: makes of a mesh the one that is written.
        on_level: entered for each level that is made; what it gives is shown the progress.

    Raises Interrupted after Ctrl-C in a level, whose predecessors stay, and what ``plan_levels`` raises.
    """
    chosen, unfinished = options or ChainOptions(), partial_folder(folder)
    chain = chosen.plan(len(cloud))
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
            write_text(records[-1], json.dumps(row, indent=1, allow_nan=False) + "\n")
        rows.append(json.loads(records[-1].read_text(encoding="utf-8")))
    table = {
        "source": source,
        "splats": len(cloud),
        "factor": chosen.factor,
        "look": "area",
        "samples": SAMPLES,
        "levels": rows,
    }
    for record in records:
        record.unlink()
    write_text(unfinished / TABLE, json.dumps(table, indent=1, allow_nan=False) + "\n")
    replace_folder(unfinished, folder)
    return table


def table_in_words(table: dict[str, Any], folder: Path) -> list[str]:
    """Lines with the ``table`` of the chain in ``folder``."""
    rows, glb = table["levels"], any(row["file"].endswith(".glb") for row in table["levels"])
    heads = f"{'level':<16}{'splats':>12}{'triangles':>12}{'size':>10}{'pixels':>8}{'dB':>8}{'seconds':>9}"
    lines = [f"{heads}  alpha" if glb else heads]
    for row in rows:
        lines.append(
            f"{row['file']:<16}{row['splats']:>12,}{row['triangles']:>12,}{in_words(row['bytes']):>10}"
            f"{row['screen_size']:>8}{row['psnr']:>8.2f}{row['seconds']:>9.1f}"
            + (f"  {row['alpha']['alpha']}" if glb and row["alpha"] else "")
        )
    views = sorted({row["views"] for row in rows})
    count = " to ".join(map(str, (views[0], views[-1])[: len(views)]))
    lines.append(f"{comparison_in_words(table['look'], table['samples'])}; {count} views")
    return [*lines, f"{folder}/: {TABLE} has this table"]


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
            seen = level_targets(cloud, each, config, **drawn).test
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
        choice = choose_alpha(mesh, cameras, threads=threads)
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
