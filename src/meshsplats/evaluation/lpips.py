"""LPIPS, the learned perceptual distance of images (Zhang et al. 2018), version 0.1: VGG-16, AlexNet.

The trained weights are not part of this package, and nothing is downloaded. Each network needs two files, in
PyTorch's format or as safetensors with the same tensor names:

==========  ===============================  ================================================================
network     features, from torchvision       weights of the channels, from the package ``lpips``, folder v0.1
==========  ===============================  ================================================================
``'vgg'``   ``vgg16-397923af.pth``           ``vgg.pth``
``'alex'``  ``alexnet-owt-7be5be79.pth``     ``alex.pth``
==========  ===============================  ================================================================

One file with the state of a whole ``lpips.LPIPS`` module also works. Needs torch (extra ``torch``).

There are two conventions, whose values are not comparable:

===========  =================================  =============================================================
convention   what the network is given          who reports it
===========  =================================  =============================================================
``'3dgs'``   colours from 0 to 1, as they are   ``metrics.py`` of 3DGS, gsplat with VGG, tables in their wake
``'lpips'``  colours from -1 to 1, for which    the package ``lpips``, torchmetrics with ``normalize=True``,
             it was trained                     nerfstudio, gsplat with AlexNet
===========  =================================  =============================================================
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from meshsplats._common.kinds import need_choice
from meshsplats.errors import GET_TORCH, FileFormatError, MissingDependencyError
from meshsplats.evaluation.metrics import checked_images
from meshsplats.formats.safetensors import load_safetensors

if TYPE_CHECKING:
    import torch

Network = Literal["vgg", "alex"]
Convention = Literal["3dgs", "lpips"]
CONVENTIONS: dict[Network, Convention] = {"vgg": "3dgs", "alex": "lpips"}
"""In which convention tables of splatting methods have the distances of each network."""
Paths = str | os.PathLike[str]

SUFFIXES = (".pth", ".pt", ".safetensors")
"""Suffixes of the files of weights in a folder."""

# Mean and standard deviation of ImageNet's colours, for images in [-1, 1].
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPSILON = 1e-10
_KINDS = ("weight", "bias")


class _Conv(NamedTuple):
    """A convolution with ReLU; ``number`` is its index in torchvision's ``features``."""

    number: int
    inputs: int
    outputs: int
    kernel: int
    stride: int = 1
    padding: int = 1


@dataclass(frozen=True)
class _Layout:
    stages: tuple[tuple[_Conv, ...], ...]
    """Features are compared at the end of each stage."""
    pool: int
    """Side of the max-pooling window before some stages; its stride is 2."""
    pooled: tuple[int, ...]
    """Indices of these stages."""
    smallest: int
    """Side of the smallest image that leaves a pixel at every stage."""
    features: str
    heads: str


def _vgg_stages() -> tuple[tuple[_Conv, ...], ...]:
    stages, number, inputs = [], 0, 3
    for outputs, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        stage = []
        for _ in range(count):
            stage.append(_Conv(number, inputs, outputs, 3))
            number, inputs = number + 2, outputs
        stages.append(tuple(stage))
        number += 1  # the pooling
    return tuple(stages)


_LAYOUTS = {
    "vgg": _Layout(_vgg_stages(), 2, (1, 2, 3, 4), 16, "vgg16-397923af.pth", "vgg.pth"),
    "alex": _Layout(
        (
            (_Conv(0, 3, 64, 11, stride=4, padding=2),),
            (_Conv(3, 64, 192, 5, padding=2),),
            (_Conv(6, 192, 384, 3),),
            (_Conv(8, 384, 256, 3),),
            (_Conv(10, 256, 256, 3),),
        ),
        3,
        (1, 2),
        31,
        "alexnet-owt-7be5be79.pth",
        "alex.pth",
    ),
}


