"""Runs that are ready to begin, and what becomes of them: sizes, memory, scores, in words."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

from meshsplats._common.words import plural
from meshsplats._files.atomic import in_words
from meshsplats.datasets.views import Dataset
from meshsplats.evaluation.backgrounds import Background, choose_background
from meshsplats.finetuning.baseline import SizeScores
from meshsplats.finetuning.checkpoint import Checkpoint
from meshsplats.finetuning.config import BACKGROUNDS, FinetuneConfig
from meshsplats.finetuning.journal import Journal
from meshsplats.finetuning.memory import available_memory, check_memory, readable
from meshsplats.finetuning.reports import SCORED_VIEWS
from meshsplats.finetuning.run_files import RunFiles
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.finetuning.setup import Display
from meshsplats.finetuning.step import samples_of
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh


@dataclass(frozen=True)
class Trained:
    """The end of an optimisation."""

    saved: SplatMesh
    """As the output file has it."""
    shown: SplatMesh
    """As the preview has it."""
    counts: Mapping[str, int]
    """Sizes, for JSON."""
    summary: str
    """Sizes, in words."""
    saving: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of ``save_mesh``; none: the alpha mode is measured."""
    sizes: SizeScores | None = None
    """The conversion of splats against the tuned mesh."""


@dataclass(frozen=True)
class Plan:
    """An optimisation that is ready to run."""

    mesh: SplatMesh | None
    """What is optimised; None if it is made on the way."""
    dataset: Dataset
    summary: str
    background: Background | None
    """That of photographs; None without them."""
    optimise: Callable[[RunOptions, Display], Trained]
    _: KW_ONLY
    reserve: float = 0.0
    """Seconds that ``optimise`` and what saves its result need after the last step."""
    rates: Mapping[str, float] = field(default_factory=dict)
    """Learning rates that differ from those of the configuration."""
    needed: int | None = None
    """Estimated memory in bytes, which is there; None: that of fine-tuning ``mesh``, if there is one."""

    def in_words(self, cache_bytes: int) -> str:
        """Sizes and the memory that is needed, with images of so many bytes in it. MemoryError if it is not
        there."""
        dataset, needed = self.dataset, self.needed
        if needed is None and self.mesh is not None:
            needed = check_memory(self.mesh, dataset, cache_bytes=cache_bytes)
        camera, count = dataset.train[0].camera, len(dataset.train)
        text = f"{self.summary}; {plural(count, 'training view')}, {len(dataset.test)} held out"
        text += f", of {camera.width} x {camera.height} pixels"
        if needed is not None:
            free = available_memory()
            text += f"; memory: about {readable(needed)}" + (f" of {readable(free)} free" if free else "")
        return text

    def scored(self, config: FinetuneConfig) -> dict[str, Any]:
        """What the scores of a run compare: the look of the targets, and the samples of the mesh."""
        view = (self.dataset.test or self.dataset.train)[0]
        return {"look": self.dataset.look, "samples": samples_of(view, config)}


def over_background(
    dataset: Dataset,
    scene: GaussianCloud | SplatMesh,
    config: FinetuneConfig,
    source: Path,
    threads: int | None,
    *,
    whole: bool = True,
    say: Callable[[str], object] = lambda text: None,
) -> tuple[Dataset, Background]:
    """``dataset`` of photographs over the background of the training, and that background: the one that the
    configuration or the model folder ``source`` names, else the one that fits ``scene`` best. ``say`` gets a
    line about it. ``whole``: whether the scene is all that the photographs show."""
    color = BACKGROUNDS.get(config.background)
    kind = "splats" if isinstance(scene, GaussianCloud) else "mesh"
    found = choose_background(color, dataset, {kind: scene}, source, threads, whole=whole)
    say(f"background: {found.describe()}")
    return dataset.over(found.color), found


@dataclass(frozen=True)
class RunResult:
    """A run that has ended, as its folder tells of it."""

    files: RunFiles
    trained: Trained
    seconds: float
    """Of the whole run, or of what followed the ``earlier`` part."""
    scored: Mapping[str, Any]
    """As of ``Plan.scored``."""
    most_views: int
    """Held-out views, where all of them are scored."""
    earlier: Checkpoint | None = None
    """Of the part before the run was resumed."""

    @property
    def _lines(self) -> list[dict[str, Any]]:
        return Journal(self.files.folder).metrics()

    @property
    def _total(self) -> float:
        return self.seconds + (0 if self.earlier is None else self.earlier.seconds)

    def to_dict(self) -> dict[str, Any]:
        """Counts, scores and seconds, for JSON."""
        lines, sizes = self._lines, self.trained.sizes
        scores = [line["psnr"] for line in lines if line.get("psnr") is not None]
        before = None if self.files.in_cells or not scores else scores[0]
        return {
            "mesh": str(self.files.mesh),
            "steps": lines[-1]["step"] if lines else 0,
            "seconds": round(self._total, 2),
            "seconds_since_resumed": None if self.earlier is None else round(self.seconds, 2),
            **self.trained.counts,
            "held_out_psnr": {"before": before, "after": scores[-1]} if scores else None,
            **self.scored,
            **({} if sizes is None else sizes.to_dict()),
            "run": str(self.files.folder),
        }

    def in_words(self) -> Iterator[str]:
        """Lines with the same, and what they mean; names of options stand in double backquotes."""
        lines, files = self._lines, self.files
        scores = [line["psnr"] for line in lines if line.get("psnr") is not None]
        steps = lines[-1]["step"] if lines else 0
        resumed = "" if self.earlier is None else f", {self.seconds:.1f} s of it since it was resumed"
        quality = f"; held out: {scores[0]:.2f} -> {scores[-1]:.2f} dB" if scores else ""
        if len(scores) == 1:
            quality = f"; held out: {scores[0]:.2f} dB"
        if scores:
            samples, count = self.scored["samples"], lines[-1].get("views") or SCORED_VIEWS
            quality += f" (look {self.scored['look']}, {samples} x {samples} samples"
            quality += f", {_views(count)})" if count < min(self.most_views, SCORED_VIEWS) else ")"
        made = f"{files.mesh} ({in_words(files.mesh.stat().st_size)}, {self.trained.summary})"
        yield f"{made}: {steps:,} steps in {self._total:.1f} s{resumed}{quality}"
        yield from _sizes_in_words(self.trained.sizes, steps if lines or self.trained.sizes else None)
        yield f"preview: {files.preview}" + (f"; metrics: {files.folder}/metrics.jsonl" if lines else "")


def _views(count: int) -> str:
    return f"{count:,} view" + ("" if count == 1 else "s")


def _sizes_in_words(sizes: SizeScores | None, steps: int | None) -> Iterator[str]:
    """At each image width, the conversion against the tuned mesh; which one was written, if not that; and
    whether no step was taken. ``steps``: None if unknown."""
    if sizes is not None:
        pairs = (
            f"{width} px {old:.1f}" + (f" -> {sizes.tuned[width]:.1f}" if steps else "")
            for width, old in sizes.converted.items()
        )
        yield f"converted{' -> tuned' if steps else ''}, dB: {', '.join(pairs)}"
    if sizes is not None and sizes.loses:
        where = ", ".join(str(width) for width in sizes.worse_at)
        count = f"{steps or 0:,} step" + ("" if steps == 1 else "s")
        yield f"the conversion is written: after {count}, the mesh was worse at {where} px;"
        yield "  start a longer run; ``resume`` would keep the starting mesh of the short one"
    elif steps == 0:
        yield "there was no time for steps: this is the mesh at the start; more ``minutes`` help"
