"""Losses between images, as torch functions: L1, SSIM in the 3DGS convention, and their weighted sum.
``from_torch`` turns such functions into losses of ``finetune``.

Value and gradient come from the compiled core in one pass. Both have the same bits in every run, with any
number of threads.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from meshsplats._common.kinds import described
from meshsplats._core.kernels import compare_images
from meshsplats._core.library import check_threads
from meshsplats.errors import GET_TORCH, MissingDependencyError
from meshsplats.finetuning.loss import Loss, Target, loss_name

try:
    import torch
except ModuleNotFoundError as error:
    raise MissingDependencyError(f"meshsplats.finetuning.losses needs torch; {GET_TORCH}") from error

SSIM_WEIGHT = 0.4
"""Share of SSIM in the loss of the MeshSplats paper, 0.6 L1 + 0.4 (1 - SSIM)."""


def l1(
    image: torch.Tensor,
    target: torch.Tensor,
    *,
    mask: torch.Tensor | None = None,
    threads: int | None = None,
) -> torch.Tensor:
    """Mean of |image - target| over channels and pixels, () float32. Where they are equal, the gradient is 0.

    Arguments and errors are those of :func:`photometric_loss`.
    """
    return _weighted(image, target, mask, 1, 0, 0, threads)


def ssim(
    image: torch.Tensor,
    target: torch.Tensor,
    *,
    mask: torch.Tensor | None = None,
    threads: int | None = None,
) -> torch.Tensor:
    """Mean structural similarity in [-1, 1], () float32. Larger is closer, so the loss is 1 - ssim.

    The convention is that of Gaussian splatting, ``metrics.ssim(..., convention='3dgs')``: one 11 x 11
    Gaussian window of sigma 1.5 per pixel and channel, zeros outside the image.

    Arguments and errors are those of :func:`photometric_loss`.
    """
    return _weighted(image, target, mask, 0, 1, 0, threads)


def photometric_loss(
    image: torch.Tensor,
    target: torch.Tensor,
    *,
    ssim_weight: float = SSIM_WEIGHT,
    mask: torch.Tensor | None = None,
    threads: int | None = None,
) -> torch.Tensor:
    """``(1 - ssim_weight) * L1 + ssim_weight * (1 - SSIM)``, () float32.

    Args:
        image, target: (h, w, c) or (b, h, w, c) float32 on the CPU, channels last, with 1 as the peak value.
            Either may require a gradient; there is no second derivative, RuntimeError. Arrays that are not
            contiguous are copied.
        ssim_weight: in [0, 1]; 0.4 is the paper's value, 0.2 that of 3DGS.
        mask: (h, w) or (b, h, w) bool, True where pixels count. Masked pixels are treated as outside of the
            image: they are zeros in the windows of their neighbours, have no window, and get no gradient. So
            a rectangular mask gives the loss of the cropped image, and masked values may be anything. In a
            batch every pixel that counts has the same weight.
        threads: maximum number of threads; all processors by default.

    Returns:
        () float32, the same bits with any number of threads.

    Raises:
        TypeError: not tensors, or of other types than float32 and bool.
        ValueError: shapes that do not agree, tensors not on the CPU, a weight outside [0, 1], no pixel that
            counts.
    """
    if not 0 <= ssim_weight <= 1:
        raise ValueError(f"ssim_weight must lie in [0, 1], got {ssim_weight}")
    return _weighted(image, target, mask, 1 - ssim_weight, -ssim_weight, ssim_weight, threads)


def from_torch(function: Callable[[torch.Tensor, torch.Tensor, torch.Tensor | None], torch.Tensor]) -> Loss:
    """The loss ``function(image, target, mask)`` for ``finetune(loss=...)``, with the gradient of torch.

    Args:
        function: takes (h, w, 3) float32 display RGB of the image and its target, and a (h, w) bool mask,
            True where pixels count, or None: all do. Returns a tensor with one number.

    The loss raises TypeError if ``function`` returns something else.
    """

    @functools.wraps(function)
    def loss(image: np.ndarray, target: Target) -> tuple[float, np.ndarray]:
        leaf = torch.from_numpy(image).requires_grad_(True)
        mask = None if target.mask is None else torch.from_numpy(target.mask)
        with torch.enable_grad():
            value = function(leaf, torch.from_numpy(target.color), mask)
        if not (isinstance(value, torch.Tensor) and value.numel() == 1 and value.requires_grad):
            raise TypeError(
                f"the loss {loss_name(loss)} must return a tensor with one number that depends on the image,"
                f" got {described(value)}"
            )
        (gradient,) = torch.autograd.grad(value, leaf)
        return float(value.detach()), gradient.numpy()

    return loss


def _weighted(
    image: torch.Tensor,
    target: torch.Tensor,
    mask: torch.Tensor | None,
    l1_weight: float,
    ssim_weight: float,
    constant: float,
    threads: int | None,
) -> torch.Tensor:
    _check(image, target, mask)
    check_threads(threads)
    pixels = image.shape[:-1].numel()
    if mask is not None:
        pixels = int(mask.sum())  # from the mask itself, which may be a view: the number of pixels is exact
        if pixels == 0:
            raise ValueError(f"mask must mark at least one pixel, got none of {mask.numel()}")
    return _Weighted.apply(  # type: ignore[no-untyped-call]
        image,
        target,
        mask,
        pixels * image.shape[-1],
        (l1_weight, ssim_weight, constant),
        threads,
        torch.is_grad_enabled(),
    )


class _Weighted(torch.autograd.Function):
    """constant + l1_weight * mean |x - y| + ssim_weight * mean SSIM.

    The forward pass computes the gradients with the value, since both share most of the work.
    """

    @staticmethod
    def forward(
        ctx: Any,
        image: torch.Tensor,
        target: torch.Tensor,
        mask: torch.Tensor | None,
        count: int,
        weights: tuple[float, float, float],
        threads: int | None,
        gradients: bool,
    ) -> torch.Tensor:
        x, y = (_batch(tensor, 4) for tensor in (image, target))
        inside = None if mask is None else _batch(mask, 3)
        l1_weight, ssim_weight, constant = weights
        given: dict[str, Any] = dict(
            l1_weight=l1_weight / count, ssim_weight=ssim_weight / count, threads=threads
        )
        wanted = [needed and gradients for needed in ctx.needs_input_grad[:2]]
        result = compare_images(x, y, inside, gradient=wanted[0], **given)
        # Both sums are symmetric, so the gradient of the target is that of the image with both exchanged.
        other = compare_images(y, x, inside, gradient=True, **given).gradient if wanted[1] else None
        ctx.save_for_backward(
            *(
                None if gradient is None else torch.from_numpy(gradient).view(image.shape)
                for gradient in (result.gradient, other)
            )
        )
        value = constant + l1_weight * (result.l1 / count) + ssim_weight * (result.ssim / count)
        return image.new_tensor(value)

    @staticmethod
    def backward(ctx: Any, cotangent: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        if torch.is_grad_enabled():
            # Otherwise a second derivative through the image would silently be missing.
            raise RuntimeError("losses have no second derivative: call backward without create_graph=True")
        gradients = (None if gradient is None else gradient * cotangent for gradient in ctx.saved_tensors)
        return *gradients, None, None, None, None, None


def _batch(tensor: torch.Tensor, dimensions: int) -> np.ndarray:
    tensor = tensor.detach()
    return (tensor if tensor.ndim == dimensions else tensor[None]).contiguous().numpy()


def _check(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None) -> None:
    for name, tensor in (("image", image), ("target", target)):
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(
                f"{name} must be a torch tensor, got {type(tensor).__name__}; use torch.from_numpy"
            )
        if tensor.dtype != torch.float32:
            raise TypeError(f"{name} must be float32 with values in [0, 1], got {tensor.dtype}")
    if image.shape != target.shape:
        raise ValueError(
            f"image and target must have the same shape, got {tuple(image.shape)} and {tuple(target.shape)}"
        )
    if image.ndim not in (3, 4) or image.numel() == 0:
        raise ValueError(
            f"images must have shape (h, w, c) or (b, h, w, c) and a pixel, got {tuple(image.shape)}"
        )
    if image.shape[-1] > MAX_CHANNELS:
        raise ValueError(
            f"images must be channels last with at most {MAX_CHANNELS} channels, got"
            f" {tuple(image.shape)}; bring (c, h, w) into order with permute(1, 2, 0)"
        )
    if mask is not None:
        if not isinstance(mask, torch.Tensor) or mask.dtype != torch.bool:
            got = mask.dtype if isinstance(mask, torch.Tensor) else type(mask).__name__
            raise TypeError(f"mask must be a boolean torch tensor, got {got}")
        if mask.shape != image.shape[:-1]:
            raise ValueError(f"mask must have shape {tuple(image.shape[:-1])}, got {tuple(mask.shape)}")
    for part in (image, target, mask):
        if part is not None and part.device.type != "cpu":
            raise ValueError(f"images and mask must be on the CPU, got {part.device}; use .cpu()")


MAX_CHANNELS = 64
"""Maximum number of channels; with more, the channels are probably not the last axis."""
