"""The loss of a step: how far an image is from its target, and the gradient of that.

``finetune(mesh, dataset, loss=mine)`` takes any function of this kind in place of the default one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import NamedTuple, Protocol

import numpy as np

from meshsplats._common.kinds import described
from meshsplats._core.kernels import compare_images
from meshsplats.finetuning.config import FinetuneConfig

DEFAULT = "default"
"""Name of the default loss in checkpoints."""


class Target(NamedTuple):
    """The ground truth of a step."""

    color: np.ndarray
    """(h, w, 3) float32 display RGB."""
    mask: np.ndarray | None
    """(h, w) bool, True where pixels count, at least one; None: all pixels count. Others may have any
    colour, not finite ones, too."""
    background: tuple[float, float, float]
    """Display RGB of the background."""


class Loss(Protocol):
    """The loss of one image."""

    def __call__(self, image: np.ndarray, target: Target, /) -> tuple[float, np.ndarray]:
        """The loss of ``image`` (h, w, 3) float32, display RGB, and its gradient of that shape. Values beyond
        [0, 1] are possible. Pixels that do not count have a gradient of 0."""


class LossWeights(NamedTuple):
    """Derivatives of the default loss with respect to sums over all channels of the pixels that count."""

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


@dataclass(frozen=True)
class DefaultLoss:
    """The loss that ``FinetuneConfig`` defines, by the compiled core. An engine that has the same sums takes
    the ``weights`` in its place."""

    ssim_weight: float
    l2_weight: float
    threads: int | None = None

    @classmethod
    def of(cls, config: FinetuneConfig, threads: int | None = None) -> DefaultLoss:
        return cls(config.ssim_weight, config.l2_weight, threads)

    def weights(self, target: Target) -> LossWeights:
        mask, share = target.mask, self.ssim_weight
        count = target.color.size if mask is None else int(mask.sum()) * target.color.shape[2]
        return LossWeights((1 - share) / count, -share / count, self.l2_weight / count, share)

    def __call__(self, image: np.ndarray, target: Target, /) -> tuple[float, np.ndarray]:
        mask = target.mask
        weights = self.weights(target)
        compared = compare_images(
            image[None],
            target.color[None],
            None if mask is None else mask[None],
            l1_weight=weights.l1,
            ssim_weight=weights.ssim,
            gradient=True,
            threads=self.threads,
        )
        assert compared.gradient is not None
        gradient, squares = compared.gradient[0], 0.0
        if self.l2_weight:
            difference = image - target.color
            if mask is not None:
                difference[~mask] = 0  # masked values may be anything
            squares = float(np.square(difference).sum())
            difference *= np.float32(2 * weights.l2)
            gradient += difference
        return weights.loss(compared.l1, compared.ssim, squares), gradient


def loss_name(loss: Loss | None) -> str:
    """What checkpoints call it: the name of its function or class, with that of its module."""
    if loss is None or isinstance(loss, DefaultLoss):
        return DEFAULT
    named = loss if hasattr(loss, "__qualname__") else type(loss)
    return f"{named.__module__}.{named.__qualname__}"


def own_loss(loss: Loss, image: np.ndarray, target: Target) -> tuple[float, np.ndarray]:
    """The value of a loss that is not the default one, and its gradient, float32.

    The loss may change the image and the target, which is a copy. TypeError or ValueError if it returns
    something else.
    """
    mask = None if target.mask is None else target.mask.copy()
    found: object = loss(image, target._replace(color=target.color.copy(), mask=mask))
    name = loss_name(loss)
    if not (isinstance(found, (tuple, list)) and len(found) == 2):
        raise TypeError(f"the loss {name} must return its value and its gradient, got {described(found)}")
    value, gradient = found[0], np.asarray(found[1])
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if not isinstance(value, Real):
        raise TypeError(f"the loss {name} must return a number as its value, got {described(value)}")
    if gradient.dtype.kind != "f":
        raise TypeError(f"the gradient of the loss {name} must be floats, got {gradient.dtype}")
    if gradient.shape != image.shape:
        raise ValueError(
            f"the gradient of the loss {name} must have the shape of the image, {image.shape}, got"
            f" {gradient.shape}"
        )
    return float(value), np.ascontiguousarray(gradient, np.float32)


def check_loss(loss: Loss, config: FinetuneConfig, changes: Mapping[str, object]) -> None:
    """TypeError if ``loss`` is no function; ValueError if ``changes`` set weights of the default one beside
    it."""
    if not callable(loss):
        raise TypeError(f"loss must be a function of an image and its target, got {described(loss)}")
    if isinstance(loss, DefaultLoss):
        return
    # With opacity 'cutoff', l2_weight weighs the expected error, too.
    for name in ("ssim_weight", "l2_weight"):
        if name in changes and not (name == "l2_weight" and config.expected_share and config.cuts):
            raise ValueError(f"{name} is a weight of the default loss: leave out either it or your own loss")
