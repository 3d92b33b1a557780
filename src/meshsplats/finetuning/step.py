"""One optimisation step: render a view, compute the loss, descend the gradient. Pruning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from meshsplats.datasets.silhouettes import has_silhouettes
from meshsplats.datasets.splat_targets import RenderedSplats, are_rendered
from meshsplats.datasets.views import View, ViewImage
from meshsplats.errors import DivergenceError
from meshsplats.finetuning.config import BACKGROUNDS, HARMONICS_RATE, FinetuneConfig
from meshsplats.finetuning.gradients import Gradients, Rates, StepImage
from meshsplats.finetuning.loss import DefaultLoss, Loss, Target, loss_name, own_loss
from meshsplats.finetuning.opaque import expected_error
from meshsplats.finetuning.state import GAIN, OFFSET, State
from meshsplats.rendering.backward import ExpectedError, OpacityRamp, TapeOptions
from meshsplats.rendering.edges import edge_gradients
from meshsplats.rendering.engine import FusedSteps, Need, Taped
from meshsplats.rendering.shading import shaded
from meshsplats.scene.colors import encoding_slope, linear_to_srgb, srgb_to_linear
from meshsplats.scene.draw_order import DrawOrder

Config = TypeVar("Config", bound=FinetuneConfig)

TRAINING_MIN_TRANSMITTANCE = {"display": 1e-3, "linear": 1e-4}
"""Early termination: a pixel stops below this transmittance, and the background gets the rest. It saves a
tenth to a sixth of the time and changes images by 0.0002 (rms). The limit is lower in linear light, since
encoding for display amplifies dark values."""

MIXED_INTERVAL = 4
"""With background 'mixed', one step of this many has a random background. One in four is 0.1 dB better than
one in two, on the background that images are evaluated on."""

AREA_SAMPLES = 2
"""Samples along each side of a pixel when the target is the mean over each pixel's area."""

ONE_SAMPLE_SHARE = 0.85
"""``one_sample_share`` for photographs without alpha. Bonsai, 300 steps: 26.23 dB in two thirds of the time
in which 2 x 2 samples throughout have 26.26."""

BY_SPLAT_SHARE = 0.6
"""``by_splat_share`` for photographs. Fine-tuning splats of lego on its photographs, 1.5 minutes: 34.34 dB,
exact throughout 34.09, until 0.9 34.10. On images of splats exact order is better: playbot, a minute, 39.92
and 39.03 dB."""

PHOTOGRAPHS_HARMONICS_RATE = 0.005
"""``harmonics_rate`` for photographs. Splats of lego, tuned 4.3 minutes on its photographs: 35.69 dB, with
0.02 35.40."""


DROPOUT_PASSES = 10, 40
"""How often each view was seen when dropout begins, and when it is whole."""
DROPOUT = 0.15
"""``dropout`` for photographs that are ``FEW``. Saharov, 28 photographs, 1,100 steps: 20.69 dB, without
20.33."""
FEW = 30, 60
"""Numbers of photographs up to which it is whole, and from which on it is 0. Lego, 100 photographs, 2,500
steps at half the size: 34.00 dB, without 34.27."""


class Plan(NamedTuple):
    """How a step draws its view, and what follows from the gradient."""

    points: bool
    """Whether the target is sampled at the pixel centres, not averaged."""
    samples: int
    """Along each side of a pixel."""
    color_rate: float
    position_rate: float
    """Learning rates."""
    ramp: OpacityRamp | None = None
    """Changes opacities."""
    expected: float = 0.0
    """Share of the expected error in the loss."""
    edges: float | None = None
    """Least opacity at which edges are visible and move positions; None: their motion does not count."""
    listing: DrawOrder | None = None
    """Order of a file in which triangles are blended; None: that of the mesh."""
    dropout: float = 0.0
    """Share of the splats that are left out."""


class Schedule(Protocol):
    """Decides how steps are taken."""

    def plan(self, view: View, step: int, fraction: float) -> Plan:
        """How step ``step`` (from 0), of ``view``, is taken after ``fraction`` (0 to 1) of the run."""


