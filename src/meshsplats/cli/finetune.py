"""``meshsplats finetune``: a mesh that looks better, from photographs or from the splats alone."""

from __future__ import annotations

import json
import shlex
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_type_hints

import tyro

from meshsplats.camera import load_cameras, orbit
from meshsplats.cli import UsageError
from meshsplats.cli.common import (
    Count,
    File,
    Folder,
    Number,
    Output,
    SplatOptions,
    Text,
    cameras_beside,
    check_mesh_suffix,
    check_outputs,
    configuration,
    load_scene,
    parse_up,
    size_of,
    write_json,
)
from meshsplats.cli.convert import _Options as ConversionOptions
from meshsplats.dataset import Dataset, load_dataset
from meshsplats.errors import MissingDependencyError
from meshsplats.finetuning import (
    FEWEST_VIEWS,
    FinetuneConfig,
    Interrupted,
    Progress,
    RunOptions,
    finetune,
    make_config,
    starting_mesh,
    worthwhile_views,
)
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

STARTING_UP = 1.0
"""Seconds that Python and the libraries take before the command's own clock begins."""


def _described(config: type[FinetuneConfig], standard: FinetuneConfig | None = None) -> type[FinetuneConfig]:
    """The choices of a configuration as options that may be left out; their docstrings are the help. Values
    that they have then are those of ``standard``, or the preset default's."""
    typed: dict[str, Any] = {}
    values: dict[str, Any] = {"__post_init__": lambda self: None}
    for name, hint in get_type_hints(config).items():
        if name in ("preset", "epochs", "steps", "minutes"):
            typed[name] = tyro.conf.Suppress[object]  # type: ignore[misc]
        else:
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


if TYPE_CHECKING:
    _Tuning = FinetuneConfig
else:
    _Tuning = _described(FinetuneConfig)


@dataclass(frozen=True)
class TargetOptions:
    """What the pictures should look like: photographs (--data), or else the splats' own pictures."""

    data: Folder = None
    """Data set of photographs (COLMAP, NeRF-synthetic, nerfstudio)."""
    downscale: int = 1
    """With --data: pictures this many times smaller."""
    test_every: int = 8
    """With --data: every n-th view is held out, where the data set has no split of its own; 0: none."""
    views: Count = None
    """Without --data: number of pictures of the splats to learn from. Default: 200, and more in a long run:
    one for each second, or for two --steps, up to 1000."""
    held_out: int = 8
    """Without --data: number of further pictures to measure with."""
    width: int = 400
    """Without --data: side of these pictures in pixels."""
    distance: tuple[float, float] = (0.9, 1.1)
    """Without --data: nearest and farthest camera outside, as multiples of the distance from which the
    sphere with 90 % of the splats' opacity just fits the picture. The mesh looks best from there."""
    placement: Literal["auto", "object", "surrounded", "inside"] = "auto"
    """Without --data: cameras all round an object, above the ground round an object in its surroundings, or
    inside a room."""
    cameras: File = None
    """Without --data: cameras to draw from, a JSON list or a cameras.json of a 3DGS trainer. Default: those
    of a model folder, else cameras are placed."""
    up: Text = None
    """Without --data: direction that points up, an axis (-y, z, ...) or x,y,z."""
    sh_degree: Count = None
    """Without --data: draw the splats with spherical harmonics up to this degree. Default: all that are
    stored."""
    cache: float = 2.0
    """Gigabytes of pictures kept in memory; the others are read or drawn again when they are needed."""

    def check(self) -> None:
        """UsageError for options that would do nothing."""
        idle = ("views", "held_out", "width", "distance", "placement", "cameras", "up", "sh_degree")
        names, source = (idle, "--data") if self.data is not None else (("downscale", "test_every"), "splats")
        for name in names:
            if getattr(self, name) != next(f.default for f in fields(self) if f.name == name):
                raise UsageError(f"--{name.replace('_', '-')} has no effect with {source}")
        if not self.cache >= 0:
            raise ValueError(f"--cache must be a number of gigabytes, >= 0, got {self.cache}")

    @property
    def cache_bytes(self) -> int:
        return int(self.cache * 1e9)

    def make(
        self,
        scene: GaussianCloud | SplatMesh,
        source: Path,
        background: Sequence[float],
        threads: int | None,
        worthwhile: int = FEWEST_VIEWS,
    ) -> Dataset:
        """The data set; of so many views as are ``worthwhile`` where nothing else was said."""
        if self.data is not None:
            return load_dataset(
                self.data,
                downscale=self.downscale,
                test_every=self.test_every,
                background=background,
                cache_bytes=self.cache_bytes,
            )
        if not isinstance(scene, GaussianCloud):
            raise UsageError(f"{source} is a mesh: give its photographs with --data, or splats in its place")
        from meshsplats.datasets.around import splat_dataset

        cameras = load_cameras(self.cameras) if self.cameras is not None else cameras_beside(source)
        return splat_dataset(
            scene,
            placement=self.placement,
            cameras=cameras,
            train=self.views or worthwhile,
            test=self.held_out,
            width=self.width,
            distance=self.distance,
            up=None if self.up is None else parse_up(self.up),
            sh_degree=self.sh_degree,
            background=background,
            threads=threads,
            cache_bytes=self.cache_bytes,
        )


