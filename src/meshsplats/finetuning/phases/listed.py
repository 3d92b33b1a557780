"""Translucent triangles as viewers draw them that do not sort: in the order of a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshsplats.datasets.views import View
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.finetuning.phases.blended import Blended
from meshsplats.finetuning.phases.phase import Moment
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import Plan, kept_faces
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh


@dataclass(frozen=True)
class Listed:
    """The only phase of order 'file'. Its steps are those of blended triangles."""

    config: FinetuneConfig
    listing: DrawOrder
    usual: float = 0.0

    @classmethod
    def resume(cls, config: FinetuneConfig, state: State, arrays: Mapping[str, np.ndarray]) -> Listed:
        """The phase that had ``arrays``, in a checkpoint. KeyError or ValueError if they do not fit."""
        order = DrawOrder(arrays["listing.copies"], arrays["listing.starts"])
        order.listed(state.mesh.faces)
        return cls(config, order)

    def plan(self, view: View, step: int, fraction: float) -> Plan:
        return Blended(self.config).plan(view, step, fraction)._replace(listing=self.listing)

    def views(self, views: Sequence[View], fraction: float) -> Sequence[View]:
        return views

    def before_step(self, state: State, fraction: float) -> State:
        return state

    def after_step(self, state: State, moment: Moment) -> tuple[Listed, State]:
        clock = moment.clock
        if not clock.due(self.config.prune_interval(len(moment.views))) or clock.done:
            return self, state
        keep = kept_faces(state)
        # Not solved again: in 300 steps, that gained nothing (docs/viewers.md).
        return replace(self, listing=self.listing.take(keep)), state.prune(keep)

    def result(self, state: State) -> SplatMesh:
        return state.result()

    def arrays(self) -> dict[str, np.ndarray]:
        return {
            "listing.copies": self.listing.copies,
            "listing.starts": self.listing.starts,
        }


def check_for_file_order(mesh: SplatMesh, config: FinetuneConfig) -> None:
    """ValueError unless viewers blend ``mesh`` as a run with order 'file' does."""
    if "linear" in (mesh.blending, config.blending):
        raise ValueError("order 'file' is for viewers, which blend display values: not for blending 'linear'")
    if mesh.filter_px2:
        raise ValueError("order 'file' is for viewers, which have no filter: take look 'area', or bake it")
