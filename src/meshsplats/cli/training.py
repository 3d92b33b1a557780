"""What ``finetune`` and ``prior`` share: options of an optimisation, its files, how it is shown and told."""

from __future__ import annotations

import errno
import json
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol, get_args, get_type_hints

import tyro

from meshsplats._files.locks import locked
from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import UsageError
from meshsplats.cli.common import (
    check_outputs,
    chosen_background,
    configuration,
    plural,
    recorded_options,
    size_of,
    write_json,
)
from meshsplats.cli.targets import TargetOptions
from meshsplats.datasets.views import Dataset
from meshsplats.evaluation.backgrounds import Background
from meshsplats.finetuning import FinetuneConfig, Interrupted, Progress, RunOptions
from meshsplats.finetuning.checkpoint import Checkpoint, OtherRunError
from meshsplats.finetuning.config import LENGTHS
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

STARTING_UP = 1.0
"""Seconds that Python and the libraries take before the command's own clock begins."""


class TrainingCommand(Protocol):
    """The options that ``finetune`` and ``prior`` share."""

    @property
    def target(self) -> TargetOptions: ...
    @property
    def tuning(self) -> FinetuneConfig: ...
    @property
    def resume(self) -> bool: ...
    @property
    def report_every(self) -> int: ...
    @property
    def preview_every(self) -> int: ...
    @property
    def threads(self) -> int | None: ...
    @property
    def json(self) -> bool: ...


def described(config: type[FinetuneConfig], standard: FinetuneConfig | None = None) -> type[FinetuneConfig]:
    """The choices of a configuration as options that may be left out; their docstrings are the help. Values
    that they have then are those of ``standard``, or the preset default's."""
    typed: dict[str, Any] = {}
    values: dict[str, Any] = {"__post_init__": lambda self: None}
    for name, hint in get_type_hints(config).items():
        if name in ("preset", "epochs", "steps", "minutes"):
            typed[name] = tyro.conf.Suppress[object]  # type: ignore[misc]
        else:
            hint = next((part for part in get_args(hint) if part in (int, float)), hint)  # of those or None
            choices = "{" + ",".join(map(str, get_args(hint))) + "}"
            metavar = {int: "N", float: "X", bool: "{True,False}"}.get(hint, choices)
            told = f"(default preset: {getattr(FinetuneConfig, name)})"
            if standard is not None:
                told = f"(default: {getattr(standard, name)})"
            typed[name] = Annotated[hint | None, tyro.conf.arg(metavar=metavar, help_behavior_hint=told)]
        values[name] = None
    about = "What is not given is left to the preset."
    made = type("TuningOptions", (config,), {"__annotations__": typed, "__doc__": about, **values})
    return dataclass(frozen=True)(made)


@dataclass(frozen=True)
class RunFiles:
    """Where the results of a run go."""

    mesh: Path

    @property
    def config(self) -> Path:
        return self.mesh.with_suffix(".config.json")

    @property
    def preview(self) -> Path:
        return self.mesh.with_suffix(".preview.png")

    @property
    def run(self) -> Path:
        return self.mesh.with_suffix(".run")

    @property
    def command(self) -> Path:
        """What the run was asked for, while it is not done."""
        return self.run / "command.json"

    @property
    def held_out(self) -> Path:
        """Cameras of the pictures that were held out, where they were drawn."""
        return self.run / "held_out.cameras.json"

    def check(self, inputs: Sequence[Path], *, resume: bool, force: bool) -> None:
        """Before the work: OSError if something would be overwritten, cannot be written, or is missing to go
        on from."""
        from meshsplats.finetuning.journal import CHECKPOINT

        checkpoint = self.run / CHECKPOINT
        if resume and not checkpoint.is_file():
            raise FileNotFoundError(f"no checkpoint at {checkpoint}: leave out --resume to begin anew")
        if checkpoint.exists() and not (resume or force):
            raise FileExistsError(
                f"{checkpoint} is left from an earlier run: --resume goes on with it, --force begins anew"
            )
        if resume and self.mesh.exists() and not force:
            raise FileExistsError(
                f"{self.mesh} is there: the run has come to its end, or there was one before;"
                " --resume --force goes on and overwrites it"
            )
        check_outputs([self.mesh, self.config, self.preview], force, inputs=inputs)

    @contextmanager
    def claimed(self, inputs: Sequence[Path], *, resume: bool, force: bool) -> Iterator[None]:
        """While the block runs, no other process writes this run. FileExistsError if one does, and the errors
        of ``check``, as one may have ended meanwhile."""
        self.run.mkdir(exist_ok=True)
        try:
            with locked(self.run / ".lock") as ours:
                if not ours:
                    raise FileExistsError(
                        errno.EEXIST,
                        "another process is writing this run; give another name for the output",
                        str(self.run),
                    )
                self.check(inputs, resume=resume, force=force)
                yield
        finally:
            with suppress(OSError):
                self.run.rmdir()  # where nothing was written