@dataclass(frozen=True)
class _Files:
    """Where everything goes."""

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


@dataclass(frozen=True)
class Finetune:
    """Optimises a mesh until its pictures are those of the splats, or of photographs.

    Splats are converted first. Beside the result: its configuration, a preview picture, and a folder NAME.run
    with metrics, previews and a checkpoint, from which --resume goes on after Ctrl-C or a kill.
    """

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, or, with --data, a mesh."""
    output: Output
    """The tuned mesh: .npz or .ply, which keep everything; .glb, .usdc, .obj."""
    preset: Literal["default", "paper", "published"] = "default"
    """default: the best measured at equal time. paper: the values in the text of the MeshSplats paper.
    published: the rates of its code."""
    epochs: Number = None
    """Length: so many times all training views."""
    steps: Count = None
    """Length: so many steps."""
    minutes: Number = None
    """Length: so much time for the whole command."""
    start: Literal["same", "default", "paper"] = "same"
    """What the splats are converted to; same: as --preset has it. default: one ellipse of 8 triangles a
    splat. paper: the paper's conversion, also for published."""
    resume: bool = False
    """Go on where an interrupted run of the same command stopped."""
    target: TargetOptions = field(default_factory=TargetOptions)
    tuning: _Tuning = field(default_factory=_Tuning)
    conversion: ConversionOptions = field(default_factory=ConversionOptions)
    reading: SplatOptions = field(default_factory=SplatOptions)
    report_every: int = 100
    """Steps from one score on held-out views to the next."""
    preview_every: int = 500
    """Steps from one preview picture of the run to the next; 0: none."""
    threads: Count = None
    """At most N threads. Default: all processors."""
    json: bool = False
    """Print the result as JSON."""
    force: bool = False
    """Overwrite existing outputs."""

    def run(self) -> int:
        from meshsplats.formats.meshes import save_mesh

        began = time.perf_counter() - STARTING_UP
        check_mesh_suffix(self.output)
        config = self.configured()
        self.target.check()
        files = _Files(self.output)
        check_run_files(files, resume=self.resume, force=self.force)
        _need_torch()
        scene = load_scene(self.input, self.reading)
        background = (0.0, 0.0, 0.0) if config.background == "black" else (1.0, 1.0, 1.0)
        worthwhile = worthwhile_views(config)
        dataset = self.target.make(scene, self.input, background, self.threads, worthwhile)
        mesh = scene if isinstance(scene, SplatMesh) else self._converted(scene, dataset)
        from meshsplats.finetuning.memory import available_memory, check_memory, readable

        needed, free = check_memory(mesh, dataset, cache_bytes=self.target.cache_bytes), available_memory()
        _say(
            f"{len(mesh.faces):,} triangles, {len(dataset.train)} training views, {len(dataset.test)} held"
            f" out; memory: about {readable(needed)}" + (f" of {readable(free)} free" if free else "")
        )
        options = RunOptions(
            folder=files.run,
            resume=self.resume,
            report_every=self.report_every,
            preview_every=self.preview_every,
            threads=self.threads,
            spent=time.perf_counter() - began,
            cache_bytes=self.target.cache_bytes,
        )
        try:
            with _shown() as show:
                tuned = finetune(mesh, dataset, config, run=options, on_progress=show)
        except Interrupted as stop:
            _say(f"stopped after step {stop.step:,}; the checkpoint is in {files.run}: the same command with")
            _say("  --resume goes on from there")
            return 128 + (stop.signal or signal.SIGINT)
        save_mesh(tuned, files.mesh)
        write_json(files.config, configuration("finetune", self) | {"tuning": config.to_dict()})
        _draw_preview(tuned, files.preview)
        self._tell(files, tuned, time.perf_counter() - began)
        return 0

    def configured(self) -> FinetuneConfig:
        """The preset with what was given."""
        given = {k: v for k, v in asdict(self.tuning).items() if v is not None}
        lengths = {name: getattr(self, name) for name in ("epochs", "steps", "minutes")}
        lengths = {name: value for name, value in lengths.items() if value is not None}
        if len(lengths) > 1:
            raise UsageError(f"give one of --epochs, --steps and --minutes, not {len(lengths)}")
        return make_config(self.preset, **given, **lengths)

    def _converted(self, cloud: GaussianCloud, dataset: Dataset) -> SplatMesh:
        start = self.preset if self.start == "same" else self.start
        cameras = [view.camera for view in dataset.train]
        return starting_mesh(cloud, cameras, preset=start, **asdict(self.conversion))

    def _tell(self, files: _Files, tuned: SplatMesh, seconds: float) -> None:
        from meshsplats.finetuning.journal import Journal

        lines = Journal(files.run).metrics()
        scores = [line["psnr"] for line in lines if line.get("psnr") is not None]
        result = {
            "mesh": str(files.mesh),
            "steps": lines[-1]["step"] if lines else 0,
            "seconds": round(seconds, 2),
            "triangles": len(tuned.faces),
            "held_out_psnr": {"before": scores[0], "after": scores[-1]} if scores else None,
            "run": str(files.run),
        }
        if self.json:
            print(json.dumps(result, indent=1))
            return
        size = f"{size_of(files.mesh)}, {len(tuned.faces):,} triangles"
        print(
            f"{files.mesh} ({size}): {result['steps']:,} steps in {seconds:.1f} s"
            + (f"; held out: {scores[0]:.2f} -> {scores[-1]:.2f} dB" if scores else "")
        )
        print(f"preview: {files.preview}; metrics: {files.run}/metrics.jsonl")
        data = f"--data {shlex.quote(str(self.target.data))}" if self.target.data else ""
        splats = f"--splats {shlex.quote(str(self.input))}"
        quoted = shlex.quote(str(files.mesh)), shlex.quote(str(files.mesh.with_suffix("")) + "-evaluation")
        print(f"next: meshsplats evaluate {quoted[0]} {data or splats} -o {quoted[1]}")


