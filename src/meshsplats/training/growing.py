"""The phase of a training: the set of fans grows, on images that become larger."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats.datasets.reduced import opaque_views, reduced_views
from meshsplats.datasets.views import ImageCache, View
from meshsplats.finetuning.config import learning_rates
from meshsplats.finetuning.initial import order_of
from meshsplats.finetuning.phases.blended import Blended
from meshsplats.finetuning.phases.phase import Moment
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import Plan, view_of_step
from meshsplats.scene.mesh import SplatMesh
from meshsplats.training.config import TrainConfig
from meshsplats.training.growth import NearFields, corners_of, fan_count, grow, score, select_fans
from meshsplats.training.schedule import budget, events_passed, image_factor

MISFIT = 3.0
"""A photograph whose mean loss is this many times the median of all does not fit the others."""
REDUCED_PART = 3
"""Reduced images are kept up to the limit of the image cache divided by this."""


class Growing:
    """The only phase of a training. Its steps are those of blended triangles.

    Args:
        config: of the run.
        start: the fans before the first step.
        views: all training views.
        fraction: share of the run that is over when it begins, or is resumed.
        cache_bytes: limit of the data set's image cache.
    """

    usual = 0.0
    listing = None

    def __init__(
        self, config: TrainConfig, start: SplatMesh, views: Sequence[View], fraction: float, cache_bytes: int
    ) -> None:
        self.config = config
        self._steps = Blended(config, order_of(start, config))
        self._cache_bytes = cache_bytes // REDUCED_PART
        self._factor = 0.0
        self._reduced: Sequence[View] = ()
        self._first_fans = fan_count(start)
        self._near = NearFields.around(views, start)
        self._events = events_passed(config, fraction)
        self._loss_sums, self._loss_counts = np.zeros((2, len(views)))

    def plan(self, view: View, step: int, fraction: float) -> Plan:
        return self._steps.plan(view, step, fraction)

    def views(self, views: Sequence[View], fraction: float) -> Sequence[View]:
        factor = image_factor(self.config, fraction)
        if factor != self._factor:
            store = ImageCache(self._cache_bytes)  # smaller images than these are not needed any more
            # With alpha, some steps have a random background: what is opaque must be covered.
            self._factor, self._reduced = factor, reduced_views(opaque_views(views), factor, store)
        return self._reduced

    def before_step(self, state: State, fraction: float) -> State:
        return self._steps.before_step(state, fraction)

    def after_step(self, state: State, moment: Moment) -> tuple[Growing, State]:
        config, clock = self.config, moment.clock
        step = clock.step - 1
        if moment.loss is not None and clock.fraction >= max(config.growth_end, config.half_share):
            view = view_of_step(config, step, len(moment.views))
            self._loss_sums[view] += moment.loss
            self._loss_counts[view] += 1
        if config.shape_decay:
            # In proportion to the learning rate, as the steps that it is weighed against.
            color_rate, _ = learning_rates(config, step, clock.fraction)
            share = config.shape_decay * color_rate / config.color_rate
            state.round_fans(corners_of(state.mesh), min(share, 1.0))
        # In a run by minutes, a slow step or report may put the fraction back.
        before, self._events = self._events, max(self._events, events_passed(config, clock.fraction))
        if self._events <= before or clock.done:
            return self, state
        stray = self._near.contain(state.result())
        if stray.any() and not stray.all():
            state = select_fans(state, np.flatnonzero(~stray))
        target = budget(config, self._events, self._first_fans)
        found = score(state, self.views(moment.views, clock.fraction), self._events, clock.fraction)
        return self, grow(state, found, target)

    def result(self, state: State) -> SplatMesh:
        """The fans of ``state``, but those in the near field of a camera, in the order of the result."""
        mesh = replace(self._steps.result(state), attributes={})
        assert mesh.face_splat is not None
        stray = self._near.contain(mesh)
        return mesh.take(~stray[mesh.face_splat]) if stray.any() and not stray.all() else mesh

    def arrays(self) -> dict[str, np.ndarray]:
        return {}

    def misfits(self, views: Sequence[View]) -> list[str]:
        """Names of the training views whose images the mesh cannot show as it shows the others, judged by
        the losses since both the last growth event and the step from which on images have their whole size.
        Of a resumed run, only those since it was resumed count."""
        known = np.flatnonzero(self._loss_counts)
        if not len(known):
            return []
        means = self._loss_sums[known] / self._loss_counts[known]
        return [views[i].name for i in known[means > MISFIT * np.median(means)]]