class Lpips:
    """The LPIPS distance of one network, with its weights in memory (59 MB for VGG, 10 MB for AlexNet).

    Created by :func:`load_lpips`. Calling it with two images returns their distance.
    """

    def __init__(self, network: Network, weights: dict[str, torch.Tensor], convention: Convention) -> None:
        self.network = network
        self.convention = convention
        self._layout = _LAYOUTS[network]
        self._weights = weights

    def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
        """The distance of two images: 0 for equal images, smaller is closer.

        Published tables of splatting methods use VGG in the convention of 3DGS; values of the two networks,
        and of the two conventions, are not comparable.

        Args:
            a, b: (h, w, 3) float RGB in [0, 1], of one shape.

        Raises:
            TypeError: as ``metrics.psnr`` does.
            ValueError: as ``metrics.psnr`` does; images that are not RGB, or smaller than 16 x 16 (VGG) or
                31 x 31 pixels (AlexNet).
        """
        import torch

        a, b = checked_images(a, b)
        if a.ndim != 3 or a.shape[2] != 3:
            raise ValueError(f"LPIPS compares RGB images (h, w, 3), got {a.shape}")
        smallest = self._layout.smallest
        if min(a.shape[:2]) < smallest:
            raise ValueError(
                f"LPIPS with network {self.network!r} needs at least {smallest} x {smallest} pixels, got"
                f" {a.shape[0]} x {a.shape[1]}"
            )
        images = np.stack([a, b]).astype(np.float32).transpose(0, 3, 1, 2)
        with torch.inference_mode():
            x = torch.from_numpy(np.ascontiguousarray(images))
            shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in (_SHIFT, _SCALE))
            x = x if self.convention == "3dgs" else 2 * x - 1
            return self._distance((x - shift) / scale)

    def _distance(self, x: torch.Tensor) -> float:
        from torch.nn import functional

        total = 0.0
        for number, stage in enumerate(self._layout.stages):
            if number in self._layout.pooled:
                x = functional.max_pool2d(x, self._layout.pool, 2)
            for conv in stage:
                weight, bias = (self._weights[f"features.{conv.number}.{kind}"] for kind in _KINDS)
                x = functional.conv2d(x, weight, bias, conv.stride, conv.padding).relu_()
            unit = x / (x.square().sum(1, keepdim=True).sqrt_() + _EPSILON)
            difference = (unit[:1] - unit[1:]).square_()
            total += float(functional.conv2d(difference, self._weights[f"lin{number}"]).mean())
        return total


def load_lpips(
    weights: Paths | Sequence[Paths] | None,
    *,
    network: Network = "vgg",
    convention: Convention | None = None,
) -> Lpips | None:
    """Loads trained weights from files.

    Args:
        weights: a folder, a file, or several files, which together hold all tensors (see above). From a
            folder it reads every ``.pth``, ``.pt`` and ``.safetensors`` file whose name begins with the
            network's, ``vgg`` or ``alex``. PyTorch files are read with ``weights_only``: code in them is
            never run.
        network: 'vgg' or 'alex'.
        convention: '3dgs' gives the network colours from 0 to 1, as the code of 3DGS does, 'lpips' from -1 to
            1, as the package lpips; the values of the first are smaller. By default that in which tables of
            splatting methods have this network: '3dgs' for VGG, 'lpips' for AlexNet.

    Returns:
        The distance; None if ``weights`` is None.

    Raises:
        FileNotFoundError: a file is missing.
        FileFormatError: a file cannot be read or is of another network.
        ValueError: an unknown network or convention.
        MissingDependencyError: torch is missing.
    """
    need_choice(Network, network=network)
    if convention is not None:
        need_choice(Convention, convention=convention)
    if weights is None:
        return None
    layout = _LAYOUTS[network]
    paths = _files(weights, network)
    found: dict[str, torch.Tensor] = {}
    origin: dict[str, Path] = {}
    for path in paths:
        for name, tensor in _tensors(path).items():
            known = _known_name(name)
            if known is None:
                continue
            if origin.get(known, path) != path:
                raise FileFormatError(f"{origin[known]} and {path} both hold {known}: give one of them only")
            found[known], origin[known] = tensor, path
    wanted = _wanted(layout)
    missing = [name for name in wanted if name not in found]
    if missing:
        raise FileFormatError(
            f"{', '.join(map(str, paths))}: no {missing[0]} ({len(missing)} of {len(wanted)} tensors of LPIPS"
            f" with network {network!r} are missing); needed are torchvision's {layout.features} and"
            f" {layout.heads} of the package lpips, v0.1"
        )
    checked = {name: _checked(found[name], name, shape, origin[name]) for name, shape in wanted.items()}
    return Lpips(network, checked, convention or CONVENTIONS[network])


