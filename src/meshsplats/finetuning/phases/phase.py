"""What the loop of fine-tuning asks of a phase."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from meshsplats.datasets.views import View
from meshsplats.finetuning.clock import Clock
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import Schedule, kept_faces
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh


class Moment(NamedTuple):
    """Right after a step."""

    clock: Clock
    """It has counted the step."""
    views: Sequence[View]
    """All training views."""
    loss: float | None
    """Of the step; None if no pixel of its view counts."""


class Phase(Schedule, Protocol):
    """A part of a run, with what it knows of it. Fractions are those of the run that are over, 0 to 1."""

    @property
    def usual(self) -> float:
        """A fraction at which a step costs what most do."""

    @property
    def listing(self) -> DrawOrder | None:
        """The order of a file in which the mesh is drawn; None: that of the mesh."""

    def views(self, views: Sequence[View], fraction: float) -> Sequence[View]:
        """The training ``views``, as the next step sees them."""

    def before_step(self, state: State, fraction: float) -> State:
        """``state`` as the next step draws it."""

    def after_step(self, state: State, moment: Moment) -> tuple[Phase, State]:
        """The phase and the state of the next step: triangles may have been added or removed."""

    def result(self, state: State) -> SplatMesh:
        """The mesh of ``state``, as it would be handed over now."""

    def arrays(self) -> dict[str, np.ndarray]:
        """What a checkpoint keeps, besides the state."""


def pruned(state: State, config: FinetuneConfig, moment: Moment) -> State:
    """``state`` without faint triangles, where that is due."""
    clock = moment.clock
    if clock.due(config.prune_interval(len(moment.views))) and not clock.done:
        return state.prune(kept_faces(state))
    return state
