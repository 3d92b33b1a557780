"""Base of ``finetune``, ``prior`` and ``train``: options, files, progress and result of an optimisation."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

import tyro

from meshsplats._core.library import thread_count
from meshsplats._files.atomic import together
from meshsplats._words import optional_color
from meshsplats.camera import Camera
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, as_cli_options, of_presets, spelled
from meshsplats.cli.common import draw_preview, plural, size_of, written
from meshsplats.cli.messages import UsageError, command_line, say
from meshsplats.cli.progress import progress_display
from meshsplats.cli.records import configuration, write_configuration
from meshsplats.cli.targets import TargetOptions
from meshsplats.datasets.views import Dataset
from meshsplats.evaluation.backgrounds import Background, choose_background
from meshsplats.evaluation.viewers import alpha_for_viewers
from meshsplats.finetuning import FinetuneConfig, Interrupted, RunOptions
from meshsplats.finetuning.baseline import SizeScores
from meshsplats.finetuning.checkpoint import Checkpoint, OtherRunError, as_begun
from meshsplats.finetuning.config import LENGTHS, PRESETS
from meshsplats.finetuning.journal import Journal
from meshsplats.finetuning.reports import SCORED_VIEWS
from meshsplats.finetuning.run_files import RunFiles
from meshsplats.finetuning.setup import Display, Setup
from meshsplats.finetuning.step import samples_of
from meshsplats.formats.outputs import recorded_options
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.webgpu.device import open_device

Config = TypeVar("Config", bound=FinetuneConfig)
STARTUP_SECONDS = 1.0
"""Time that Python and the libraries take before the command's own clock starts."""
_CHANGEABLE = {
    *("resume", "force", "json", "threads", "device", "report_every", "preview_every", "cache", "output"),
    *("origin", *LENGTHS),
}
"""Options that may change when a run is resumed."""


if TYPE_CHECKING:
    from typing_extensions import Self


def tuning_options(
    default_of: Callable[[str], str], without: Sequence[str] = ()
) -> Callable[[type[Config]], type[Config]]:
    """``as_cli_options`` for the configuration of an optimisation. ``default_of``: the end of an option's
    help; ``without``: options that the command lacks."""
    return as_cli_options(without=("preset", *LENGTHS, *without), defaults=default_of, checked=False)


@tuning_options(of_presets(PRESETS))
class TuningOptions(FinetuneConfig):
    """In parentheses: the values of the presets."""


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
    """Seconds that ``optimise`` and the command need after the last step."""
    rates: Mapping[str, float] = field(default_factory=dict)
    """Learning rates that differ from those of the configuration."""
    needed: int | None = None
    """Estimated memory in bytes, which is there; None: that of fine-tuning ``mesh``, if there is one."""


