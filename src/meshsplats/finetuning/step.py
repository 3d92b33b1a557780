"""One step of a fine-tuning: draw a view, compare, go down the gradient. And what is dropped between
steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from meshsplats._arrays import subsample
from meshsplats._core.kernels import compare_images
from meshsplats.colors import linear_to_srgb, srgb_to_linear
from meshsplats.datasets.splat_targets import RenderedSplats
from meshsplats.datasets.views import View
from meshsplats.errors import DivergenceError
from meshsplats.finetuning.config import BACKDROPS, FinetuneConfig, rates
from meshsplats.finetuning.state import GAIN, OFFSET, Gradients, State
from meshsplats.mesh import splat_starts
from meshsplats.rendering.backward import TapedRendering, visible_pixels

IMPORTANCE_VIEWS = 64
"""Most training views, evenly spread, that are drawn to find out what they show of each splat."""


LEAST_LIGHT = {"display": 1e-3, "linear": 1e-4}
"""A pixel is finished when less of its light than this is left to what comes next; that is the background's.
It saves a tenth to a sixth of the time, and pictures change by 0.0002 (rms). Less in linear light, which is
lifted where it is dark."""


MIXED = 4
"""With background 'mixed', one step in so many has a random background. On the background that images are
compared on, one in four is 0.1 dB better than one in two."""

AREA_SAMPLES = 2
"""Side of the grid of samples with which a mesh is compared with means over each pixel's area."""


class Target(NamedTuple):
    """What a picture should look like."""

    color: np.ndarray
    """(h, w, 3) float32 display RGB."""
    mask: np.ndarray | None
    """(h, w) bool, True where pixels count; None: everywhere."""
    background: tuple[float, float, float]
    """Display RGB behind everything."""


def view_of_step(config: FinetuneConfig, step: int, views: int) -> int:
    """Number of the training view of step ``step``: all of them in another order in each epoch."""
    epoch, place = divmod(step, views)
    return int(np.random.default_rng([config.seed, epoch, 0]).permutation(views)[place])


def learns_from_points(view: View, config: FinetuneConfig, fraction: float) -> bool:
    """Whether ``view`` still gives its values at the pixels' centres (see ``FinetuneConfig.point_share``)."""
    source = view.source
    return fraction < config.point_share and isinstance(source, RenderedSplats) and source.look == "area"


def target_of(view: View, config: FinetuneConfig, step: int, points: bool = False) -> Target:
    """The truth of ``view`` in step ``step``; ``points``: at the pixels' centres, not of their areas."""
    picture = view.source.points() if points and isinstance(view.source, RenderedSplats) else view.load()
    background = view.background
    if picture.alpha is not None:
        background = BACKDROPS.get(config.background, background)
        if config.background == "random" or (config.background == "mixed" and step % MIXED == 1):
            drawn = np.random.default_rng([config.seed, step, 1]).random(3)
            background = tuple(drawn.astype(np.float32).tolist())
    return Target(picture.over(background), picture.mask, background)


class Drawn:
    """A picture of the mesh, with a way back.

    Attributes:
        color: (h, w, 3) float32 display RGB.
    """

    def __init__(self, recorded: TapedRendering, linear: bool) -> None:
        self._recorded, self._linear = recorded, linear
        self.color = linear_to_srgb(recorded.color) if linear else recorded.color

    def back(self, towards: np.ndarray) -> Gradients:
        """Those of vertices and colours, from that of ``color``, (h, w, 3) float32."""
        if self._linear:
            towards = towards * encoding_slope(self._recorded.color)
        count = self._recorded.vertex_count
        gradients = Gradients(np.zeros((count, 3), np.float32), np.zeros((count, 4), np.float32))
        self._recorded.backward(towards, None, None, vertices=gradients.vertices, colors=gradients.colors)
        return gradients


def samples_of(view: View, config: FinetuneConfig) -> int:
    """Side of the grid of samples with which the mesh is drawn to be compared with ``view``."""
    if config.samples is not None:
        return config.samples
    viewer = isinstance(view.source, RenderedSplats) and view.source.look == "splats"
    return 1 if viewer else AREA_SAMPLES


def draw(state: State, view: View, background: Sequence[float], samples: int) -> Drawn:
    """The mesh as ``view`` has it before it, over a display ``background``."""
    linear = state.mesh.blending == "linear"
    behind = np.asarray(background, np.float32)
    recorded = TapedRendering(
        state.vertices,
        state.mesh.faces,
        state.colors,
        None,
        view.camera,
        background=srgb_to_linear(behind) if linear else behind,
        samples=samples,
        min_transmittance=LEAST_LIGHT[state.mesh.blending],
        face_splat=state.mesh.face_splat,
        depth_group=state.mesh.depth_group,
        filter_px2=state.mesh.filter_px2,
        threads=state.threads,
    )
    return Drawn(recorded, linear)


def encoding_slope(linear: np.ndarray) -> np.ndarray:
    """Derivative of ``colors.linear_to_srgb``, float32; the finite one at 0 and below."""
    power = np.maximum(linear, np.float32(0.0031308)) ** np.float32(1 / 2.4 - 1)
    return np.where(linear <= np.float32(0.0031308), np.float32(12.92), np.float32(1.055 / 2.4) * power)