def given(command: TrainingCommand) -> dict[str, Any]:
    """What of the configuration was given, its length with it."""
    tuning = {k: v for k, v in asdict(command.tuning).items() if v is not None}
    if tuning.get("exposure") and command.target.data is None:
        raise UsageError("--exposure has no effect without --data: drawn pictures are all exposed alike")
    lengths = {name: getattr(command, name) for name in ("epochs", "steps", "minutes")}
    lengths = {name: value for name, value in lengths.items() if value is not None}
    if len(lengths) > 1:
        raise UsageError(f"give one of --epochs, --steps and --minutes, not {len(lengths)}")
    return tuning | lengths


def background_of(config: FinetuneConfig) -> tuple[float, float, float]:
    """Behind pictures where the configuration names none of its own."""
    return (0.0, 0.0, 0.0) if config.background == "black" else (1.0, 1.0, 1.0)


def behind(
    dataset: Dataset,
    scene: GaussianCloud | SplatMesh,
    config: FinetuneConfig,
    source: Path,
    threads: int | None,
    *,
    whole: bool = True,
) -> tuple[Dataset, Background]:
    """``dataset`` of photographs over the background that ``scene`` is trained over, which the configuration
    or the model folder ``source`` names, or fits best; and that background. It is said."""
    given = config.background if config.background in ("black", "white") else None
    what = "splats" if isinstance(scene, GaussianCloud) else "mesh"
    found = chosen_background(given, dataset, {what: scene}, source, threads, whole=whole)
    say(f"background: {found.describe()}")
    return dataset.over(found.color), found


def announce(what: str, mesh: SplatMesh, dataset: Dataset, cache_bytes: int) -> None:
    """Says what is ahead. MemoryError if it would not fit."""
    from meshsplats.finetuning.memory import available_memory, check_memory, readable

    needed, free = check_memory(mesh, dataset, cache_bytes=cache_bytes), available_memory()
    camera = dataset.train[0].camera
    views = f"{plural(len(dataset.train), 'training view')}, {len(dataset.test)} held out"
    views += f", of {camera.width} x {camera.height} pixels"
    say(f"{what}; {views}; memory: about {readable(needed)}" + (f" of {readable(free)} free" if free else ""))


def run_options(command: TrainingCommand, files: RunFiles, began: float) -> RunOptions:
    """Those of a command that began at ``began`` by the performance counter."""
    return RunOptions(
        folder=files.run,
        resume=command.resume,
        report_every=command.report_every,
        preview_every=command.preview_every,
        threads=command.threads,
        spent=time.perf_counter() - began,
        cache_bytes=command.target.cache_bytes,
    )


def earlier_part(command: TrainingCommand, files: RunFiles) -> Checkpoint | None:
    """Of a run that is to go on, what was done, without the arrays; None for one that begins."""
    from meshsplats.finetuning.checkpoint import load_checkpoint
    from meshsplats.finetuning.journal import CHECKPOINT

    return load_checkpoint(files.run / CHECKPOINT, only_header=True) if command.resume else None


def note_command(name: str, command: TrainingCommand, files: RunFiles) -> None:
    """Keeps what a run was asked for, to tell later what differs."""
    if not command.resume:
        files.run.mkdir(exist_ok=True)
        write_json(files.command, configuration(name, command))


def naming_options(error: OtherRunError, name: str, command: TrainingCommand, files: RunFiles) -> Exception:
    """``error`` with the options that differ from those of the run that was to go on."""
    before = recorded_options(files.command, name)
    if before is None:
        return error
    now = configuration(name, command)["options"]
    differ = [key for key in now if key not in _FREE and before.get(key) != now[key]]
    if not differ:
        return OtherRunError(f"{error}. No option differs, so the files themselves have changed")
    told = ", ".join(
        f"--{key.replace('_', '-')} was {_said(before.get(key))} and is {_said(now[key])}" for key in differ
    )
    return OtherRunError(f"{error}. Options that differ: {told}")


