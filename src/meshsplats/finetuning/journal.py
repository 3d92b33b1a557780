"""The folder of a run: its configuration, metrics.jsonl, previews and checkpoint."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.json_files import json_object
from meshsplats._common.kinds import need
from meshsplats._files.atomic import write_text
from meshsplats._files.locks import locked
from meshsplats.errors import EarlierRunError, FileFormatError
from meshsplats.finetuning.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from meshsplats.finetuning.config import LENGTHS
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.images.writing import amplified_error, save_image, strip

CHECKPOINT, METRICS, CONFIGURATION, PREVIEWS = (
    "checkpoint.safetensors",
    "metrics.jsonl",
    "config.json",
    "previews",
)
RECORD = "cells.json"
"""What a run in cells is about."""
LOCK = ".run.lock"
"""Not that of commands (``RunFiles.claimed``), which hold theirs around a run."""
CONFIGURATION_BYTES = 1 << 20
"""Most of a configuration."""
ERROR_FACTOR = 4.0
"""Amplification of the error in previews."""


class Journal:
    """Writes the files of a run.

    Each line of the metrics is a JSON object with ``step``, ``time`` (ISO 8601, local time with its offset)
    and the scores of that step.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)

    @property
    def checkpoint_path(self) -> Path:
        return self.folder / CHECKPOINT

    def begin(self, config: dict[str, Any]) -> None:
        """Creates the folder if needed (but not its parent) and removes the files of an earlier run. The
        configuration is the last to go and the first to come: files without one are not of a run."""
        self.folder.mkdir(exist_ok=True)
        self.remove()
        self._write_config(config)
        write_text(self.folder / METRICS, "")

    def remove(self) -> None:
        """Removes the files of a run, if there was one."""
        for preview in self._previews():
            preview.unlink()
        for path in (self.checkpoint_path, self.folder / METRICS, self.folder / CONFIGURATION):
            path.unlink(missing_ok=True)

    def check_free(self, more: tuple[str, ...], replace_old: bool) -> None:
        """EarlierRunError if a run that begins would replace files that are not of a run or, without
        ``replace_old``, what an earlier one has left to resume. ``more``: names of further files of it."""
        if self._has_run():
            for name in () if replace_old else (CHECKPOINT, RECORD):
                if (self.folder / name).exists():
                    raise EarlierRunError(
                        f"{self.folder / name} is left from an earlier run: ``resume`` continues it,"
                        " ``replace_old`` starts again"
                    )
            return
        named = [self.folder / name for name in (CHECKPOINT, METRICS, CONFIGURATION, *more)]
        for path in (*named, *self._previews()):
            if os.path.lexists(path):
                raise EarlierRunError(
                    f"{path} is not of an earlier run and would be replaced: give another folder"
                )

    def _has_run(self) -> bool:
        """Whether the folder has the configuration of a run."""
        path = self.folder / CONFIGURATION
        try:
            with open(path, "rb") as file:
                found = json_object(file.read(CONFIGURATION_BYTES + 1), CONFIGURATION_BYTES, path)
        except (OSError, FileFormatError):
            return False
        return {"preset", *LENGTHS} <= set(found)

    def _write_config(self, config: dict[str, Any]) -> None:
        write_text(self.folder / CONFIGURATION, json.dumps(config, indent=1) + "\n")

    def resume(self, config: dict[str, Any], check: Callable[[Checkpoint], None]) -> Checkpoint:
        """Loads the checkpoint, after ``check`` accepted it.

        ``config`` replaces the earlier configuration, whose length may differ. Metrics and previews of steps
        after the checkpoint are deleted, since these steps are repeated.
        """
        checkpoint = load_checkpoint(self.checkpoint_path)
        check(checkpoint)
        self._write_config(config)
        kept = [line for line in self.metrics() if line["step"] <= checkpoint.step]
        write_text(self.folder / METRICS, "".join(json.dumps(line) + "\n" for line in kept))
        for preview in self._previews():
            if int(preview.stem.removeprefix("step_")) > checkpoint.step:
                preview.unlink()
        return checkpoint

    def save(self, checkpoint: Checkpoint) -> None:
        save_checkpoint(checkpoint, self.checkpoint_path)

    def log_metrics(self, step: int, **values: Any) -> None:
        """Appends a line to the metrics, with the current time."""
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        line = json.dumps({"step": step, **values, "time": now}, allow_nan=False) + "\n"
        try:
            with open(self.folder / METRICS, "a", encoding="utf-8", newline="\n") as file:
                file.write(line)
        except OSError as error:  # of a full disk, for instance, which names no file
            raise OSError(error.errno, error.strerror, str(self.folder / METRICS)) from None

    def metrics(self) -> list[dict[str, Any]]:
        """All complete lines; one that was cut off when the process was killed is skipped."""
        try:
            content = (self.folder / METRICS).read_bytes()
        except FileNotFoundError:
            return []
        lines = []
        for line in content.splitlines():
            try:
                entry = json.loads(line)
            except (ValueError, RecursionError):
                continue
            if isinstance(entry, dict) and isinstance(entry.get("step"), int):
                lines.append(entry)
        return lines

    def save_preview(self, step: int, target: np.ndarray, image: np.ndarray) -> None:
        """Writes a strip of ground truth, mesh and error of one view, both images (h, w, 3) in [0, 1]."""
        (self.folder / PREVIEWS).mkdir(exist_ok=True)
        error = amplified_error(target, image, ERROR_FACTOR)
        captions = ("truth", f"mesh, step {step}", f"error x {ERROR_FACTOR:g}")
        path = self.folder / PREVIEWS / f"step_{step:07d}.png"
        save_image(path, strip([target, image, error], captions))

    def _previews(self) -> list[Path]:
        found = (self.folder / PREVIEWS).glob("step_*.png")
        return sorted(p for p in found if p.stem.removeprefix("step_").isdigit())


@contextmanager
def claimed(run: RunOptions | None, more: tuple[str, ...] = ()) -> Iterator[None]:
    """While the block runs, no other process writes the folder of ``run``, if it has one.

    Raises FileExistsError if one does, and, of a run that begins, EarlierRunError as ``Journal.check_free``.
    """
    need(RunOptions, run=run, optional=True)
    if run is None or run.folder is None:
        yield
        return
    was_there = run.folder.is_dir()
    run.folder.mkdir(exist_ok=True)
    try:
        with locked(run.folder / LOCK) as ours:
            if not ours:
                raise FileExistsError(
                    errno.EEXIST, "another process is writing this run; give another folder", str(run.folder)
                )
            if not run.resume:
                Journal(run.folder).check_free(more, run.replace_old)
            yield
    finally:
        if not was_there:
            with suppress(OSError):
                run.folder.rmdir()  # where nothing was written