def view_of_step(config: FinetuneConfig, step: int, views: int) -> int:
    """Index of the training view of step ``step``, of ``views``: a new permutation in each epoch."""
    epoch, position = divmod(step, views)
    return int(np.random.default_rng([config.seed, epoch, 0]).permutation(views)[position])


def dropout_share(config: FinetuneConfig, passes: float) -> float:
    """Share of the splats that a step leaves out, where each view was seen ``passes`` times."""
    first, whole = DROPOUT_PASSES
    return (config.dropout or 0.0) * min(max((passes - first) / (whole - first), 0.0), 1.0)


def dropout_factors(state: State, share: float, step: int) -> np.ndarray:
    """(v,) float32: 0 for the vertices of splats that step ``step`` leaves out, a ``share`` of all; by what
    the opacities of the others grow, at most to 1."""
    splats = state.mesh.splats
    kept = np.random.default_rng([state.config.seed, step, 2]).random(len(splats)) >= share
    factors = kept.astype(np.float32)[np.maximum(splats.of_vertex, 0)] / np.float32(1 - share)
    return np.minimum(factors, 1 / np.maximum(state.colors[:, 3], np.float32(1e-6)))


def uses_point_targets(view: View, config: FinetuneConfig, fraction: float) -> bool:
    """Whether the target is sampled at the pixel centres after this ``fraction`` of the run (see
    ``FinetuneConfig.point_share``)."""
    source = view.source
    return fraction < config.point_share and isinstance(source, RenderedSplats) and source.look == "area"


def exposure_of(state: State, view: int) -> np.ndarray | None:
    """(6,) gain and offset of the training view of this index, as they are now; None if none are fitted."""
    return None if state.exposures is None else state.exposures[view]


def exposed(image: np.ndarray, exposure: np.ndarray | None) -> np.ndarray:
    """``image`` (..., 3) as a photograph of ``exposure`` (6,) shows it: times the gain, plus the offset."""
    return image if exposure is None else image * exposure[GAIN] + exposure[OFFSET]


def exposed_over(image: ViewImage, background: Sequence[float], exposure: np.ndarray | None) -> np.ndarray:
    """(h, w, 3) float32 ``image``, a photograph of ``exposure``, over a background in the same exposure: what
    the mesh over ``background``, display RGB, is to be, ``exposed`` as a whole."""
    return image.over(exposed(np.asarray(background, np.float32), exposure))


def target_of(
    view: View,
    config: FinetuneConfig,
    step: int,
    points: bool = False,
    exposure: np.ndarray | None = None,
) -> Target:
    """The target of ``view`` in step ``step``; ``points``: sampled at the pixel centres, not averaged.

    ``exposure`` is that of the whole image of the step (``exposed_over``).
    """
    image = view.source.points() if points and isinstance(view.source, RenderedSplats) else view.load()
    background = view.background
    if image.alpha is not None:
        background = BACKGROUNDS.get(config.background, background)
        if config.background == "random" or (config.background == "mixed" and step % MIXED_INTERVAL == 1):
            color = np.random.default_rng([config.seed, step, 1]).random(3)
            background = tuple(color.astype(np.float32).tolist())
    mask = None if image.mask is None else np.ascontiguousarray(image.mask)
    return Target(exposed_over(image, background, exposure), mask, background)


class RenderedView:
    """An image of the mesh, encoded for display, and its backward pass.

    Attributes:
        color: (h, w, 3) float32 display RGB.
    """

    def __init__(self, rendering: Taped, linear: bool, harmonics: np.ndarray | None = None) -> None:
        self._rendering, self._linear, self._harmonics = rendering, linear, harmonics
        self.color = linear_to_srgb(rendering.color) if linear else rendering.color

    def backward(self, grad_color: np.ndarray, expected: ExpectedError | None = None) -> Gradients:
        """Gradients of vertices and colours, from ``grad_color``, (h, w, 3) float32, that of ``color``.

        Those of ``expected`` are added; it is for display blending.
        """
        assert not (self._linear and expected)
        if self._linear:
            grad_color = grad_color * encoding_slope(self._rendering.color)
        count = self._rendering.vertex_count
        gradients = Gradients(
            np.zeros((count, 3), np.float32),
            np.zeros((count, 4), np.float32),
            None if self._harmonics is None else np.zeros_like(self._harmonics),
        )
        self._rendering.backward(
            grad_color,
            None,
            None,
            vertices=gradients.vertices,
            colors=gradients.colors,
            harmonics=gradients.harmonics,
            expected=expected,
        )
        return gradients