def check_run_files(files: _Files, *, resume: bool, force: bool) -> None:
    """Before the work: OSError if something would be overwritten, cannot be written, or is missing to go on
    from."""
    from meshsplats.finetuning.journal import CHECKPOINT

    checkpoint = files.run / CHECKPOINT
    if resume and not checkpoint.is_file():
        raise FileNotFoundError(f"no checkpoint at {checkpoint}: leave out --resume to begin anew")
    if checkpoint.exists() and not (resume or force):
        raise FileExistsError(
            f"{checkpoint} is left from an earlier run: --resume goes on with it, --force begins anew"
        )
    check_outputs([files.mesh, files.config, files.preview], force)


@contextmanager
def _shown() -> Iterator[Any]:
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
            _say(_text(progress, progress.loss))


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


def _draw_preview(mesh: SplatMesh, path: Path) -> None:
    from meshsplats.evaluation import mesh_picture
    from meshsplats.pictures import save_png

    camera = orbit(mesh, 1, azimuth=30, width=800, height=800)[0]
    save_png(path, mesh_picture(mesh, camera, (1, 1, 1), samples=2)[0])


def _need_torch() -> None:
    """Before any work: MissingDependencyError without the extra."""
    try:
        import safetensors
        import torch  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            f"fine-tuning needs {error.name}: pip install 'meshsplats[finetune]'"
        ) from error
    del safetensors


def _say(text: str) -> None:
    print(f"meshsplats: {text}", file=sys.stderr, flush=True)
