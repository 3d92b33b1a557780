"""What a run of given length has time for, by the measured speed of this machine.

With few steps for its triangles, a mesh is worse than its conversion, unless it begins as such and takes
small steps. Opaque meshes and those in the order of a file need many steps: they begin with fewer splats,
merged. A landscape of 4.2 million, three minutes in the order of a file, as viewers draw it: 4.0 million
triangles and 67 steps 20.9 dB, 1.6 million and 182 steps 22.1.
"""

from __future__ import annotations

import json
import time
from collections.abc import Collection
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from meshsplats._common.choices import Device
from meshsplats._common.json_files import read_json
from meshsplats._files.atomic import write_text
from meshsplats.conversion import ConversionOptions, convert, simplify
from meshsplats.datasets.splat_targets import ZOOMS
from meshsplats.datasets.views import Dataset
from meshsplats.errors import FileFormatError
from meshsplats.finetuning.baseline import without_cameras
from meshsplats.finetuning.config import FinetuneConfig, with_changes
from meshsplats.finetuning.phases.choice import first_phase
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import make_step
from meshsplats.rendering.ordering import drawing_order
from meshsplats.scene.gaussians import GaussianCloud

FEWEST_STEPS = 150
"""Steps that a run for opaque triangles, or for the order of a file, should have."""
STEPS_A_MINUTE = 30
"""The same for each minute, in runs where this is more."""
BRIEF_STEPS, DENSE_STEPS = 100, 150
"""Runs of fewer steps are brief, or of fewer than ``DENSE_STEPS`` for each splat a pixel."""
SPLAT_BYTES = 2000
"""Memory of fine-tuning the triangles that ``convert`` makes of a splat."""
MEMORY_SHARE = 0.5
"""Share of the memory that is there which they may take."""
BRIEF_RATES = {"position_rate": 0.005, "color_rate": 0.008}
"""Learning rates of brief runs. A logo of 0.3 million furry splats, a minute: 24.0/33.0/35.5/30.2/34.9 dB at
200, 400, 800, 1600 pixels and near, converted 23.7/32.1/35.1/30.2/33.8, and with the rates of other runs
24.0/32.7/34.3/29.6/34.2. They hold..."""
BRIEF_RATE_STEPS = 100
"""... for so many steps; shorter runs have rates in proportion."""
BRIEF_ZOOMS = ZOOMS["splats"]
"""Zooms of their training views."""
TRIAL_SPLATS = 50_000
"""Splats of the mesh whose steps are timed: every k-th of a larger cloud."""
FEWEST_SPLATS = 20_000
"""Splats are not merged to fewer than this, however little time there is."""
MERGED_SHARE = 0.9
"""A cloud of which this share fits is not merged."""


@dataclass(frozen=True)
class Pace:
    """Times in seconds, measured with a part of a cloud."""

    target: float
    """Of rendering one training image from all splats."""
    step: float
    """Of one step, for each splat."""
    merging: float
    """Of merging, for each splat that there was."""

    def steps(self, count: int, seconds: float) -> float:
        """Steps of a mesh of ``count`` splats for which there is time, at least 1."""
        return max(seconds / (self.target + self.step * count), 1.0)

    def splats(self, count: int, steps: float, seconds: float) -> int:
        """How many of ``count`` splats can take part in this number of steps: all, or those that are left
        after merging, which takes time, too."""
        if count * self.step * steps <= seconds - self.target * steps:
            return count
        left = seconds - self.merging * count - self.target * steps
        affordable = int(max(left, 0) / (steps * self.step))
        return count if affordable >= MERGED_SHARE * count else min(max(affordable, FEWEST_SPLATS), count)


RECORD = "start.json"
"""In the folder of the run."""
RECORD_BYTES = 1 << 12


@dataclass
class StartRecord:
    """What the time left of the start of a run: to be resumed, it has to begin with the same mesh."""

    max_splats: int | None = None
    """To which the splats were merged; None: all of them, or as the options say."""
    images: int | None = None
    """In which the visibility of splats was measured; None: all."""
    brief_steps: int | None = None
    """Expected steps of a brief run (``is_brief``); None: it is not brief."""

    @classmethod
    def load(cls, folder: Path) -> StartRecord:
        """That of the run in ``folder``; an empty one if it has none. Raises FileFormatError."""
        path = folder / RECORD
        if not path.is_file():
            return cls()
        found = read_json(path, RECORD_BYTES)
        counts = [found.get(f.name) for f in fields(cls)] if isinstance(found, dict) else [0]
        if any(type(count) is not int or count < 1 for count in counts if count is not None):
            raise FileFormatError(f"{path}: not the record of a run's start")
        return cls(*counts)

    def save(self, folder: Path) -> None:
        """Writes it into ``folder``, which exists."""
        write_text(folder / RECORD, json.dumps(asdict(self)) + "\n")


def worthwhile_steps(config: FinetuneConfig) -> float:
    """Steps that a run of this length, in minutes, for opaque triangles or the order of a file should have at
    least."""
    return max(FEWEST_STEPS, STEPS_A_MINUTE * (config.minutes or 0))


def most_splats(available: int | None) -> int | None:
    """For how many splats there is memory, of ``available`` bytes; None: unknown."""
    return None if available is None else max(int(MEMORY_SHARE * available / SPLAT_BYTES), FEWEST_SPLATS)


def is_brief(splats: int, pixels: int, steps: float, timed: bool) -> bool:
    """Whether a run of ``steps`` on images of ``pixels`` is brief for this number of splats; ``timed``: that
    is what its time leaves, not what was asked for.

    Where splats are dense in the images, their triangles are smaller than pixels: what a step learns of them
    is mostly noise, which only many steps average out, while the conversion is right to the last pixel.
    """
    if splats > pixels:
        return steps < DENSE_STEPS * splats / pixels
    return timed and steps < BRIEF_STEPS


def of_brief_run(config: FinetuneConfig, steps: float, given: Collection[str]) -> FinetuneConfig:
    """``config`` with the learning rates of a brief run of ``steps``, but for those that are ``given``."""
    share = min(1.0, steps / BRIEF_RATE_STEPS)
    changes = {name: rate * share for name, rate in BRIEF_RATES.items() if name not in given}
    return with_changes(config, **changes)  # type: ignore[arg-type]


def measure_pace(
    cloud: GaussianCloud,
    dataset: Dataset,
    config: FinetuneConfig,
    options: ConversionOptions,
    threads: int | None = None,
    device: Device = "cpu",
) -> Pace:
    """Times steps with a part of ``cloud``, converted with ``options``, on views of ``dataset``."""
    every = -(-len(cloud) // TRIAL_SPLATS)
    part = cloud.take(np.arange(0, len(cloud), every))
    start = time.perf_counter()
    simplify(part, max(1, len(part) // 2), threads=threads)
    merging = (time.perf_counter() - start) / len(part)
    free = replace(without_cameras(options), max_splats=None, max_triangles=None, crop=None)
    mesh = convert(part, free, threads=threads)
    views = dataset.train[:2]
    times = []
    for view in views:
        start = time.perf_counter()
        view.load()
        times.append(time.perf_counter() - start)
    state = State.begin(mesh, len(views), config, threads, device=device)
    listing = drawing_order(mesh, quick=True, threads=threads) if config.order == "file" else None
    phase = first_phase(config, mesh, state, listing=listing)
    state = phase.before_step(state, phase.usual)
    steps = []
    for number in range(2):  # the first one allocates
        start = time.perf_counter()
        make_step(state, views, number, phase.usual, phase)
        steps.append(time.perf_counter() - start)
    return Pace(min(times), min(steps) / len(part), merging)
