"""How many splats a run of given length has time for, by the measured speed of this machine.

Merging costs detail, few steps leave noise. With too few steps for its triangles, a mesh is worse than one of
fewer triangles, in short runs even worse than its conversion.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from meshsplats._files.atomic import write_text
from meshsplats._json import read_json
from meshsplats.conversion import ConversionOptions, convert, simplify
from meshsplats.datasets.views import Dataset
from meshsplats.errors import FileFormatError
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import make_step
from meshsplats.gaussians import GaussianCloud

FEWEST_STEPS = {"blended": 60, "cutoff": 150}
"""Steps that a run should have, by opacity."""
STEPS_A_MINUTE = {"blended": 12, "cutoff": 30}
"""The same for each minute, in runs where this is more."""
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

    @classmethod
    def load(cls, folder: Path) -> StartRecord:
        """That of the run in ``folder``; an empty one if it has none. Raises FileFormatError."""
        path = folder / RECORD
        if not path.is_file():
            return cls()
        found = read_json(path, RECORD_BYTES)
        names = [f.name for f in fields(cls)]
        values = {name: found.get(name) for name in names} if isinstance(found, dict) else {"": 0}
        if any(type(v) is not int or v < 1 for v in values.values() if v is not None):
            raise FileFormatError(f"{path}: not the record of a run's start")
        return cls(**values)

    def save(self, folder: Path) -> None:
        """Writes it into ``folder``, which exists."""
        write_text(folder / RECORD, json.dumps(asdict(self)) + "\n")


def worthwhile_steps(config: FinetuneConfig) -> float:
    """Steps that a run of this length, in minutes, should have at least."""
    each = STEPS_A_MINUTE[config.opacity] * (config.minutes or 0)
    return max(FEWEST_STEPS[config.opacity], each)


def measure_pace(
    cloud: GaussianCloud,
    dataset: Dataset,
    config: FinetuneConfig,
    options: ConversionOptions,
    threads: int | None = None,
) -> Pace:
    """Times steps with a part of ``cloud``, converted with ``options``, on views of ``dataset``."""
    every = -(-len(cloud) // TRIAL_SPLATS)
    part = cloud.select(np.arange(0, len(cloud), every))
    start = time.perf_counter()
    simplify(part, max(1, len(part) // 2))
    merging = (time.perf_counter() - start) / len(part)
    mesh = convert(part, replace(options, max_splats=None, max_triangles=None, crop=None))
    views = dataset.train[:2]
    times = []
    for view in views:
        start = time.perf_counter()
        view.load()
        times.append(time.perf_counter() - start)
    state = State.begin(mesh, len(views), config, threads)
    steps = []
    for number in range(2):  # the first one allocates
        start = time.perf_counter()
        make_step(state, views, number, 0.6 if config.opacity == "cutoff" else 0.0)
        steps.append(time.perf_counter() - start)
    return Pace(min(times), min(steps) / len(part), merging)
