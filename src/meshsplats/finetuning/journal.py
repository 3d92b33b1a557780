"""The folder of a run: configuration, metrics.jsonl, previews and the checkpoint."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._files.atomic import write_text
from meshsplats.finetuning.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from meshsplats.images.writing import amplified_error, save_image, strip

CHECKPOINT, METRICS, CONFIGURATION, PREVIEWS = (
    "checkpoint.safetensors",
    "metrics.jsonl",
    "config.json",
    "previews",
)
ERROR_FACTOR = 4.0
"""By how much the previews' errors are amplified."""


class Journal:
    """What a run writes while it goes on. Metrics have a JSON object a line: always ``step`` and ``time``
    (ISO 8601, local with its offset), and what is said of the step."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)

    @property
    def checkpoint_path(self) -> Path:
        return self.folder / CHECKPOINT

    def begin(self, config: dict[str, Any]) -> None:
        """Makes the folder where it is missing (not the one above it) and removes what an older run left."""
        self.folder.mkdir(exist_ok=True)
        self.checkpoint_path.unlink(missing_ok=True)
        for preview in self._previews():
            preview.unlink()
        self._configure(config)
        write_text(self.folder / METRICS, "")

    def _configure(self, config: dict[str, Any]) -> None:
        write_text(self.folder / CONFIGURATION, json.dumps(config, indent=1) + "\n")

    def resume(self, config: dict[str, Any], check: Callable[[Checkpoint], None]) -> Checkpoint:
        """The checkpoint, once ``check`` let it pass. ``config`` takes the place of the earlier one, which
        may have been of another length. Metrics and previews of later steps, which will be made again, are
        dropped."""
        checkpoint = load_checkpoint(self.checkpoint_path)
        check(checkpoint)
        self._configure(config)
        kept = [line for line in self.metrics() if line["step"] <= checkpoint.step]
        write_text(self.folder / METRICS, "".join(json.dumps(line) + "\n" for line in kept))
        for preview in self._previews():
            if int(preview.stem.removeprefix("step_")) > checkpoint.step:
                preview.unlink()
        return checkpoint

    def save(self, checkpoint: Checkpoint) -> None:
        save_checkpoint(checkpoint, self.checkpoint_path)

    def note(self, step: int, **values: Any) -> None:
        """Adds a line to the metrics, with the time of day."""
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        line = json.dumps({"step": step, **values, "time": now}, allow_nan=False) + "\n"
        try:
            with open(self.folder / METRICS, "a", encoding="utf-8") as file:
                file.write(line)
        except OSError as error:  # of a full disk, say, which names no file
            raise OSError(error.errno, error.strerror, str(self.folder / METRICS)) from None

    def metrics(self) -> list[dict[str, Any]]:
        """All lines; what a kill left half-written is left out."""
        try:
            text = (self.folder / METRICS).read_text(encoding="utf-8")
        except FileNotFoundError:
            return []
        lines = []
        for line in text.splitlines():
            try:
                entry = json.loads(line)
            except ValueError:
                continue
            if isinstance(entry, dict) and isinstance(entry.get("step"), int):
                lines.append(entry)
        return lines

    def preview(self, step: int, truth: np.ndarray, picture: np.ndarray) -> None:
        """Writes truth | mesh | error of one view."""
        (self.folder / PREVIEWS).mkdir(exist_ok=True)
        error = amplified_error(truth, picture, ERROR_FACTOR)
        captions = ("truth", f"mesh, step {step}", f"error x {ERROR_FACTOR:g}")
        path = self.folder / PREVIEWS / f"step_{step:07d}.png"
        save_image(path, strip([truth, picture, error], captions))

    def _previews(self) -> list[Path]:
        found = (self.folder / PREVIEWS).glob("step_*.png")
        return sorted(p for p in found if p.stem.removeprefix("step_").isdigit())
