"""What happens before the first step of a run, in phases and with an eye on the clock; and steps in words."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from meshsplats.finetuning.run import Progress


class Display(Protocol):
    """Shows a set-up and the steps after it."""

    def phase(self, text: str, share: float | None = None) -> None:
        """Shows what begins, or how much of it is done, 0 to 1."""

    def __call__(self, progress: Progress) -> None: ...


class Setup:
    """The time and the display of a run that began at ``start`` by the performance counter and has so many
    ``minutes``, set-up and result included."""

    def __init__(self, show: Display, start: float, minutes: float | None) -> None:
        self._show, self._start = show, start
        self.seconds = None if minutes is None else 60 * minutes
        """Time for the whole run; None: not limited."""

    def phase(self, text: str) -> None:
        """Shows what begins now."""
        self._show.phase(text)

    @property
    def spent(self) -> float:
        """Seconds since the run began."""
        return time.perf_counter() - self._start

    def observer(self, text: str, share: float) -> Callable[[int, int], bool]:
        """For images of a set-up (``convert``): shows their number, and ends them after this ``share`` of the
        run's time."""

        def on_image(done: int, total: int) -> bool:
            self._show.phase(text, done / total)
            return self.seconds is None or self.spent < share * self.seconds

        return on_image


def in_words(progress: Progress, loss: float | None) -> str:
    """The steps of an optimisation, with this ``loss``, its scores and the time left."""
    parts = [f"step {progress.step:,}" + (f"/{progress.steps:,}" if progress.steps else "")]
    if loss is not None:
        parts.append(f"loss {loss:.4f}")
    if progress.held_out is not None:
        parts.append(f"held out {progress.held_out:.2f} dB")
    if progress.seconds_left is not None:
        left = int(progress.seconds_left)
        parts.append(f"{left // 60}:{left % 60:02d} left")
    return ", ".join(parts)
