"""What meshes and splats were trained on, as records beside them say: the views that they are scored on, or
images of another size."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.cameras.files import load_cameras
from meshsplats.datasets.views import Dataset
from meshsplats.errors import DataWarning
from meshsplats.evaluation.backgrounds import model_settings
from meshsplats.formats.outputs import CAMERAS, CONFIGURATION, recorded_options

TRAINED_BY = {"train": "input", "finetune": "data", "prior": "data"}
"""Commands that train on photographs, and the option of each that names them."""
USUAL_SPLIT = 8
"""Every such view is held out by the 3DGS code with ``--eval``."""
ALIKE = 1.25
"""Images are of one size up to this ratio of their widths."""
_WIDEST = 1600
"""Pixels; the 3DGS code makes wider images smaller, unless it is told a size."""
_MOST_STEPS = 8
"""A file that was made from another one is followed to that, at most so often."""


@dataclass(frozen=True)
class Training:
    """A training on photographs."""

    record: Path
    """The file that tells of it."""
    setting: str
    """What it says of the split."""
    photographs: str
    """The folder of the photographs, which may be on another machine; empty: unknown."""
    test_every: int | None
    """Every n-th view was held out, or what the data set itself holds out; None: nothing at all."""


@dataclass(frozen=True)
class TrainedOn:
    """Views that a scene is scored on, though it was trained on them."""

    count: int
    scored: int
    training: Training
    sure: bool
    """Whether the photographs are of the same name as those of the training."""

    def in_words(self) -> str:
        """How many they are, and what says so."""
        training = self.training
        text = f"{self.count} of the {self.scored} views, as {training.record} says ({training.setting})"
        others = repr(training.photographs[:200]) if training.photographs else "its training"
        return text if self.sure else f"{text}, if the photographs are those of {others}"


def find_trained_on(
    scene: Path, dataset: Dataset, test_every: int, load: Callable[[int], Dataset]
) -> TrainedOn | None:
    """The held-out views of ``dataset`` that the mesh or splats at ``scene``, or what these were made from,
    were trained on; None if no record says so.

    ``test_every``: the split of ``dataset``, which ``load`` reads with another one.
    """
    scored = {view.name for view in dataset.test}
    for training in _trainings(scene):
        if training.test_every == test_every:
            continue
        learned = scored
        if training.test_every is not None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # those of the first time
                learned = scored.intersection(view.name for view in load(training.test_every).train)
        if learned:
            there = training.record.parent / training.photographs.replace("\\", "/")
            sure = bool(training.photographs) and Path(os.path.abspath(there)).name == dataset.name
            return TrainedOn(len(learned), len(scored), training, sure)
    return None


def warn_of_trained_on(found: Mapping[str, TrainedOn]) -> None:
    """A DataWarning of the views that scenes, by name, were trained on: one for all of the same training."""
    scenes: dict[str, list[str]] = {}
    for name, views in found.items():
        scenes.setdefault(views.in_words(), []).append(name)
    for text, names in scenes.items():
        what = "is scored on views that it was" if len(names) == 1 else "are scored on views that they were"
        warnings.warn(f"{', '.join(names)} {what} trained on: {text}", DataWarning, stacklevel=2)


def find_trained_width(scene: Path, dataset: Dataset, downscale: int) -> int | None:
    """Width in pixels of the images that the splats at ``scene`` were trained on, if their model folder says
    so and those of ``dataset``, photographs smaller by ``downscale``, are of another size. A DataWarning
    tells of it."""
    found = model_settings(scene)
    resolution = found and re.search(r"\bresolution\s*=\s*(-?\d{1,6})\b", found[1])
    if not found or not resolution:
        return None
    record, text = found
    # Of all views, as in the model folder: some may be upright, and the held-out ones chance to be.
    scored = float(np.median([view.camera.width for view in dataset.views]))
    width = scored * downscale
    with suppress(OSError, ValueError):
        width = float(np.median([camera.width for camera in load_cameras(record.with_name(CAMERAS))]))
    if smaller := re.search(r"\bimages\s*=\s*'images_([1-9]\d?)'", text):
        width /= int(smaller[1])
    factor = int(resolution[1])
    trained = width / factor if factor in (1, 2, 4, 8) else factor if factor > 0 else min(width, _WIDEST)
    if 1 / ALIKE <= trained / scored <= ALIKE:
        return None
    warnings.warn(
        f"{scene}: trained on images {trained:.0f} pixels wide, as {record} says, and scored on images of"
        f" {scored:.0f}: splat viewers blur by the same part of a pixel at any size, so these scores are not"
        " those that the splats have at theirs, and no baseline for a mesh",
        DataWarning,
        stacklevel=2,
    )
    return round(trained)


def _trainings(scene: Path) -> Iterator[Training]:
    """The trainings of ``scene`` and of what it was made from, the last one first."""
    for _ in range(_MOST_STEPS):
        if (found := model_settings(scene)) is not None:
            yield from _by_others(*found)
        record = scene.parent / f"{scene.name}.{CONFIGURATION}"  # of a folder ".", which has no name, too
        for command, option in TRAINED_BY.items():
            options = recorded_options(record, command) or {}
            photographs, held_out = options.get(option), options.get("test_every")
            if (
                isinstance(photographs, str)
                and type(held_out) is int
                and (not held_out or 2 <= held_out <= 10**9)
            ):
                yield Training(record, f"test_every = {held_out}", photographs, held_out)
        source: Any = (recorded_options(record) or {}).get("input")
        if isinstance(source, list) and len(source) == 1:
            source = source[0]
        if not isinstance(source, str):
            return
        scene = record.parent / source


def _by_others(record: Path, text: str) -> Iterator[Training]:
    """The training of the 3DGS code in a model folder with the ``cfg_args`` ``text``."""
    evaluated = re.search(r"\beval\s*=\s*(True|False)\b", text)
    photographs = re.search(r"\bsource_path\s*=\s*'([^']*)'", text)
    if evaluated:
        held_out = USUAL_SPLIT if evaluated[1] == "True" else None
        yield Training(record, f"eval = {evaluated[1]}", photographs[1] if photographs else "", held_out)