def samples_of(view: View, config: FinetuneConfig, fraction: float = 1.0) -> int:
    """Samples along each side of a pixel when the mesh is compared with ``view``, after this ``fraction`` of
    the run."""
    if config.samples is not None:
        return config.samples
    if isinstance(view.source, RenderedSplats):
        return 1 if view.source.look == "splats" else AREA_SAMPLES
    return 1 if fraction < (config.one_sample_share or 0.0) else AREA_SAMPLES


def for_views(config: Config, views: Sequence[View]) -> Config:
    """``config`` with the numbers that it leaves to the kind of ``views``: ``one_sample_share``,
    ``by_splat_share``, ``harmonics_rate`` and ``dropout``."""
    rendered = are_rendered(views)
    one_sample, by_splat, harmonics = config.one_sample_share, config.by_splat_share, config.harmonics_rate
    if one_sample is None:
        one_sample = 0.0 if config.cuts or rendered or has_silhouettes(views) else ONE_SAMPLE_SHARE
    if by_splat is None and not config.cuts:
        by_splat = 0.0 if rendered else BY_SPLAT_SHARE
    if harmonics is None:
        harmonics = HARMONICS_RATE if rendered else PHOTOGRAPHS_HARMONICS_RATE
    dropout = config.dropout
    if dropout is None:
        share = (FEW[1] - len(views)) / (FEW[1] - FEW[0])
        dropout = 0.0 if rendered else DROPOUT * min(max(share, 0.0), 1.0)
    return replace(
        config,
        one_sample_share=one_sample,
        by_splat_share=by_splat,
        harmonics_rate=harmonics,
        dropout=dropout,
    )


def tape_options(state: State, background: Sequence[float], plan: Plan) -> TapeOptions:
    """Those of the image of a step over ``background``, display RGB."""
    display, blending = np.asarray(background, np.float32), state.mesh.blending
    return TapeOptions(
        srgb_to_linear(display) if blending == "linear" else display,
        plan.samples,
        TRAINING_MIN_TRANSMITTANCE[blending],
        ramp=plan.ramp,
        listing=plan.listing,
    )


class ViewGradients(NamedTuple):
    """Loss and gradients of a view, all of them finite."""

    loss: float
    gradients: Gradients
    edges: bool
    """Whether they include the motion of edges."""


def make_step(
    state: State,
    views: Sequence[View],
    step: int,
    fraction: float,
    schedule: Schedule,
    loss: Loss | None = None,
) -> float | None:
    """Takes step ``step`` (from 0), after ``fraction`` (0 to 1) of the run; returns the loss of its view.

    Args:
        state: changes.
        views: the training views.
        schedule: says how.
        loss: that of the configuration by default.

    Returns None if no pixel of the view counts; the state has not changed then. Raises DivergenceError,
    before anything has changed, if the loss or a gradient is not finite.
    """
    config = state.config
    index = view_of_step(config, step, len(views))
    view = views[index]
    plan = schedule.plan(view, step, fraction)
    exposure = exposure_of(state, index)
    target = target_of(view, config, step, plan.points, exposure)
    if target.mask is not None and not target.mask.any():
        return None
    loss = loss or DefaultLoss.of(config, state.threads)
    default = loss if isinstance(loss, DefaultLoss) else None
    plan = plan._replace(dropout=dropout_share(config, step / len(views)))
    needs: list[Need] = ["loss"] if default is None else []
    needs += ["dropout"] if plan.dropout else []
    steps = state.fused_steps(view.camera, needs)
    if steps is not None and default is not None:
        return _fused_step(state, steps, view, step, plan, target, default)
    found = view_gradients(state, (index, view), step, plan, target, loss)
    state.step(found.gradients, plan.color_rate, plan.position_rate, index, edges=found.edges)
    return found.loss


