"""How far a run is: by its steps or, where its length is in minutes, by the time."""

from __future__ import annotations

import math
import time

from meshsplats.finetuning.config import FinetuneConfig

WRAP_UP_SECONDS = 1.5
"""Time that a run with a length in minutes reserves for writing the mesh and rendering its preview. In short
runs it is a hundredth of the length."""

PLAIN_SHARE = 0.1
"""Largest share of a run with a length in minutes for the plain colours of its result, but for one image."""


class Clock:
    """The steps and the time of a run.

    Args:
        config: has the length.
        views: number of training views.
        step: number of steps already taken.
        seconds: time already used.
        setup_seconds: the part of it that came before the run, and of which its schedule knows nothing.
        reserve: seconds to leave at the end.

    Attributes:
        step: number of steps taken, counted by the loop.
        steps: total number of steps; None if the length is given in minutes.
        setup_seconds: time used before the run.
        step_cost, report_cost, save_cost: seconds of the last step, report and checkpoint.
        plain_images: number of images for the plain colours of the result, each of which takes about as long
            as a step; 0: it has none.
    """

    def __init__(
        self,
        config: FinetuneConfig,
        views: int,
        *,
        step: int = 0,
        seconds: float = 0.0,
        setup_seconds: float = 0.0,
        reserve: float = 0.0,
    ) -> None:
        self.step, self.steps = step, config.total_steps(views)
        self.step_cost = self.report_cost = self.save_cost = 0.0
        self.plain_images = 0
        self._minutes, self._reserve = config.minutes, reserve
        self._began = time.perf_counter() - seconds
        self._first_step, self._first_seconds = step, self.seconds
        self.setup_seconds = setup_seconds

    @property
    def seconds(self) -> float:
        """Time used so far, including that before a resumed run's checkpoint."""
        return time.perf_counter() - self._began

    @property
    def limit(self) -> float | None:
        """Seconds after which no step begins, so that the last report and the result are written in time."""
        if self._minutes is None:
            return None
        total = 60 * self._minutes
        reserve = 1.5 * (self.report_cost + self.save_cost) + self.step_cost + self._reserve
        reserve += self.plain_images * self.step_cost
        return max(total - (reserve + min(0.01 * total, WRAP_UP_SECONDS)), 0)

    def plan_plain_images(self, most: int) -> None:
        """Sets ``plain_images``, at most ``most``, by the cost of the last step."""
        share = math.inf if self._minutes is None else PLAIN_SHARE * 60 * self._minutes
        self.plain_images = int(min(max(share / max(self.step_cost, 1e-9), 1), most))

    @property
    def fraction(self) -> float:
        """Share of the run that is over, 0 to 1. What came before it, as the search for cameras, may have
        taken most of a length in minutes."""
        if self.limit is not None:
            length = self.limit - self.setup_seconds
            return min(1.0, (self.seconds - self.setup_seconds) / length) if length > 0 else 1.0
        return self.step / self.steps if self.steps else 1.0

    @property
    def done(self) -> bool:
        """Whether the last step was taken."""
        if self.limit is not None:
            return self.seconds >= self.limit
        return self.step >= (self.steps or 0)

    def due(self, interval: int) -> bool:
        """Whether the count of steps is a multiple of ``interval``; 0: never."""
        return bool(interval) and self.step % interval == 0

    @property
    def seconds_left(self) -> float | None:
        """Estimated remaining time; None if unknown."""
        if self.limit is not None:
            return max(self.limit - self.seconds, 0.0)
        if self.steps is not None and self.step > self._first_step:
            pace = (self.seconds - self._first_seconds) / (self.step - self._first_step)
            return pace * (self.steps - self.step)
        return None
