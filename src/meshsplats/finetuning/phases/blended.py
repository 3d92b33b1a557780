"""Translucent triangles, from the first step to the last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshsplats.datasets.views import View
from meshsplats.finetuning.config import FinetuneConfig, learning_rates
from meshsplats.finetuning.phases.phase import Moment, pruned
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import Plan, samples_of, uses_point_targets
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.order import Order


@dataclass(frozen=True)
class Blended:
    """The only phase of opacity 'blended'."""

    config: FinetuneConfig
    order: Order | None = None
    """That of the result, where the first steps blend whole splats (``by_splat_share``). None: all steps
    blend in the order of their mesh."""
    usual: float = 0.0
    listing: None = None

    def plan(self, view: View, step: int, fraction: float) -> Plan:
        points = uses_point_targets(view, self.config, fraction)
        samples = 1 if points else samples_of(view, self.config, fraction)
        return Plan(points, samples, *learning_rates(self.config, step, fraction))

    def views(self, views: Sequence[View], fraction: float) -> Sequence[View]:
        return views

    def before_step(self, state: State, fraction: float) -> State:
        if self.order is None:
            return state
        order: Order = "splat" if fraction < (self.config.by_splat_share or 0.0) else self.order
        if state.mesh.order == order:
            return state
        mesh = replace(state.result(), order=order)
        return state.rebuild(mesh, np.arange(len(mesh.vertices)))

    def after_step(self, state: State, moment: Moment) -> tuple[Blended, State]:
        return self, pruned(state, self.config, moment)

    def result(self, state: State) -> SplatMesh:
        mesh = state.result()
        return mesh if self.order is None else replace(mesh, order=self.order)

    def arrays(self) -> dict[str, np.ndarray]:
        return {}