@dataclass(frozen=True)
class TrainingCommand(Command):
    """An optimisation. Subclasses define ``configured``, ``plan`` and ``next_steps``."""

    CONFIGURABLE = True
    EXCLUSIVE: ClassVar[tuple[tuple[str, ...], ...]] = (("epochs", "steps", "minutes"), ("data", "cameras"))

    input: tyro.conf.Positional[Path]
    """Input."""
    output: option.MeshOutput
    epochs: option.Number = None
    """Length of the run: passes over all training views."""
    steps: option.Count = None
    """Length of the run: number of steps."""
    minutes: option.Number = None
    """Length of the run: time for the whole command."""
    resume: bool = False
    """Continue an interrupted run; with --force also one that has ended, for longer."""
    target: TargetOptions = field(default_factory=TargetOptions)
    tuning: TuningOptions = field(default_factory=TuningOptions)
    report_every: tyro.conf.Fixed[int] = 100
    """Steps between two scores on held-out views."""
    preview_every: tyro.conf.Fixed[int] = 500
    """Steps between two previews; after each quarter of a short run. 0: none."""
    threads: option.Threads = None
    device: Annotated[Literal["cpu", "gpu"], tyro.conf.arg(metavar="NAME")] = "cpu"
    """cpu, or gpu: a graphics card (extra gpu)."""
    origin: option.Origin = "keep"
    json: option.AsJson = False
    force: option.Force = False

    @property
    def inputs(self) -> list[Path]:
        """Files that must not be overwritten."""
        return [self.input]

    @property
    def has_photographs(self) -> bool:
        """Whether the targets are photographs."""
        return self.target.data is not None

    def configured(self) -> FinetuneConfig:
        """The preset with the explicit settings."""
        raise NotImplementedError

    def files(self) -> RunFiles:
        """The files of the run."""
        return RunFiles(self.output)

    def check(self) -> None:
        """UsageError for options that contradict each other or have no effect."""
        self.target.check()
        if self.device == "gpu":
            if self.configured().opacity == "cutoff":
                raise UsageError("--device gpu has no gradients for --opacity cutoff")
            open_device()

    def prepared(self, config: FinetuneConfig) -> Self:
        """The command with the size of the photographs, if it reads some: as given, as in the run that is
        resumed, or what suits the length of ``config``, as the run began."""
        return self if self.target.data is None else self._sized(self.target.data, config)

    def _sized(self, folder: Path, config: FinetuneConfig) -> Self:
        from meshsplats.training.image_sizes import worthwhile_downscale

        target: Any = self.target
        if target.downscale is not None:
            return self
        recorded = (self.resume and recorded_options(self.files().command, self._name)) or {}
        factor = recorded.get("downscale")
        if not isinstance(factor, int):
            threads = None if self.device == "gpu" else thread_count(self.threads)
            factor = worthwhile_downscale(folder, config.minutes, threads, target.missing, target.masks)
            if factor > 1:
                say(f"images: 1/{factor} of the photographs' sides, as time allows (--downscale 1: whole)")
        return replace(self, target=replace(target, downscale=factor))

    def plan(self, config: FinetuneConfig, earlier: Checkpoint | None, setup: Setup) -> Plan:
        """Reads the input and prepares the optimisation. ``earlier``: checkpoint of a resumed run."""
        raise NotImplementedError

    def next_steps(self, files: RunFiles, config: FinetuneConfig, plan: Plan) -> list[str]:
        """Lines that name a next command."""
        raise NotImplementedError

    def resolved(self) -> dict[str, Any]:
        return self.configured().to_dict()

    def execute(self) -> int:
        config = self.configured()
        start = time.perf_counter() - STARTUP_SECONDS
        self.check()
        files = self.files()
        files.check(self.inputs, resume=self.resume, force=self.force)
        earlier = self._earlier(files)
        with progress_display() as show:
            show.phase(f"reading {self.input}")
            command = self.prepared(as_begun(config, earlier))
        return command._run(config, files, earlier, start)

    def _run(self, config: FinetuneConfig, files: RunFiles, earlier: Checkpoint | None, start: float) -> int:
        """``execute`` of a prepared command, which began at ``start`` by the performance counter."""
        from meshsplats.formats.meshes import save_mesh

        try:
            with progress_display() as show:
                setup = Setup(show, start, config.minutes)
                plan = self.plan(config, earlier, setup)
                print_plan(plan, self.target.cache_bytes)
                with files.claimed(self.inputs, resume=self.resume, force=self.force):
                    self._record_start(files)
                    trained = plan.optimise(self._run_options(files, start, plan.reserve), show)
        except Interrupted as stop:
            return self.report_interrupt(stop, files)
        except OtherRunError as error:
            raise self._naming_options(error, files) from None
        given = trained.saving or alpha_for_viewers(trained.saved, files.mesh)
        mesh = written(trained.saved, self.origin)
        scored = self._scored(config, plan.dataset)
        background = {} if plan.background is None else plan.background.to_dict()
        with together():  # a run that is killed before has no result, and its checkpoint
            save_mesh(mesh, files.mesh, **given)
            write_configuration(files.config, self._name, self, scored | background | dict(plan.rates))
            draw_preview(trained.shown, files.preview, self.preview_camera(plan), listing=given.get("order"))
        try:
            self.save_more(files, plan, trained)  # which may fail: the mesh is there by now
        except Interrupted as stop:
            say(f"stopped: {files.mesh} is there, the rest is not; --resume --force goes on to it")
            return 128 + (stop.signal or signal.SIGINT)
        self._print_result(files, time.perf_counter() - start, earlier, trained, scored)
        if not self.json:
            for line in self.next_steps(files, config, plan):
                print(line)
        return 0

    def preview_camera(self, plan: Plan) -> Camera | None:
        """The camera of the preview; None: one in front of the mesh."""
        return None

    def report_interrupt(self, stop: Interrupted, files: RunFiles) -> int:
        """Says how to resume; returns the exit code."""
        say(f"stopped after step {stop.step:,}; the checkpoint is in {files.folder}: the same command with")
        say("  --resume continues from there")
        return 128 + (stop.signal or signal.SIGINT)

    def save_more(self, files: RunFiles, plan: Plan, trained: Trained) -> None:
        """Further files of the run."""

    def explicit_settings(self) -> dict[str, Any]:
        """The settings on the command line, with the length of the run."""
        tuning = {name: value for name, value in asdict(self.tuning).items() if value is not None}
        if tuning.get("exposure") and not self.has_photographs:
            raise UsageError("--exposure has no effect without --data: rendered images have one exposure")
        lengths = {name: getattr(self, name) for name in LENGTHS if getattr(self, name) is not None}
        if len(lengths) > 1:
            raise UsageError(f"give one of --epochs, --steps and --minutes, not {len(lengths)}")
        return tuning | lengths

    def rendering_next(self) -> list[str]:
        """``next_steps``: the command that renders the result."""
        return [f"next: {command_line(['meshsplats', 'render', self.output, '-o', self._beside('images')])}"]

    def evaluating_next(self, words: Sequence[object], plan: Plan, config: FinetuneConfig) -> list[str]:
        """``next_steps``: the command that scores the result on held-out views. ``words``: their options."""
        words = ["meshsplats", "evaluate", self.output, *words]
        if plan.background is not None or config.background == "black":
            words += ["--background", "black" if plan.background is None else plan.background.name]
        words += ["--samples", samples_of(plan.dataset.train[0], config)]
        return [f"next: {command_line([*words, '-o', self._beside('evaluation')])}"]

    def _beside(self, name: str) -> str:
        """A folder for what is made of the result."""
        return f"{self.output.with_suffix('')}-{name}"

    @property
    def _name(self) -> str:
        return type(self).__name__.lower()

    def _earlier(self, files: RunFiles) -> Checkpoint | None:
        """Of a run that is resumed, the checkpoint without its arrays; None for one that starts, and for one
        in cells, which have their own."""
        from meshsplats.finetuning.checkpoint import load_checkpoint
        from meshsplats.finetuning.journal import CHECKPOINT

        whole = self.resume and not files.in_cells
        return load_checkpoint(files.folder / CHECKPOINT, only_header=True) if whole else None

    def _run_options(self, files: RunFiles, start: float, reserve: float) -> RunOptions:
        """Of a run whose command started at ``start`` by the performance counter, and needs ``reserve``
        seconds afterwards."""
        return RunOptions(
            folder=files.folder,
            resume=self.resume,
            report_every=self.report_every,
            preview_every=self.preview_every,
            threads=self.threads,
            device=self.device,
            spent=time.perf_counter() - start,
            reserve=reserve,
            cache_bytes=self.target.cache_bytes,
        )

    def _record_start(self, files: RunFiles) -> None:
        """Keeps the options, to name those that differ when the run is resumed."""
        if not self.resume:
            files.folder.mkdir(exist_ok=True)
            write_configuration(files.command, self._name, self)

    def _naming_options(self, error: OtherRunError, files: RunFiles) -> Exception:
        """``error`` with the options that differ from those of the run that was to be resumed."""
        before = recorded_options(files.command, self._name)
        if before is None:
            return error
        now = configuration(self._name, self, files.folder)["options"]
        differ = [key for key in now if key not in _CHANGEABLE and before.get(key) != now[key]]
        if not differ:
            return OtherRunError(f"{error}. No option differs, so the files themselves have changed")
        changes = ", ".join(
            f"{spelled(type(self), key)} was {_in_words(before.get(key))} and is {_in_words(now[key])}"
            for key in differ
        )
        return OtherRunError(f"{error}. Options that differ: {changes}")

    def _scored(self, config: FinetuneConfig, dataset: Dataset) -> dict[str, Any]:
        """What the scores of a run compare: the look of the targets, and the samples of the mesh."""
        return {"look": dataset.look, "samples": samples_of((dataset.test or dataset.train)[0], config)}

    def _print_result(
        self,
        files: RunFiles,
        seconds: float,
        earlier: Checkpoint | None,
        trained: Trained,
        scored: Mapping[str, Any],
    ) -> None:
        """Prints the result of a run of ``seconds``, after those of the ``earlier`` part. ``scored``: see
        ``_scored``."""
        lines = Journal(files.folder).metrics()
        scores = [line["psnr"] for line in lines if line.get("psnr") is not None]
        steps = lines[-1]["step"] if lines else 0
        total = seconds + (0 if earlier is None else earlier.seconds)
        resumed = "" if earlier is None else f", {seconds:.1f} s of it since it was resumed"
        held_out = {"before": scores[0], "after": scores[-1]} if scores else None
        if files.in_cells and held_out is not None:
            held_out["before"] = None
        if self.json:
            result = {
                "mesh": str(files.mesh),
                "steps": steps,
                "seconds": round(total, 2),
                "seconds_since_resumed": None if earlier is None else round(seconds, 2),
                **trained.counts,
                "held_out_psnr": held_out,
                **scored,
                **({} if trained.sizes is None else trained.sizes.to_dict()),
                "run": str(files.folder),
            }
            print(json.dumps(result, indent=1))
            return
        made = f"{files.mesh} ({size_of(files.mesh)}, {trained.summary})"
        quality = f"; held out: {scores[0]:.2f} -> {scores[-1]:.2f} dB" if scores else ""
        if len(scores) == 1:
            quality = f"; held out: {scores[0]:.2f} dB"
        if scores:
            quality += f" (look {scored['look']}, {scored['samples']} x {scored['samples']} samples"
            count = lines[-1].get("views") or SCORED_VIEWS
            most = SCORED_VIEWS if self.has_photographs else min(self.target.held_out, SCORED_VIEWS)
            quality += f", {plural(count, 'view')})" if count < most else ")"
        print(f"{made}: {steps:,} steps in {total:.1f} s{resumed}{quality}")
        for line in _result_in_words(trained.sizes, steps if lines or trained.sizes else None):
            print(line)
        print(f"preview: {files.preview}" + (f"; metrics: {files.folder}/metrics.jsonl" if lines else ""))