def _said(value: Any) -> str:
    if value is None:
        return "not given"
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


_FREE = {
    *("resume", "force", "json", "threads", "report_every", "preview_every", "cache", "output"),
    *LENGTHS,
}
"""Options that may change when a run goes on."""


def stopped(stop: Interrupted, files: RunFiles) -> int:
    """Says how to go on; returns the exit status."""
    say(f"stopped after step {stop.step:,}; the checkpoint is in {files.run}: the same command with")
    say("  --resume goes on from there")
    return 128 + (stop.signal or signal.SIGINT)


def tell(
    command: TrainingCommand,
    files: RunFiles,
    seconds: float,
    earlier: Checkpoint | None,
    counts: dict[str, int],
    made: str,
) -> None:
    """Prints what came of it: JSON with ``counts``, or text in which ``made`` stands for them. It took
    ``seconds`` since it was begun, or resumed after what was done ``earlier``."""
    from meshsplats.finetuning.journal import Journal

    lines = Journal(files.run).metrics()
    scores = [line["psnr"] for line in lines if line.get("psnr") is not None]
    steps = lines[-1]["step"] if lines else 0
    total = seconds + (0 if earlier is None else earlier.seconds)
    resumed = "" if earlier is None else f", {seconds:.1f} s of it since it was resumed"
    if command.json:
        result = {
            "mesh": str(files.mesh),
            "steps": steps,
            "seconds": round(total, 2),
            "seconds_since_resumed": None if earlier is None else round(seconds, 2),
            **counts,
            "held_out_psnr": {"before": scores[0], "after": scores[-1]} if scores else None,
            "run": str(files.run),
        }
        print(json.dumps(result, indent=1))
        return
    print(
        f"{files.mesh} ({size_of(files.mesh)}, {made}): {steps:,} steps in {total:.1f} s{resumed}"
        + (f"; held out: {scores[0]:.2f} -> {scores[-1]:.2f} dB" if scores else "")
    )
    print(f"preview: {files.preview}; metrics: {files.run}/metrics.jsonl")


@contextmanager
def shown() -> Iterator[Any]:
    """A function that shows a ``Progress``: as a bar where stderr is a terminal, else a line a score."""
    if not sys.stderr.isatty():
        yield _Lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"))
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        yield _InBar(bar)


class _InBar:
    def __init__(self, bar: Bar) -> None:
        self._bar, self._task = bar, bar.add_task("fine-tuning", total=1.0, text="")
        self._loss: float | None = None

    def __call__(self, progress: Progress) -> None:
        if progress.loss is not None:  # one view's loss jumps about
            self._loss = progress.loss if self._loss is None else 0.95 * self._loss + 0.05 * progress.loss
        self._bar.update(self._task, completed=progress.fraction, text=_text(progress, self._loss))


class _Lines:
    def __init__(self) -> None:
        self._last: float | None = None

    def __call__(self, progress: Progress) -> None:
        if progress.held_out != self._last:
            self._last = progress.held_out
            say(_text(progress, progress.loss))


def _text(progress: Progress, loss: float | None) -> str:
    parts = [f"step {progress.step:,}" + (f"/{progress.steps:,}" if progress.steps else "")]
    if loss is not None:
        parts.append(f"loss {loss:.4f}")
    if progress.held_out is not None:
        parts.append(f"held out {progress.held_out:.2f} dB")
    if progress.seconds_left is not None:
        left = int(progress.seconds_left)
        parts.append(f"{left // 60}:{left % 60:02d} left")
    return ", ".join(parts)


def draw_preview(mesh: SplatMesh, path: Path) -> None:
    from meshsplats.evaluation.report import image_of
    from meshsplats.images.writing import save_image
    from meshsplats.rendering.samples import needed_samples

    camera = orbit(mesh, 1, azimuth=30, width=800, height=800)[0]
    save_image(path, image_of(mesh, camera, (1, 1, 1), samples=needed_samples(mesh, [camera]))[0])


def say(text: str) -> None:
    print(f"meshsplats: {text}", file=sys.stderr, flush=True)
