"""Base of ``finetune``, ``prior`` and ``train``: options, files, progress and result of an optimisation."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

import tyro

from meshsplats._common.options import of_presets
from meshsplats._common.words import command_line
from meshsplats._files.atomic import together
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, as_cli_options
from meshsplats.cli.common import draw_preview, written
from meshsplats.cli.messages import UsageError, say, with_flags
from meshsplats.cli.progress import progress_display
from meshsplats.cli.records import differences, in_plain_words, write_configuration
from meshsplats.errors import OtherRunError
from meshsplats.finetuning.config import LENGTHS, PRESETS, FinetuneConfig
from meshsplats.finetuning.interruption import Interrupted
from meshsplats.finetuning.run_files import RunFiles
from meshsplats.finetuning.setup import Setup
from meshsplats.finetuning.targets import Targets
from meshsplats.formats.outputs import recorded_options

if TYPE_CHECKING:
    from typing_extensions import Self

    from meshsplats.finetuning.checkpoint import Checkpoint
    from meshsplats.finetuning.plans import Plan, Trained
    from meshsplats.finetuning.run_options import RunOptions

Config = TypeVar("Config", bound=FinetuneConfig)
STARTUP_SECONDS = 1.0
"""Time that Python and the libraries take before the command's own clock starts."""
_CHANGEABLE = {
    *("resume", "force", "json", "threads", "device", "report_every", "preview_every", "cache", "output"),
    *("origin", *LENGTHS),
}
"""Options that may change when a run is resumed."""


def tuning_options(
    presets: Mapping[str, object], without: Sequence[str] = ()
) -> Callable[[type[Config]], type[Config]]:
    """``as_cli_options`` for the configuration of an optimisation. The help of an option ends with its values
    in ``presets``; ``without``: options that the command lacks."""
    return as_cli_options(without=("preset", *LENGTHS, *without), defaults=of_presets(presets), checked=False)


@tuning_options(PRESETS)
class TuningOptions(FinetuneConfig):
    """In parentheses: the values of the presets."""


@as_cli_options(presets=False)
class TargetOptions(Targets):
    """Targets: photographs (--data), else images of the splats."""


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
        """UsageError or OptionsError for options that contradict each other or have no effect."""
        from meshsplats.webgpu.device import open_device

        self.target.check()
        if self.device == "gpu":
            if self.configured().opacity == "cutoff":
                raise UsageError("--device gpu has no gradients for --opacity cutoff")
            open_device()

    def prepared(self, config: FinetuneConfig) -> Self:
        """The command with the size of the photographs, if it reads some: as given, as in the run that is
        resumed, or what suits the length of ``config``, as the run began."""
        return self if self.target.data is None else self._sized(self.target.data, config.minutes)

    def _sized(self, folder: Path, minutes: float | None) -> Self:
        from meshsplats._core.library import thread_count
        from meshsplats.training.image_sizes import worthwhile_downscale

        target: Any = self.target
        if target.downscale is not None:
            return self
        recorded = (self.resume and recorded_options(self.files().command, self._name)) or {}
        factor = recorded.get("downscale")
        if not isinstance(factor, int):
            threads = None if self.device == "gpu" else thread_count(self.threads)
            factor = worthwhile_downscale(folder, minutes, threads, target.missing, target.masks)
            if factor > 1:
                say(f"images: downscaled by {factor}, to suit the time (--downscale 1: full resolution)")
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
        from meshsplats.finetuning.checkpoint import as_begun

        config = self.configured()
        start = time.perf_counter() - STARTUP_SECONDS
        self.check()
        files = self.files()
        files.check(self.inputs, resume=self.resume, force=self.force)
        earlier = files.earlier() if self.resume else None
        with progress_display() as show:
            show.phase(f"reading {self.input}")
            command = self.prepared(as_begun(config, earlier))
        return command._run(config, files, earlier, start)

    def _run(self, config: FinetuneConfig, files: RunFiles, earlier: Checkpoint | None, start: float) -> int:
        """``execute`` of a prepared command, which began at ``start`` by the performance counter."""
        from meshsplats.evaluation.viewers import alpha_for_viewers
        from meshsplats.finetuning.plans import RunResult
        from meshsplats.finetuning.reports import SCORED_VIEWS
        from meshsplats.formats.meshes import save_mesh

        try:
            with progress_display() as show:
                plan = self.plan(config, earlier, Setup(show, start, config.minutes))
                say(plan.in_words(self.target.cache_bytes))
                with files.claimed(self.inputs, resume=self.resume, force=self.force):
                    self._record_start(files)
                    trained = plan.optimise(self._run_options(files, start, plan.reserve), show)
        except Interrupted as stop:
            return self.report_interrupt(stop, files)
        except OtherRunError as error:
            raise self._naming_options(error, files) from None
        given = trained.saving or alpha_for_viewers(trained.saved, files.mesh)
        mesh, scored = written(trained.saved, self.origin), plan.scored(config)
        background = {} if plan.background is None else plan.background.to_dict()
        with together():  # a run that is killed before has no result, and its checkpoint
            save_mesh(mesh, files.mesh, **given)
            write_configuration(files.config, self._name, self, scored | background | dict(plan.rates))
            draw_preview(trained.shown, files.preview, plan.dataset.opening, listing=given.get("order"))
        try:
            self.save_more(files, plan, trained)  # which may fail: the mesh is there by now
        except Interrupted as stop:
            say(f"stopped: {files.mesh} is written, the rest is not; add --resume --force to write it")
            return 128 + (stop.signal or signal.SIGINT)
        most = SCORED_VIEWS if self.has_photographs else self.target.held_out
        result = RunResult(files, trained, time.perf_counter() - start, scored, most, earlier)
        words = () if self.json else map(with_flags, result.in_words())
        following = () if self.json else self.next_steps(files, config, plan)
        self.finish(result.to_dict(), *words, *following)
        return 0

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
            raise UsageError("give only one of --epochs, --steps and --minutes")
        return tuning | lengths

    def rendering_next(self) -> list[str]:
        """``next_steps``: the command that renders the result."""
        return [f"next: {command_line(['meshsplats', 'render', self.output, '-o', self._beside('images')])}"]

    def evaluating_next(self, words: Sequence[object], plan: Plan, config: FinetuneConfig) -> list[str]:
        """``next_steps``: the command that scores the result on held-out views. ``words``: their options."""
        from meshsplats.finetuning.step import samples_of

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

    def _run_options(self, files: RunFiles, start: float, reserve: float) -> RunOptions:
        """Of a run whose command started at ``start`` by the performance counter, and needs ``reserve``
        seconds afterwards."""
        from meshsplats.finetuning.run_options import RunOptions

        return RunOptions(
            folder=files.folder,
            resume=self.resume,
            replace_old=self.force,
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
        differ = differences(files.command, self._name, self, _CHANGEABLE)
        with_length = differences(files.command, self._name, self, _CHANGEABLE - {*LENGTHS})
        if differ is None or (with_length and not differ):
            return error
        named = in_plain_words(self, differ)
        return OtherRunError(f"{error}. Options that differ: {named or 'none, so the files have changed'}")