def _result_in_words(sizes: SizeScores | None, steps: int | None) -> Iterator[str]:
    """At each image width, the conversion against the tuned mesh; which one was written, if not that; and
    whether no step was taken. ``steps``: None if unknown."""
    if sizes is not None and steps:
        pairs = (
            f"{width} px {old:.1f} -> {sizes.tuned[width]:.1f}" for width, old in sizes.converted.items()
        )
        yield f"converted -> tuned, dB: {', '.join(pairs)}"
    if sizes is not None and sizes.loses:
        where, count = ", ".join(str(width) for width in sizes.worse_at), plural(steps or 0, "step")
        yield f"the conversion is written: after {count}, the mesh was worse at {where} px;"
        yield "  a longer run helps, a new one rather than --resume, which keeps the start of a short one"
    elif steps == 0:
        yield "there was no time for steps: this is the mesh at the start; more --minutes help"


def over_background(
    dataset: Dataset,
    scene: GaussianCloud | SplatMesh,
    config: FinetuneConfig,
    source: Path,
    threads: int | None,
    *,
    whole: bool = True,
) -> tuple[Dataset, Background]:
    """``dataset`` of photographs over the background of the training, and that background: the one that the
    configuration or the model folder ``source`` names, else the one that fits ``scene`` best. Prints it."""
    color = config.background if config.background in ("black", "white") else None
    kind = "splats" if isinstance(scene, GaussianCloud) else "mesh"
    found = choose_background(optional_color(color), dataset, {kind: scene}, source, threads, whole=whole)
    say(f"background: {found.describe()}")
    return dataset.over(found.color), found


def print_plan(plan: Plan, cache_bytes: int) -> None:
    """Prints sizes and the memory that is needed. MemoryError if it is not there."""
    from meshsplats.finetuning.memory import available_memory, check_memory, readable

    dataset, needed = plan.dataset, plan.needed
    if needed is None and plan.mesh is not None:
        needed = check_memory(plan.mesh, dataset, cache_bytes=cache_bytes)
    camera = dataset.train[0].camera
    text = f"{plan.summary}; {plural(len(dataset.train), 'training view')}, {len(dataset.test)} held out"
    text += f", of {camera.width} x {camera.height} pixels"
    if needed is not None:
        free = available_memory()
        text += f"; memory: about {readable(needed)}" + (f" of {readable(free)} free" if free else "")
    say(text)


def _in_words(value: Any) -> str:
    if value is None:
        return "not given"
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
