"""What a long run has done: lines of JSON in a file that survives its end at any moment."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from meshsplats.errors import FileFormatError


class Journal:
    """Steps of a run, in the order in which they ended. A line that was cut off does not count."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.steps: list[dict[str, Any]] = []
        whole = 0
        if path.exists():
            for line in path.read_bytes().splitlines(keepends=True):
                if not line.endswith(b"\n"):
                    break
                try:
                    step = json.loads(line)
                except (ValueError, RecursionError):
                    step = None
                named = isinstance(step, dict) and isinstance(step.get("step"), str)
                if not named or not isinstance(step.get("key", ""), str):
                    raise FileFormatError(f"{path}: not a journal: remove its folder, and begin again")
                self.steps.append(step)
                whole += len(line)
            os.truncate(path, whole)

    def add(self, step: str, **facts: Any) -> None:
        """Notes that ``step`` is done; on the disk when this returns."""
        self.steps.append({"step": step, **facts})
        with open(self._path, "ab") as file:
            file.write(json.dumps(self.steps[-1]).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())

    def find(self, step: str) -> dict[str, Any] | None:
        """The first line of that ``step``, or None."""
        return next((line for line in self.steps if line["step"] == step), None)

    def keys(self, step: str) -> set[str]:
        """The ``key`` of each line of that ``step``."""
        lines = [line for line in self.steps if line["step"] == step]
        if any("key" not in line for line in lines):
            raise FileFormatError(
                f"{self._path}: a step {step!r} has no key: remove its folder, and begin again"
            )
        return {line["key"] for line in lines}