def _wanted(layout: _Layout) -> dict[str, tuple[int, ...]]:
    """Names and shapes of all tensors of a network."""
    shapes: dict[str, tuple[int, ...]] = {}
    for number, stage in enumerate(layout.stages):
        for conv in stage:
            shapes[f"features.{conv.number}.weight"] = (conv.outputs, conv.inputs, conv.kernel, conv.kernel)
            shapes[f"features.{conv.number}.bias"] = (conv.outputs,)
        shapes[f"lin{number}"] = (1, stage[-1].outputs, 1, 1)
    return shapes


def _known_name(name: str) -> str | None:
    """Our name of a tensor, from its name in torchvision's files or in those of the package lpips."""
    match = re.fullmatch(r"(?:features|net\.slice\d)\.(\d+)\.(weight|bias)", name)
    if match:
        return f"features.{match[1]}.{match[2]}"
    match = re.fullmatch(r"(?:lin|lins\.)(\d)\.model\.[01]\.weight", name)
    return f"lin{match[1]}" if match else None


def _files(weights: Paths | Sequence[Paths], network: Network) -> list[Path]:
    given = [weights] if isinstance(weights, str | os.PathLike) else weights
    layout, paths = _LAYOUTS[network], []
    for entry in map(Path, given):
        if entry.is_dir():
            inside = sorted(
                path
                for path in entry.iterdir()
                if path.name.startswith(network) and path.suffix in SUFFIXES and path.is_file()
            )
            if not inside:
                raise FileNotFoundError(
                    f"{entry} has no weights for LPIPS with network {network!r}: put torchvision's"
                    f" {layout.features} and {layout.heads} of the package lpips, v0.1, there"
                )
            paths += inside
        elif entry.is_file():
            paths.append(entry)
        else:
            raise FileNotFoundError(f"no weights for LPIPS at {entry}: no such file or folder")
    if not paths:
        raise FileNotFoundError("weights for LPIPS must name at least one file or folder, got none")
    return paths


def _tensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        import torch
    except ModuleNotFoundError as error:
        raise MissingDependencyError(f"LPIPS needs torch; {GET_TORCH}") from error
    try:
        if path.suffix == ".safetensors":
            return {name: torch.from_numpy(array) for name, array in load_safetensors(path)[0].items()}
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, FileFormatError):
        raise
    except Exception as error:
        # Broken files raise many kinds of errors, some with long advice to load them in unsafe ways.
        raise FileFormatError(f"{path}: not a file of weights ({type(error).__name__})") from error
    if not isinstance(content, dict) or not all(
        isinstance(name, str) and isinstance(value, torch.Tensor) for name, value in content.items()
    ):
        raise FileFormatError(
            f"{path}: not a file of named tensors; save the state_dict() of a network, not the network"
        )
    return content


def _checked(tensor: torch.Tensor, name: str, shape: tuple[int, ...], path: Path) -> torch.Tensor:
    if tuple(tensor.shape) != shape:
        raise FileFormatError(
            f"{path}: {name} has shape {tuple(tensor.shape)}, this network's is {shape}: a file of another"
            " network"
        )
    if not tensor.is_floating_point() or tensor.is_sparse or tensor.is_quantized:
        raise FileFormatError(f"{path}: {name} must hold floats, got {tensor.dtype}, {tensor.layout}")
    # A copy, since a view would keep the whole file in memory.
    tensor = tensor.detach().float().clone()
    if not math.isfinite(float(tensor.sum())):
        raise FileFormatError(f"{path}: {name} has values that are not finite")
    return tensor
