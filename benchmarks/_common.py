"""What the benchmarks share: scenes, clocks, memory, arguments, and tables that are printed and recorded.

A script makes its parser with ``arguments(__doc__)`` and prints through a ``Report``. With ``--save``, what
was printed replaces the figures of the same command in benchmarks/results/NAME.md, or is added at its end.
Text around measured figures stays as it is: it says what they mean.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import re
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import meshsplats as ms

if TYPE_CHECKING:
    from meshsplats.finetuning.state import State

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
DATA = Path(os.environ.get("MESHSPLATS_SHARED_DATA", ROOT.parent / "shared" / "data"))
"""Real splats, cameras, photographs and meshes, which are no part of the project."""


# ---- Scenes


@dataclass(frozen=True)
class Scene:
    """A scene of the data folder."""

    name: str
    splats: str
    photographs: str = ""
    downscale: int = 1
    """Of the photographs."""
    background: tuple[float, float, float] = (1, 1, 1)

    def cloud(self, data: Path) -> ms.GaussianCloud:
        return ms.load_gaussians(data / "splats" / self.splats)

    def cameras(self, data: Path, distance: str = "mid") -> list[ms.Camera]:
        """The standard cameras of a distance: close, mid or far."""
        return ms.load_cameras(data / "cameras" / f"{self.name}_{distance}.json")


SCENES = {
    scene.name: scene
    for scene in (
        Scene("guitar", "guitar_sh0.ply"),
        Scene("truck", "tt_truck_sh0.ply"),
        Scene("playbot", "playbot_lod3_31k_sh2.ply"),
    )
}
DISTANCES = ("close", "mid", "far")
PHOTOGRAPHED = {
    scene.name: scene
    for scene in (
        Scene("lego", "trained/lego_60k_sh0.ply", "photos/lego"),
        Scene("lego-sh3", "trained/lego_60k_sh3.ply", "photos/lego"),
        Scene("snowmiku", "trained/miku_58k_sh0.ply", "photos/snowmiku", 2, (0, 0, 0)),
    )
}

FANS = {
    "160k": (20_000, 0.03, 0.04, 400),
    "1M": (125_000, 0.0145, 0.05, 800),
    "4M": (500_000, 0.006, 0.06, 800),
}
"""Random scenes: fans, their radius at depth 1, opacity, side of the image in pixels."""


def random_fans(fans: int, radius: float, opacity: float, side: int) -> tuple[ms.SplatMesh, ms.Camera]:
    """Fans of random orientation between the depths 2.5 and 5, in front of the whole image."""
    rng = np.random.default_rng(0)
    centers = np.stack([rng.uniform(-1, 1, fans), rng.uniform(-1, 1, fans), rng.uniform(2.5, 5, fans)], 1)
    centers[:, :2] *= centers[:, 2:] / 2
    a = rng.normal(size=(fans, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = rng.normal(size=(fans, 3))
    b -= (a * b).sum(1, keepdims=True) * a
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    size = radius * np.exp(rng.normal(0, 0.4, fans)) * centers[:, 2]
    angle = np.arange(8) * np.pi / 4
    circle = np.cos(angle)[:, None] * a[:, None] + np.sin(angle)[:, None] * b[:, None]
    rim = centers[:, None] + size[:, None, None] * circle
    vertices = np.concatenate([centers[:, None], rim], 1).reshape(-1, 3)
    i = np.arange(8)
    fan = np.stack([0 * i, 1 + i, 1 + (i + 1) % 8], 1)
    faces = (fan[None] + 9 * np.arange(fans)[:, None, None]).reshape(-1, 3)
    rgb = np.repeat(rng.uniform(0, 1, (fans, 1, 3)), 9, 1)
    alpha = np.broadcast_to(np.array([2] + 8 * [0.2])[None, :, None] * opacity, (fans, 9, 1))
    colors = np.concatenate([rgb, alpha], 2).reshape(-1, 4)
    camera = ms.Camera(np.eye(4), side, side, side / 2, side / 2, side, side)
    return ms.SplatMesh(vertices, faces, colors, np.repeat(np.arange(fans), 8)), camera


# ---- Images and scores


def areas(cloud: ms.GaussianCloud, cameras: Iterable[ms.Camera], **options: Any) -> list[np.ndarray]:
    """Images of splats, of the look 'area' if ``options`` name no other."""
    options = {"look": "area"} | options
    return [ms.draw_splats(cloud, camera, **options).color for camera in cameras]


def images(mesh: ms.SplatMesh, cameras: Iterable[ms.Camera], **options: Any) -> list[np.ndarray]:
    return [ms.render(mesh, camera, **options).color for camera in cameras]


def mean_psnr(found: Iterable[np.ndarray], truths: Iterable[np.ndarray]) -> float:
    """Mean PSNR in dB of images, clipped to [0, 1]."""
    pairs = zip(found, truths, strict=True)
    return float(np.mean([ms.psnr(image.clip(0, 1), truth.clip(0, 1)) for image, truth in pairs]))


def take_steps(
    state: State, views: Sequence[ms.View], config: ms.FinetuneConfig, fraction: Callable[[int], float]
) -> tuple[ms.SplatMesh, int]:
    """The mesh after steps of fine-tuning, and their number, until ``fraction``, which takes the number of
    steps so far, is 1: for clocks that ``finetune`` does not have."""
    from meshsplats.finetuning.phases.blended import Blended
    from meshsplats.finetuning.step import kept_faces, make_step

    step, interval = 0, config.prune_interval(len(views))
    while (done := fraction(step)) < 1:
        make_step(state, views, step, done, Blended(config))
        step += 1
        if interval and step % interval == 0 and fraction(step) < 1:
            state = state.prune(kept_faces(state))
    return state.result(), step


# ---- Time and memory


class Stopwatch:
    """Seconds since it was made."""

    def __init__(self) -> None:
        self._wall, self._processor = time.perf_counter(), time.process_time()

    @property
    def wall(self) -> float:
        return time.perf_counter() - self._wall

    @property
    def processor(self) -> float:
        """Of all threads of this process."""
        return time.process_time() - self._processor

    def idle(self, processors: int) -> float:
        """By the clock of a machine without other work, on which all processors are busy: the processor time
        divided by their number."""
        return self.processor / processors


class Times(NamedTuple):
    """Seconds of each repeat."""

    wall: list[float]
    processor: list[float]


def in_turns(works: Sequence[Callable[[], object]], repeat: int) -> list[Times]:
    """Times of ``works``, which take turns, so that other work on the machine disturbs all of them alike. The
    first turn is a warm-up."""
    found = [Times([], []) for _ in works]
    for turn in range(repeat + 1):
        for work, times in zip(works, found, strict=True):
            watch = Stopwatch()
            work()
            wall, processor = watch.wall, watch.processor
            if turn:
                times.wall.append(wall)
                times.processor.append(processor)
    return found


def median_ms(work: Callable[[], object], repeat: int) -> float:
    """Median milliseconds by the clock, after a warm-up."""
    return 1e3 * statistics.median(in_turns([work], repeat)[0].wall)


def peak_bytes(who: int = resource.RUSAGE_SELF) -> int:
    """Most memory that this process ever held, or, with RUSAGE_CHILDREN, the largest of its children."""
    return resource.getrusage(who).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


class Used(NamedTuple):
    """What a command took."""

    processor: float
    wall: float
    others: float
    """Share of the processors that other programs took meanwhile; nan where the system does not say."""
    memory: int
    """Peak, bytes."""
    output: str


def run(command: Sequence[str | Path], **options: Any) -> Used:
    """Runs a command to its end; CalledProcessError if it fails. ``options`` are those of Popen."""
    words = [str(word) for word in command]
    before, watch = _busy_seconds(), Stopwatch()
    process = subprocess.Popen(words, text=True, **{"stdout": subprocess.PIPE} | options)
    output = process.stdout.read() if process.stdout else ""
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, words, output)
    wall, own = watch.wall, used.ru_utime + used.ru_stime
    others = (_busy_seconds() - before - own) / (wall * (os.cpu_count() or 1))
    memory = used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return Used(own, wall, others if others != others else max(others, 0.0), memory, output)


def _busy_seconds() -> float:
    """Processor seconds of all programs since the system's start; nan but on Linux."""
    try:
        first = Path("/proc/stat").read_text().split("\n", 1)[0]
    except OSError:
        return float("nan")
    user, nice, system, _, _, irq, soft, *_ = map(int, first.split()[1:])
    return (user + nice + system + irq + soft) / os.sysconf("SC_CLK_TCK")


