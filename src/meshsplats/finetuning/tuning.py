"""One step of a fine-tuning: draw a view, compare, go down the gradient. And what is dropped between
steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from meshsplats._arrays import evenly
from meshsplats.colors import srgb_to_linear
from meshsplats.dataset import View
from meshsplats.errors import DivergenceError, MissingDependencyError
from meshsplats.finetuning.config import BACKDROPS, FinetuneConfig, rates
from meshsplats.finetuning.losses import photometric_loss
from meshsplats.finetuning.state import GAIN, OFFSET, State
from meshsplats.mesh import splat_starts
from meshsplats.rendering.autograd import rasterize
from meshsplats.rendering.recorded import shown_pixels

try:
    import torch
except ImportError as error:
    raise MissingDependencyError("fine-tuning needs torch: pip install 'meshsplats[finetune]'") from error


IMPORTANCE_VIEWS = 64
"""Most training views, evenly spread, that are drawn to find out what they show of each splat."""


LEAST_LIGHT = {"display": 1e-3, "linear": 1e-4}
"""A pixel is finished when less of its light than this is left to what comes next; that is the background's.
It saves a tenth to a sixth of the time, and pictures change by 0.0002 (rms). Less in linear light, which is
lifted where it is dark."""


class Target(NamedTuple):
    """What a picture should look like."""

    color: torch.Tensor
    """(h, w, 3) float32 display RGB."""
    mask: torch.Tensor | None
    """(h, w) bool, True where pixels count; None: everywhere."""
    background: tuple[float, float, float]
    """Display RGB behind everything."""


def view_of_step(config: FinetuneConfig, step: int, views: int) -> int:
    """Number of the training view of step ``step``: all of them in another order in each epoch."""
    epoch, place = divmod(step, views)
    return int(np.random.default_rng([config.seed, epoch, 0]).permutation(views)[place])


def target_of(view: View, config: FinetuneConfig, step: int) -> Target:
    """The truth of ``view`` in step ``step``."""
    picture = view.picture
    background = view.background
    if picture.alpha is not None:
        background = BACKDROPS.get(config.background, background)
        if config.background == "random" or (config.background == "mixed" and step % 2):
            drawn = np.random.default_rng([config.seed, step, 1]).random(3)
            background = tuple(drawn.astype(np.float32).tolist())
    mask = None if picture.mask is None else torch.from_numpy(picture.mask)
    return Target(torch.from_numpy(picture.over(background)), mask, background)


def draw(state: State, view: View, background: Sequence[float]) -> torch.Tensor:
    """(h, w, 3) display RGB of the mesh, with gradients to the state's tensors."""
    linear = state.mesh.blending == "linear"
    behind = np.asarray(background, np.float32)
    raster = rasterize(
        state.vertices,
        state.mesh.faces,
        state.colors,
        view.camera,
        background=torch.from_numpy(srgb_to_linear(behind) if linear else behind),
        samples=state.config.samples,
        min_transmittance=LEAST_LIGHT[state.mesh.blending],
        face_splat=state.mesh.face_splat,
        depth_group=state.mesh.depth_group,
        filter_px2=state.mesh.filter_px2,
        threads=state.threads,
    )
    return encoded(raster.color) if linear else raster.color


def encoded(linear: torch.Tensor) -> torch.Tensor:
    """Display values of linear light, as ``colors.linear_to_srgb``; the slope at 0 is the finite one
    there."""
    curve = 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curve)


def loss_of(
    picture: torch.Tensor, target: Target, config: FinetuneConfig, threads: int | None
) -> torch.Tensor:
    """The loss as ``FinetuneConfig`` states it, () float32."""
    loss = photometric_loss(
        picture, target.color, ssim_weight=config.ssim_weight, mask=target.mask, threads=threads
    )
    if config.l2_weight:
        square = (picture - target.color).square()
        if target.mask is not None:
            square = square[target.mask]
        loss = loss + config.l2_weight * square.mean()
    return loss


def make_step(state: State, views: Sequence[View], step: int, fraction: float) -> float | None:
    """Step number ``step``, ``fraction`` (0 to 1) of the way; returns its loss.

    None if no pixel of the view counts: then nothing has changed. DivergenceError, before anything has
    changed, if loss or gradients are not finite.
    """
    config = state.config
    number = view_of_step(config, step, len(views))
    view = views[number]
    target = target_of(view, config, step)
    if target.mask is not None and not target.mask.any():
        return None
    picture = draw(state, view, target.background)
    if state.exposures is not None:
        own = state.exposures[number]
        picture = picture * own[GAIN] + own[OFFSET]
    loss = loss_of(picture, target, config, state.threads)
    value = float(loss.detach())
    if np.isfinite(value):
        loss.backward()
    if not np.isfinite(value) or not state.finite_gradients():
        state.forget_gradients()
        what = "the loss" if not np.isfinite(value) else "a gradient"
        raise DivergenceError(
            f"step {step + 1}, view {view.name!r}: {what} is not finite. Look at this view's picture and"
            " camera first; if it is sound, lower the rates. The last checkpoint is from before this step"
        )
    state.step(*rates(config, step, fraction), number)
    return value


def kept_faces(state: State, views: Sequence[View]) -> np.ndarray:
    """(f,) bool: the triangles that stay when the mesh is pruned."""
    config, mesh = state.config, state.result()
    keep = (mesh.colors[mesh.faces, 3] >= config.prune_opacity).any(axis=1)
    if config.prune_importance > 0:
        some = evenly(views, IMPORTANCE_VIEWS)
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
    positions = state.vertices.detach().numpy()
    looked_at = np.zeros(len(positions), bool)
    for view in evenly(views, IMPORTANCE_VIEWS):
        looked_at |= view.camera.sees(positions)
    return state.relocate(looked_at)


def importance(state: State, views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """What ``views`` show of each vertex: (v,) float32 pixels, (v,) bool whether any has it before it."""
    vertices, colors = state.vertices.detach().numpy(), state.colors.detach().numpy()
    shown = np.zeros(len(vertices), np.float32)
    before = np.zeros(len(shown), bool)
    for view in views:
        shown += shown_pixels(
            vertices,
            state.mesh.faces,
            colors,
            view.camera,
            mask=view.mask,
            samples=state.config.samples,
            face_splat=state.mesh.face_splat,
            depth_group=state.mesh.depth_group,
            filter_px2=state.mesh.filter_px2,
            threads=state.threads,
        )
        before |= view.camera.sees(vertices)
    return shown, before
