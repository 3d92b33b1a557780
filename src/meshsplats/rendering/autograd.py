"""rasterize: the renderer as a torch operator. Imported without torch, which is needed when it is called."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from meshsplats._common.choices import Device
from meshsplats._common.kinds import need_all
from meshsplats.errors import GET_TORCH, MissingDependencyError
from meshsplats.rendering.backward import TAPE_BYTES, TapeOptions
from meshsplats.rendering.devices import engine
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import MIN_TRANSMITTANCE
from meshsplats.scene.order import Order

if TYPE_CHECKING:
    import torch


class Raster(NamedTuple):
    """Images of b cameras; without the first axis if one camera was given, not a sequence."""

    color: torch.Tensor
    """(b, h, w, 3) float32 RGB over the background."""
    alpha: torch.Tensor
    """(b, h, w) float32 opacity in [0, 1]."""
    attributes: torch.Tensor
    """(b, h, w, k) float32: the vertices' further attributes, summed with the blending weights of colour; the
    background adds nothing to them."""


def rasterize(
    vertices: torch.Tensor,
    faces: torch.Tensor | np.ndarray,
    attributes: torch.Tensor,
    cameras: Camera | Sequence[Camera],
    *,
    background: Sequence[float] | np.ndarray | torch.Tensor = (1, 1, 1),
    world_to_camera: torch.Tensor | None = None,
    harmonics: torch.Tensor | None = None,
    samples: int = 1,
    face_splat: torch.Tensor | np.ndarray | None = None,
    depth_group: torch.Tensor | np.ndarray | None = None,
    filter_px2: float = 0.0,
    order: Order = "fragment",
    min_transmittance: float = MIN_TRANSMITTANCE,
    threads: int | None = None,
    tape_bytes: int = TAPE_BYTES,
    device: Device = "cpu",
) -> Raster:
    """The images that ``render`` gives, differentiable once.

    Gradients go to ``vertices``, ``attributes``, ``background``, ``world_to_camera`` and ``harmonics``. They
    pass through blending and perspective-correct interpolation. The fragments of a sample and their order
    count as constant, so an edge that passes over a sample has no gradient. An opacity of 1 is no exception:
    its gradient takes account of the fragments behind it, at least six layers of them.

    The forward pass records a tape of at most ``tape_bytes`` for each image, about two bytes a fragment; the
    backward pass renders tiles that did not fit once more. Every result has the same bits in every run, with
    any number of threads.

    ``device="gpu"`` renders on the best GPU of the machine (extra ``gpu``), with the fragments of
    ``render(device="gpu")``. Tensors stay on the CPU. The tape of the last image stays on the GPU; the
    backward pass renders others once more. Results have the same bits in every run on one device.

    Values are not checked: where some are NaN, triangles are left out, so an image may be finite although all
    positions are NaN. Tensors must not be changed between the forward and the backward pass, which torch
    checks for; indices and NumPy arrays are copied.

    Args:
        vertices: (v, 3) float32 world positions.
        faces: (f, 3) int32 vertex indices.
        attributes: (v, 4 + k) float32: straight RGBA, opacities in [0, 1], then k further values. With k > 0
            the two parts are copied.
        cameras: one, or several with images of one size.
        background: (3,), (h, w, 3) or (b, h, w, 3) RGB.
        world_to_camera: (b, 4, 4), or (4, 4) for one camera: overrides that of the cameras, to optimise
            poses. The last row is not used.
        harmonics: (s, k, 3) float32, as in ``SplatMesh``; needs ``face_splat``. The directions to the
            vertices count as constant; where a colour is held at 0, only a gradient that raises it counts.
        samples: side of the grid of samples in each pixel.
        face_splat, depth_group: (f,) int32, as in ``SplatMesh``.
        filter_px2: variance in square pixels of the filter for splats, as in ``render``. Gradients go through
            the filter to positions and opacities.
        order: 'fragment' or 'splat', as in ``render``; 'splat' needs ``face_splat``.
        min_transmittance: early termination of samples with less transmittance than this.
        threads: at most this many, of the CPU; all processors by default.
        tape_bytes: limit on the size of the tape of each image, on the CPU.
        device: 'cpu' or 'gpu'.

    Raises:
        ValueError: tensors of other types, shapes or devices; faces with indices of missing vertices; a
            ``face_splat`` that does not ascend; a singular pose; options out of range; a filter without
            ``face_splat``, or for splats that share vertices.
        RuntimeError: from torch, for a second derivative.
        MissingDependencyError: no GPU, or no library for it.
        DeviceError: the GPU failed, or did not finish.
    """
    drawing = engine(device, threads)
    if not isinstance(cameras, Camera):
        need_all(Camera, cameras=cameras)
    try:
        from meshsplats.rendering.torch_operator import Optional, Scene, images_of
    except MissingDependencyError as error:
        raise MissingDependencyError(f"rasterize needs torch; {GET_TORCH}") from error

    single = isinstance(cameras, Camera)
    views: list[Camera] = [cameras] if isinstance(cameras, Camera) else list(cameras)
    if not views:
        raise ValueError("rasterize needs at least one camera")
    size = (views[0].height, views[0].width)
    for view in views:
        if (view.height, view.width) != size:
            raise ValueError(
                f"cameras of one call must have one size, got {size[1]} x {size[0]} and"
                f" {view.width} x {view.height}"
            )
    if not 0 <= min_transmittance < 1:
        raise ValueError(f"min_transmittance must lie in [0, 1), got {min_transmittance}")
    images = images_of(
        vertices,
        attributes,
        background,
        Optional(world_to_camera, harmonics),
        Scene(views, faces, face_splat, depth_group, filter_px2, order),
        TapeOptions(samples=samples, min_transmittance=min_transmittance),
        drawing,
        tape_bytes,
    )
    return Raster(*((part[0] for part in images) if single else images))