def alone(work: Callable[..., Any], *arguments: object) -> Any:
    """The result of ``work``, a function of a module, in a process of its own: for its memory."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as worker:
        return worker.submit(work, *arguments).result()


# ---- Arguments and reports


def arguments(doc: str | None, *, data: bool = False) -> argparse.ArgumentParser:
    """A parser with ``doc`` as its help, ``--save`` and, with ``data``, ``--data``."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if data:
        parser.add_argument("--data", type=Path, default=DATA, help="folder of real data: %(default)s")
    parser.add_argument("--save", action="store_true", help="record the figures in benchmarks/results/")
    return parser


def machine() -> str:
    """Processor, their number and load, and the core in use."""
    from meshsplats._core.library import load_core, processors

    name = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").exists():
        found = re.search(r"model name\s*:\s*(.*)", Path("/proc/cpuinfo").read_text())
        name = found[1].strip() if found else name
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{name}, {processors()} processors{load}, core {load_core().ms_variant().decode()}"


def commit() -> str:
    """The commit of the source, and whether it was changed since."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", "src", "benchmarks/*.py")
        return f"commit {git('rev-parse', '--short', 'HEAD')}" + (" with changes" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return f"version {ms.__version__}"


def command_line(words: Sequence[str]) -> str:
    """A script's arguments as they are recorded: without places of this machine. ``words``: as sys.argv."""
    script = Path(words[0]).resolve()
    place = script.relative_to(ROOT) if script.is_relative_to(ROOT) else Path(script.name)
    shown = ["python", place.as_posix()]
    for before, word in pairwise(words):
        if word == "--save":
            continue
        if before == "--data":
            word = "DATA"
        elif "/" in word or os.sep in word:
            word = Path(word).name
        shown.append(f"'{word}'" if " " in word else word)
    return " ".join(shown)


