"""One optimisation step: render a view, compute the loss, descend the gradient. Pruning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from meshsplats._core.kernels import compare_images
from meshsplats.colors import encoding_slope, linear_to_srgb, srgb_to_linear
from meshsplats.datasets.splat_targets import RenderedSplats
from meshsplats.datasets.views import View
from meshsplats.errors import DivergenceError
from meshsplats.finetuning.config import BACKGROUNDS, FinetuneConfig, learning_rates
from meshsplats.finetuning.hybrid import SOLID, opaque_fraction, soft_fraction
from meshsplats.finetuning.opaque import expected_error, expected_share, follows_edges, ramp_of
from meshsplats.finetuning.state import GAIN, OFFSET, Gradients, State
from meshsplats.rendering.backward import ExpectedError, OpacityRamp
from meshsplats.rendering.edges import edge_gradients
from meshsplats.rendering.gpu_backward import AnyRendering, taped_rendering
from meshsplats.webgpu.frames import DrawSettings

TRAINING_MIN_TRANSMITTANCE = {"display": 1e-3, "linear": 1e-4}
"""Early termination: a pixel stops below this transmittance, and the background gets the rest. It saves a
tenth to a sixth of the time and changes images by 0.0002 (rms). The limit is lower in linear light, since
encoding for display amplifies dark values."""

MIXED_INTERVAL = 4
"""With background 'mixed', one step of this many has a random background. One in four is 0.1 dB better than
one in two, on the background that images are evaluated on."""

AREA_SAMPLES = 2
"""Samples along each side of a pixel when the target is the mean over each pixel's area."""


class Target(NamedTuple):
    """The ground truth of a step."""

    color: np.ndarray
    """(h, w, 3) float32 display RGB."""
    mask: np.ndarray | None
    """(h, w) bool, True where pixels count; None: all pixels count."""
    background: tuple[float, float, float]
    """Display RGB of the background."""


def view_of_step(config: FinetuneConfig, step: int, views: int) -> int:
    """Index of the training view of step ``step``, of ``views``: a new permutation in each epoch."""
    epoch, position = divmod(step, views)
    return int(np.random.default_rng([config.seed, epoch, 0]).permutation(views)[position])


def uses_point_targets(view: View, config: FinetuneConfig, fraction: float) -> bool:
    """Whether the target is sampled at the pixel centres after this ``fraction`` of the run (see
    ``FinetuneConfig.point_share``)."""
    source = view.source
    return fraction < config.point_share and isinstance(source, RenderedSplats) and source.look == "area"


def target_of(view: View, config: FinetuneConfig, step: int, points: bool = False) -> Target:
    """The target of ``view`` in step ``step``; ``points``: sampled at the pixel centres, not averaged."""
    image = view.source.points() if points and isinstance(view.source, RenderedSplats) else view.load()
    background = view.background
    if image.alpha is not None:
        background = BACKGROUNDS.get(config.background, background)
        if config.background == "random" or (config.background == "mixed" and step % MIXED_INTERVAL == 1):
            color = np.random.default_rng([config.seed, step, 1]).random(3)
            background = tuple(color.astype(np.float32).tolist())
    return Target(image.over(background), image.mask, background)


