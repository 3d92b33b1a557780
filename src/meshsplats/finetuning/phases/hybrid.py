"""Opaque triangles, which are cut, and blended ones: both are optimised together (``soft_share``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from meshsplats.datasets.views import View
from meshsplats.finetuning.config import FinetuneConfig, learning_rates
from meshsplats.finetuning.hybrid import SOLID, ColorLimits
from meshsplats.finetuning.phases.phase import Moment, pruned
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import Plan, samples_of
from meshsplats.scene.mesh import SplatMesh


class Hybrid:
    """The last phase of opacity 'cutoff' with ``soft_share``.

    Args:
        config: of the run.
        limits: of the colours of opaque triangles; None: to be measured after the next step.
    """

    usual = 1.0
    listing = None

    def __init__(self, config: FinetuneConfig, limits: ColorLimits | None = None) -> None:
        self.config, self.limits = config, limits

    @classmethod
    def begin(
        cls, config: FinetuneConfig, mesh: SplatMesh, threads: int | None, moment: Moment
    ) -> tuple[Hybrid, State]:
        """The phase with the opaque and blended triangles of ``mesh``, right after the last step of the one
        before."""
        return cls(config).after_step(State.begin_hybrid(mesh, config, threads), moment)

    @classmethod
    def resume(cls, config: FinetuneConfig, state: State, arrays: Mapping[str, np.ndarray]) -> Hybrid:
        """The phase in a checkpoint's ``arrays``. ValueError if they do not fit."""
        limits = arrays.get("color_limits")
        return cls(config, None if limits is None else ColorLimits(state.mesh, limits))

    def share(self, fraction: float) -> float:
        """Share of this phase that is over after ``fraction`` of the run."""
        return (fraction - 1 + self.config.soft_phase) / self.config.soft_phase

    def plan(self, view: View, step: int, fraction: float) -> Plan:
        # Viewers shade a pixel once, with MSAA too: values at pixel centres must be right as well as means.
        centers = self.config.samples is None and step % 2 == 1
        steps_before = step * (1 - self.config.soft_phase) / fraction
        # Blended triangles in front of an edge are neglected: they are few.
        follows_edges = self.config.position_rate > 0 and not centers
        return Plan(
            False,
            1 if centers else samples_of(view, self.config),
            *learning_rates(self.config, step - steps_before, self.share(fraction)),
            edges=SOLID if follows_edges else None,
        )

    def views(self, views: Sequence[View], fraction: float) -> Sequence[View]:
        return views

    def before_step(self, state: State, fraction: float) -> State:
        return state

    def after_step(self, state: State, moment: Moment) -> tuple[Hybrid, State]:
        before, state = state, pruned(state, self.config, moment)
        if self.limits is None or state is not before:
            self.limits = ColorLimits.measured(state.result(), moment.views)
        self.limits.apply(state.colors)
        return self, state

    def result(self, state: State) -> SplatMesh:
        return state.result()

    def arrays(self) -> dict[str, np.ndarray]:
        return {} if self.limits is None else {"color_limits": self.limits.limits}
