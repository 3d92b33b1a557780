"""What a run of an optimisation shows meanwhile: a bar, or lines."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from meshsplats._common.words import Phase
from meshsplats.cli.messages import say, with_flags
from meshsplats.finetuning.setup import in_words

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

    from meshsplats.finetuning import Progress
    from meshsplats.finetuning.setup import Display


EVERY = 20.0
"""Seconds between lines about one phase."""


@contextmanager
def progress_display() -> Iterator[Display]:
    """Shows a run: as a bar where stderr is a terminal, else a line for each phase and score."""
    with terminal_bar() as bar:
        yield bar or _Lines()


@contextmanager
def terminal_bar() -> Iterator[InBar | None]:
    """A bar on stderr for the length of the block; None where that is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    plain = (TextColumn(text, markup=False) for text in ("{task.description}", "{task.fields[text]}"))
    columns = (next(plain), BarColumn(), next(plain))
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        yield InBar(bar)


class InBar:
    """A bar with the name of a phase before it and a text behind."""

    def __init__(self, bar: Bar) -> None:
        self._bar, self._task = bar, bar.add_task("", total=None, text="")
        self._loss: float | None = None
        self._phase = Phase()

    def phase(self, text: str, share: float | None = None, more: str = "") -> None:
        if self._phase.begins(text):  # rich takes a total of None for no change, and a new task for a pulse
            self._bar.remove_task(self._task)
            self._task = self._bar.add_task(with_flags(text), total=None, text="")
        if share:
            self._bar.update(self._task, total=1.0, completed=share, text=more or self._phase.left(share))

    def __call__(self, progress: Progress) -> None:
        if progress.loss is not None:  # smoothed: it differs from view to view
            self._loss = progress.loss if self._loss is None else 0.95 * self._loss + 0.05 * progress.loss
        self.phase("fine-tuning", progress.fraction, in_words(progress, self._loss))


class _Lines:
    def __init__(self) -> None:
        self._last: float | None = None
        self._phase, self._next = Phase(), 0.0

    def phase(self, text: str, share: float | None = None) -> None:
        if self._phase.begins(text):
            say(text)
        elif share and time.monotonic() >= self._next and (left := self._phase.left(share)):
            say(f"{text}: {share:.0%}, {left}")
        else:
            return
        self._next = time.monotonic() + EVERY

    def __call__(self, progress: Progress) -> None:
        if progress.held_out != self._last:
            self._last = progress.held_out
            say(in_words(progress, progress.loss))