def loss_of(
    picture: np.ndarray, target: Target, config: FinetuneConfig, threads: int | None
) -> tuple[float, np.ndarray]:
    """The loss as ``FinetuneConfig`` states it, and its gradient, (h, w, 3) float32 like the ``picture``."""
    mask = target.mask
    count = picture.size if mask is None else int(mask.sum()) * picture.shape[2]
    share = config.ssim_weight
    compared = compare_images(
        picture[None],
        target.color[None],
        None if mask is None else mask[None],
        l1_rate=(1 - share) / count,
        ssim_rate=-share / count,
        gradient=True,
        threads=threads,
    )
    assert compared.gradient is not None
    loss = (1 - share) * compared.l1 / count + share * (1 - compared.ssim / count)
    gradient = compared.gradient[0]
    if config.l2_weight:
        difference = picture - target.color
        if mask is not None:
            difference[~mask] = 0  # values under the mask are never looked at
        loss += config.l2_weight * float(np.square(difference).sum()) / count
        difference *= np.float32(2 * config.l2_weight / count)
        gradient += difference
    return loss, gradient


def make_step(state: State, views: Sequence[View], step: int, fraction: float) -> float | None:
    """Step number ``step``, ``fraction`` (0 to 1) of the way; returns its loss.

    None if no pixel of the view counts: then nothing has changed. DivergenceError, before anything has
    changed, if loss or gradients are not finite.
    """
    config = state.config
    number = view_of_step(config, step, len(views))
    view = views[number]
    points = learns_from_points(view, config, fraction)
    target = target_of(view, config, step, points)
    if target.mask is not None and not target.mask.any():
        return None
    drawn = draw(state, view, target.background, 1 if points else samples_of(view, config))
    picture = drawn.color
    if state.exposures is not None:
        own = state.exposures[number]
        picture = picture * own[GAIN] + own[OFFSET]
    loss, towards = loss_of(picture, target, config, state.threads)
    what, gradients = "the loss", None
    if np.isfinite(loss):
        exposure = None
        if state.exposures is not None:
            exposure = exposure_gradient(drawn.color, towards)
            towards = towards * own[GAIN]
        what, gradients = "a gradient", drawn.back(towards)._replace(exposure=exposure)
    if gradients is None or not gradients.finite():
        raise DivergenceError(
            f"step {step + 1}, view {view.name!r}: {what} is not finite. Look at this view's picture and"
            " camera first; if it is sound, lower the rates. The last checkpoint is from before this step"
        )
    state.step(gradients, *rates(config, step, fraction), number)
    return loss


def exposure_gradient(picture: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """(6,) float32: of gain and offset of ``picture * gain + offset``, whose gradient is ``towards``."""
    gradient = np.empty(6, np.float32)
    # Row by row first: quick, and no sum is long enough to lose digits.
    gradient[GAIN] = np.einsum("hwc,hwc->hc", picture, towards).sum(axis=0, dtype=np.float64)
    gradient[OFFSET] = np.einsum("hwc->hc", towards).sum(axis=0, dtype=np.float64)
    return gradient


def kept_faces(state: State, views: Sequence[View]) -> np.ndarray:
    """(f,) bool: the triangles that stay when the mesh is pruned."""
    config, mesh = state.config, state.result()
    keep = (mesh.colors[mesh.faces, 3] >= config.prune_opacity).any(axis=1)
    if config.prune_importance > 0:
        some = subsample(views, IMPORTANCE_VIEWS)
        shown, before = importance(state, some)
        shown *= len(views) / len(some)  # as if all had been looked at
        corners_shown, corners_before = shown[mesh.faces].sum(axis=1), before[mesh.faces].any(axis=1)
        if mesh.face_splat is not None and len(mesh.faces):
            starts = splat_starts(mesh.face_splat)
            counts = np.diff(np.append(starts, len(mesh.faces)))
            # A corner that several triangles share counts once for each, the same in all splats.
            corners_shown = np.repeat(np.add.reduceat(corners_shown, starts), counts)
            corners_before = np.repeat(np.logical_or.reduceat(corners_before, starts), counts)
        keep &= ~corners_before | (corners_shown >= config.prune_importance)
    return keep if keep.any() else np.ones(len(keep), bool)


def relocate(state: State, views: Sequence[View]) -> int:
    """Moves splats to where they are needed (see ``relocation``); returns how many."""
    if not state.config.relocate_share or state.bound is not None:
        return 0
    positions = state.vertices
    looked_at = np.zeros(len(positions), bool)
    for view in subsample(views, IMPORTANCE_VIEWS):
        looked_at |= view.camera.sees(positions)
    return state.relocate(looked_at)


def importance(state: State, views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """What ``views`` show of each vertex: (v,) float32 pixels, (v,) bool whether any has it before it."""
    vertices, colors = state.vertices, state.colors
    shown = np.zeros(len(vertices), np.float32)
    before = np.zeros(len(shown), bool)
    for view in views:
        shown += visible_pixels(
            vertices,
            state.mesh.faces,
            colors,
            view.camera,
            mask=view.mask,
            samples=samples_of(view, state.config),
            face_splat=state.mesh.face_splat,
            depth_group=state.mesh.depth_group,
            filter_px2=state.mesh.filter_px2,
            threads=state.threads,
        )
        before |= view.camera.sees(vertices)
    return shown, before
