"""Translucent triangles that become opaque ones, cut where their opacity crosses the cutoff.

``opaque.py`` says how: a ramp in place of the hard cut becomes steeper, a growing share of the loss is the
expected error, and from some point on positions follow visible edges. Late in the phase the mesh settles:
triangles that no view shows are removed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats.datasets.views import View
from meshsplats.finetuning.config import FinetuneConfig, learning_rates
from meshsplats.finetuning.hybrid import with_soft_splats
from meshsplats.finetuning.opaque import visible_samples
from meshsplats.finetuning.outlines import fewer_triangles
from meshsplats.finetuning.phases.hybrid import Hybrid
from meshsplats.finetuning.phases.phase import Moment, pruned
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import Plan, samples_of, uses_point_targets
from meshsplats.formats.cutting import cut_mesh
from meshsplats.rendering.backward import OpacityRamp
from meshsplats.scene.mesh import SplatMesh

STEEPEST = 30.0
"""Slope of the ramp at the end of the annealing, where it is not limited by its width already."""
LEAK = 0.05
"""Derivative outside of the ramp at the start, so that hidden fragments can come back. It falls to 0."""
EDGES_FROM = 0.4
"""Share of the annealing after which the motion of edges counts: before, many triangles are translucent."""


class Cutting:
    """The first phase of opacity 'cutoff', or the only one: ``Hybrid`` follows where ``soft_share`` asks for
    blended triangles.

    Args:
        config: of the run.
        start: the mesh before the first step.
        resumed: the fraction at which the run is resumed; None: it begins.
    """

    usual = 0.6
    listing = None

    def __init__(self, config: FinetuneConfig, start: SplatMesh, resumed: float | None = None) -> None:
        self.config = config
        share = config.opaque_share
        self._most_opaque = None if share == 1 else max(1, round(share * len(start.faces)))
        self._source = start if config.soft_share else None
        # A resumed run may have removed hidden triangles before its checkpoint.
        self._settled = resumed is not None and self._is_late(resumed)

    def plan(self, view: View, step: int, fraction: float) -> Plan:
        done = self.share(fraction)
        points = uses_point_targets(view, self.config, done)
        samples = 1 if points else samples_of(view, self.config, done)
        return Plan(
            points,
            samples,
            *learning_rates(self.config, step, done),
            ramp=self.ramp(fraction),
            expected=self.config.expected_share * self._annealed(fraction),
            edges=self.config.cutoff if self._follows_edges(fraction) else None,
        )

    def share(self, fraction: float) -> float:
        """Share of this phase that is over after ``fraction`` of the run."""
        if not self.config.soft_share:
            return fraction
        return min(1.0, fraction / (1 - self.config.soft_phase))

    def _annealed(self, fraction: float) -> float:
        whole = self.config.anneal_share
        return min(1.0, self.share(fraction) / whole) if whole else 1.0

    def ramp(self, fraction: float) -> OpacityRamp:
        """The ramp of a step."""
        done, cutoff = self._annealed(fraction), self.config.cutoff
        return OpacityRamp(
            cutoff,
            height=cutoff + (0.5 - cutoff) * done,
            slope=STEEPEST**done if done < 1 else 1e6,
            leak=LEAK * (1 - done),
        )

    def _follows_edges(self, fraction: float) -> bool:
        return self.config.position_rate > 0 and self._annealed(fraction) >= EDGES_FROM

    def views(self, views: Sequence[View], fraction: float) -> Sequence[View]:
        return views

    def before_step(self, state: State, fraction: float) -> State:
        return state

    def after_step(self, state: State, moment: Moment) -> tuple[Cutting | Hybrid, State]:
        config, clock = self.config, moment.clock
        late = self._is_late(clock.fraction)
        settles, self._settled = late and not self._settled, self._settled or late
        if settles and not clock.done:
            state = self._settle(state, moment.views)
        if config.soft_share and Hybrid(config).share(clock.fraction) >= 0 and not clock.done:
            core = self.result(state)
            if len(core.faces):
                assert self._source is not None
                mesh = with_soft_splats(core, self._source, moment.views, config.soft_share, state.threads)
                return Hybrid.begin(config, mesh, state.threads, moment)
        return self, pruned(state, config, moment)

    def _is_late(self, fraction: float) -> bool:
        return self.share(fraction) >= 1 - self.config.settling

    def _settle(self, state: State, views: Sequence[View]) -> State:
        """Removes what no training view shows, and keeps to the budget of opaque triangles."""
        config, mesh = self.config, state.result()
        if self._most_opaque is None:
            if not config.hidden_hits:
                return state
            keep = visible_samples(mesh, views, config.cutoff, state.threads) >= config.hidden_hits
            return state.prune(keep) if keep.any() else state
        mesh = cut_mesh(mesh, config.cutoff)
        hits = visible_samples(mesh, views, config.cutoff, state.threads)
        mesh = fewer_triangles(mesh, hits, self._most_opaque, config.hidden_hits)
        return State.begin_opaque(mesh, config, state.threads) if len(mesh.faces) else state

    def result(self, state: State) -> SplatMesh:
        return cut_mesh(state.result(), self.config.cutoff)

    def arrays(self) -> dict[str, np.ndarray]:
        return {}


def check_for_cutoff(mesh: SplatMesh, config: FinetuneConfig, frozen: np.ndarray | None) -> None:
    """ValueError if ``mesh`` cannot become one of opaque triangles."""
    if frozen is not None:
        raise ValueError("frozen vertices are not for opacity 'cutoff'")
    if mesh.filter_px2:
        raise ValueError(
            "opacity 'cutoff' is for meshes without a filter: choose another footprint, or bake_filter"
        )
    if mesh.binding is not None:
        raise ValueError("opacity 'cutoff' cannot keep the binding to a base mesh")
    if mesh.blending == "linear":
        raise ValueError("opacity 'cutoff' is for meshes in display colours, this one is in linear light")
    if config.soft_share and mesh.face_splat is None:
        raise ValueError("soft_share chooses splats, but the mesh does not know its own (face_splat)")