class Report:
    """Lines and tables, printed as they come; ``with`` records them at its end, if ``asked.save``."""

    def __init__(self, asked: argparse.Namespace, words: Sequence[str] | None = None) -> None:
        words = sys.argv if words is None else words
        self._save = asked.save
        self.command = command_line(words)
        # Of the start: source may change meanwhile, and the run itself is load.
        self._about = f"{time.strftime('%Y-%m-%d')}, {commit()}, {machine()}" if asked.save else ""
        script = Path(words[0]).resolve()
        folder = script.parent.name + "_" if script.parent.name != "benchmarks" else ""
        self.path = RESULTS / f"{folder}{script.stem}.md"
        self._lines: list[str] = []
        self._columns = 0

    def __enter__(self) -> Report:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if self._save and error is None:
            self.save()

    def say(self, text: str = "") -> None:
        """A line of text."""
        print(text, flush=True)
        self._lines.append(text)

    def table(self, *heads: object) -> None:
        """Begins a table, apart from what stands above it."""
        if self._lines and self._lines[-1]:
            self.say()
        self._columns = len(heads)
        self.row(*heads)
        self.say("|" + "---|" * len(heads))

    def row(self, *cells: object) -> None:
        """A row of the table, as wide as its head."""
        assert len(cells) == self._columns, f"{len(cells)} cells in a table of {self._columns} columns"
        self.say("| " + " | ".join(map(str, cells)) + " |")

    def save(self) -> None:
        text = self.path.read_text("utf-8") if self.path.exists() else f"# {self.path.stem}\n"
        lines = (line if line.startswith("|") else fill(line, 120) for line in self._lines)
        body = "\n".join(lines).strip()
        self.path.parent.mkdir(exist_ok=True)
        self.path.write_text(
            recorded(text, self.command, f"`{self.command}`:\n{self._about}.\n\n{body}"), "utf-8"
        )
        print(f"recorded in {self.path.relative_to(ROOT)}" if self.path.is_relative_to(ROOT) else self.path)


BEGIN, END = "<!-- measured -->", "<!-- end -->"


def recorded(text: str, command: str, figures: str) -> str:
    """``text`` of a results file with the ``figures`` of ``command`` in place of its former ones, or at the
    end."""
    section = f"{BEGIN}\n{figures}\n\n{END}"
    former = re.compile(f"{BEGIN}\n{re.escape(f'`{command}`')}.*?{END}", re.DOTALL)
    if former.search(text):
        return former.sub(lambda _: section, text, count=1)
    return f"{text.rstrip()}\n\n{section}\n"