class RenderedView:
    """An image of the mesh, encoded for display, and its backward pass.

    Attributes:
        color: (h, w, 3) float32 display RGB.
    """

    def __init__(self, rendering: AnyRendering, linear: bool) -> None:
        self._rendering, self._linear = rendering, linear
        self.color = linear_to_srgb(rendering.color) if linear else rendering.color

    def backward(self, grad_color: np.ndarray, expected: ExpectedError | None = None) -> Gradients:
        """Gradients of vertices and colours, from ``grad_color``, (h, w, 3) float32, that of ``color``.

        Those of ``expected`` are added; it is for display blending.
        """
        assert not (self._linear and expected)
        if self._linear:
            grad_color = grad_color * encoding_slope(self._rendering.color)
        count = self._rendering.vertex_count
        gradients = Gradients(np.zeros((count, 3), np.float32), np.zeros((count, 4), np.float32))
        self._rendering.backward(
            grad_color,
            None,
            None,
            vertices=gradients.vertices,
            colors=gradients.colors,
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
    return 1 if fraction < config.one_sample_share else AREA_SAMPLES


def render_view(
    state: State,
    view: View,
    background: Sequence[float],
    samples: int,
    ramp: OpacityRamp | None = None,
) -> RenderedView:
    """The current mesh from the camera of ``view``, over ``background``, display RGB."""
    linear = state.mesh.blending == "linear"
    display = np.asarray(background, np.float32)
    rendering = taped_rendering(
        state.device,
        state.triangles,
        view.camera,
        background=srgb_to_linear(display) if linear else display,
        samples=samples,
        min_transmittance=TRAINING_MIN_TRANSMITTANCE[state.mesh.blending],
        ramp=ramp,
        threads=state.threads,
        limit=state.limit,
    )
    return RenderedView(rendering, linear)


class LossRates(NamedTuple):
    """Derivatives of the loss that ``FinetuneConfig`` defines, with respect to sums over all channels of the
    pixels that count."""

    l1: float
    """Of the sum of |x - y|."""
    ssim: float
    """Of the sum of SSIM."""
    l2: float
    """Of the sum of (x - y)^2."""
    at_zero: float
    """The loss where all sums are 0."""

    def loss(self, l1: float, ssim: float, l2: float) -> float:
        """The loss with these sums."""
        return self.at_zero + self.l1 * l1 + self.ssim * ssim + self.l2 * l2


def loss_rates(config: FinetuneConfig, target: Target) -> LossRates:
    mask, share = target.mask, config.ssim_weight
    count = target.color.size if mask is None else int(mask.sum()) * target.color.shape[2]
    return LossRates((1 - share) / count, -share / count, config.l2_weight / count, share)


def loss_of(
    image: np.ndarray, target: Target, config: FinetuneConfig, threads: int | None
) -> tuple[float, np.ndarray]:
    """The loss (see ``LossRates``), and its gradient, (h, w, 3) float32 like the ``image``."""
    mask = target.mask
    rates = loss_rates(config, target)
    compared = compare_images(
        image[None],
        target.color[None],
        None if mask is None else mask[None],
        l1_rate=rates.l1,
        ssim_rate=rates.ssim,
        gradient=True,
        threads=threads,
    )
    assert compared.gradient is not None
    gradient, squares = compared.gradient[0], 0.0
    if config.l2_weight:
        difference = image - target.color
        if mask is not None:
            difference[~mask] = 0  # masked values may be anything
        squares = float(np.square(difference).sum())
        difference *= np.float32(2 * rates.l2)
        gradient += difference
    return rates.loss(compared.l1, compared.ssim, squares), gradient


class ViewGradients(NamedTuple):
    """Loss and gradients of a view, all of them finite."""

    loss: float
    gradients: Gradients
    edges: bool
    """Whether they include the motion of edges."""


def make_step(state: State, views: Sequence[View], step: int, fraction: float) -> float | None:
    """Takes step ``step`` (from 0), after ``fraction`` (0 to 1) of the run; returns the loss of its view.

    Returns None if no pixel of the view counts; the state has not changed then. Raises DivergenceError,
    before anything has changed, if the loss or a gradient is not finite.
    """
    config = state.config
    index = view_of_step(config, step, len(views))
    if state.trains_on_gpu(views[index].camera):
        return _step_on_gpu(state, views[index], step, fraction)
    found = view_gradients(state, views, index, step, fraction)
    if found is None:
        return None
    steps_before = 0.0
    if state.solid is not None:
        steps_before = step * (1 - config.soft_phase) / fraction
        fraction = soft_fraction(config, fraction)
    else:
        fraction = opaque_fraction(config, fraction)
    color_rate, position_rate = learning_rates(config, step - steps_before, fraction)
    state.step(found.gradients, color_rate, position_rate, index, edges=found.edges)
    return found.loss


def view_gradients(
    state: State, views: Sequence[View], index: int, step: int, fraction: float
) -> ViewGradients | None:
    """Loss and gradients of the training view of that ``index`` in step ``step``, after ``fraction`` of the
    run; None if none of its pixels counts. DivergenceError if they are not finite."""
    config, view = state.config, views[index]
    hybrid = state.solid is not None
    fraction = soft_fraction(config, fraction) if hybrid else opaque_fraction(config, fraction)
    points = not hybrid and uses_point_targets(view, config, fraction)
    target = target_of(view, config, step, points)
    if target.mask is not None and not target.mask.any():
        return None
    # Viewers shade a pixel once, with MSAA too: values at pixel centres must be right as well as means.
    centers = points or (hybrid and config.samples is None and step % 2 == 1)
    samples = 1 if centers else samples_of(view, config, 1.0 if hybrid else fraction)
    ramp = None if hybrid else ramp_of(config, fraction)
    rendered = render_view(state, view, target.background, samples, ramp)
    image = rendered.color
    if state.exposures is not None:
        exposure = state.exposures[index]
        image = image * exposure[GAIN] + exposure[OFFSET]
    loss, grad_image = loss_of(image, target, config, state.threads)
    if not np.isfinite(loss):
        raise _divergence(step, view, "the loss")
    grad_exposure = None
    if state.exposures is not None:
        grad_exposure = exposure_gradient(rendered.color, grad_image)
        grad_image = grad_image * exposure[GAIN]
    edges = None
    # Blended triangles in front of an edge are neglected: they are few.
    if follows_edges(config, 1.0 if hybrid else fraction) and not (hybrid and centers):
        edges = edge_gradients(
            replace(state.mesh, vertices=state.vertices, colors=state.colors),
            view.camera,
            SOLID if hybrid else config.cutoff,
            grad_image,
            background=target.background,
            beyond=state.beyond,
            threads=state.threads,
        )
    expected, share = None, 0.0 if hybrid else expected_share(config, fraction)
    if share:
        expected = expected_error(target.color, target.mask, config, share)
        grad_image = grad_image * np.float32(1 - share)
    gradients = rendered.backward(grad_image, expected)._replace(exposure=grad_exposure)
    if edges is not None:
        np.add(gradients.vertices, edges, out=gradients.vertices)
    if not gradients.finite():
        raise _divergence(step, view, "a gradient")
    return ViewGradients(loss, gradients, edges is not None)


def _step_on_gpu(state: State, view: View, step: int, fraction: float) -> float | None:
    """``make_step`` where the loss and Adam are on the GPU, too."""
    config = state.config
    points = uses_point_targets(view, config, fraction)
    target = target_of(view, config, step, points)
    mask = target.mask
    if mask is not None and not mask.any():
        return None
    samples = 1 if points else samples_of(view, config, fraction)
    rates = learning_rates(config, step, fraction)
    loss_by = loss_rates(config, target)
    settings = DrawSettings(
        samples=samples,
        min_transmittance=TRAINING_MIN_TRANSMITTANCE["display"],
        filter_px2=state.mesh.filter_px2,
    )
    sums = state.step_on_gpu(view.camera, settings, target.color, mask, target.background, loss_by[:3], rates)
    loss = loss_by.loss(*sums[:3])
    if not (np.isfinite(loss) and sums.finite):
        raise _divergence(step, view, "a gradient" if np.isfinite(loss) else "the loss")
    return loss


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