def view_gradients(
    state: State, numbered: tuple[int, View], step: int, plan: Plan, target: Target, loss: Loss
) -> ViewGradients:
    """Loss and gradients of the training view ``numbered``. DivergenceError if they are not finite."""
    config, (index, view) = state.config, numbered
    options = tape_options(state, target.background, plan)
    factors = dropout_factors(state, plan.dropout, step) if plan.dropout else None
    taped, linear = state.tape(view.camera, options, factors), state.mesh.blending == "linear"
    rendered = RenderedView(taped, linear, state.harmonics)
    exposure = exposure_of(state, index)
    image = exposed(rendered.color, exposure)
    if isinstance(loss, DefaultLoss):
        value, grad_image = loss(image, target)
    else:
        value, grad_image = own_loss(loss, image, target)
        if np.isfinite(value) and not np.isfinite(grad_image).all():
            raise _divergence(step, view, f"the gradient of the loss {loss_name(loss)}")
    if not np.isfinite(value):
        raise _divergence(step, view, "the loss")
    grad_exposure = None
    if exposure is not None:
        grad_exposure = exposure_gradient(rendered.color, grad_image)
        grad_image = grad_image * exposure[GAIN]
    edges = None
    if plan.edges is not None:
        seen = shaded(state.triangles, view.camera, threads=state.threads)
        edges = edge_gradients(
            replace(state.mesh, vertices=seen.vertices, colors=seen.colors, harmonics=None),
            view.camera,
            plan.edges,
            grad_image,
            background=target.background,
            across=state.across,
            threads=state.threads,
        )
    expected, share = None, plan.expected
    if share:
        expected = expected_error(target.color, target.mask, config, share)
        grad_image = grad_image * np.float32(1 - share)
    gradients = rendered.backward(grad_image, expected)._replace(exposure=grad_exposure)
    if factors is not None:
        gradients.colors[:, 3] *= factors
    if edges is not None:
        np.add(gradients.vertices, edges, out=gradients.vertices)
    if not gradients.finite():
        raise _divergence(step, view, "a gradient")
    return ViewGradients(value, gradients, edges is not None)


def _fused_step(
    state: State, steps: FusedSteps, view: View, step: int, plan: Plan, target: Target, loss: DefaultLoss
) -> float:
    """``make_step`` where the loss and Adam are with the image, too."""
    image = StepImage(view.camera, tape_options(state, target.background, plan), target.color, target.mask)
    by_sums = loss.weights(target)
    sums = state.fused_step(steps, image, by_sums, Rates(plan.color_rate, plan.position_rate))
    value = by_sums.loss(*sums[:3])
    if not (np.isfinite(value) and sums.finite):
        raise _divergence(step, view, "a gradient" if np.isfinite(value) else "the loss")
    return value


def _divergence(step: int, view: View, culprit: str) -> DivergenceError:
    return DivergenceError(
        f"step {step + 1}, view {view.name!r}: {culprit} is not finite. Check this view's image and camera"
        " first; if they are sound, lower the learning rates. The last checkpoint is from before this step"
    )


def exposure_gradient(image: np.ndarray, grad_image: np.ndarray) -> np.ndarray:
    """(6,) float32 gradient of gain and offset, where ``grad_image`` is that of ``image * gain + offset``."""
    gradient = np.empty(6, np.float32)
    # Sums of single rows first: fast, and short enough for float32.
    gradient[GAIN] = np.einsum("hwc,hwc->hc", image, grad_image).sum(axis=0, dtype=np.float64)
    gradient[OFFSET] = np.einsum("hwc->hc", grad_image).sum(axis=0, dtype=np.float64)
    return gradient


def kept_faces(state: State) -> np.ndarray:
    """(f,) bool: the triangles that pruning keeps."""
    keep = (state.colors[state.mesh.faces, 3] >= state.config.prune_opacity).any(axis=1)
    return keep if keep.any() else np.ones(len(keep), bool)
