"""rasterize: the renderer as a torch operator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from meshsplats.camera import Camera
from meshsplats.errors import GET_TORCH, MissingDependencyError
from meshsplats.mesh import MIN_TRANSMITTANCE
from meshsplats.rendering.api import Device, check_device
from meshsplats.rendering.backward import TAPE_BYTES
from meshsplats.rendering.gpu_backward import AnyRendering, taped_rendering

try:
    import torch
    from torch.autograd.function import once_differentiable
except ImportError as error:
    raise MissingDependencyError(f"meshsplats.rendering.autograd needs torch; {GET_TORCH}") from error


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
    samples: int = 1,
    face_splat: torch.Tensor | np.ndarray | None = None,
    depth_group: torch.Tensor | np.ndarray | None = None,
    filter_px2: float = 0.0,
    min_transmittance: float = MIN_TRANSMITTANCE,
    threads: int | None = None,
    tape_bytes: int = TAPE_BYTES,
    device: Device = "cpu",
) -> Raster:
    """The images that ``render`` gives, differentiable once.

    Gradients go to ``vertices``, ``attributes``, ``background`` and ``world_to_camera``. They pass through
    blending and perspective-correct interpolation. The fragments of a sample and their order count as
    constant, so an edge that passes over a sample has no gradient. An opacity of 1 is no exception: its
    gradient takes account of the fragments behind it, at least six layers of them.

    The forward pass records a tape of at most ``tape_bytes`` for each image, about two bytes a fragment; the
    backward pass renders tiles that did not fit once more. Every result has the same bits in every run, with
    any number of threads.

    ``device="gpu"`` renders on the best GPU of the machine (extra ``gpu``), with the fragments of
    ``render(device="gpu")``. Tensors stay on the CPU. The tape of the last image stays on the GPU; the
    backward pass renders others once more. Results have the same bits in every run on one device.

    Args:
        vertices: (v, 3) float32 world positions.
        faces: (f, 3) int32 vertex indices.
        attributes: (v, 4 + k) float32: straight RGBA, opacities in [0, 1], then k further values. With k > 0
            the two parts are copied.
        cameras: one, or several with images of one size.
        background: (3,), (h, w, 3) or (b, h, w, 3) RGB.
        world_to_camera: (b, 4, 4), or (4, 4) for one camera: overrides that of the cameras, to optimise
            poses. The last row is not used.
        samples: side of the grid of samples in each pixel.
        face_splat, depth_group: (f,) int32, as in ``SplatMesh``.
        filter_px2: variance in square pixels of the filter for splats, as in ``render``. Gradients go through
            the filter to positions and opacities.
        min_transmittance: early termination of samples with less transmittance than this.
        threads: at most this many, of the CPU; all processors by default.
        tape_bytes: limit on the size of the tape of each image, on the CPU.
        device: 'cpu' or 'gpu'.

    Raises:
        ValueError: tensors of other types, shapes or devices; faces with indices of missing vertices; options
            out of range; a filter without ``face_splat``, or for splats that share vertices.
        RuntimeError: from torch, for a second derivative.
        MissingDependencyError: no GPU, or no library for it.
        DeviceError: the GPU failed, or did not finish.
    """
    check_device(device)
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
    _check("vertices", vertices, "(v, 3)", vertices.ndim == 2 and vertices.shape[1] == 3)
    _check(
        "attributes",
        attributes,
        f"({len(vertices)}, 4 + k)",
        attributes.ndim == 2 and attributes.shape[1] >= 4 and len(attributes) == len(vertices),
    )
    backdrop = _background(background, len(views), size)
    poses = None
    if world_to_camera is not None:
        poses = world_to_camera[None] if single and world_to_camera.ndim == 2 else world_to_camera
        if poses.shape != (len(views), 4, 4):
            raise ValueError(
                f"world_to_camera must have shape ({len(views)}, 4, 4), got {tuple(world_to_camera.shape)}"
            )
        if not bool(torch.isfinite(poses).all()):
            raise ValueError("world_to_camera must be finite")
    constant = _Constant(
        views,
        _faces(faces, len(vertices)),
        _per_face("face_splat", face_splat, len(faces)),
        _per_face("depth_group", depth_group, len(faces)),
        dict(filter_px2=filter_px2, samples=samples, min_transmittance=min_transmittance, threads=threads),
        tape_bytes,
        device,
    )
    inputs = (vertices, attributes, backdrop, poses)
    if torch.is_grad_enabled() and any(part is not None and part.requires_grad for part in inputs):
        images = _Rasterize.apply(*inputs, constant)  # type: ignore[no-untyped-call]
    else:
        images = _forward(*inputs, constant, None)
    return Raster(*((part[0] for part in images) if single else images))


class _Constant(NamedTuple):
    cameras: list[Camera]
    faces: np.ndarray
    face_splat: np.ndarray | None
    depth_group: np.ndarray | None
    options: dict[str, Any]
    tape_bytes: int
    device: Device


def _forward(
    vertices: torch.Tensor,
    attributes: torch.Tensor,
    background: torch.Tensor,
    poses: torch.Tensor | None,
    constant: _Constant,
    tapes: list[AnyRendering] | None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Colour, alpha and attributes of the images; appends the renderings to ``tapes``, where there is one."""
    points = _array(vertices)
    values = attributes.detach()
    colors = _array(values if values.shape[1] == 4 else values[:, :4])
    more = _array(values[:, 4:]) if values.shape[1] > 4 else None
    backdrop = background.detach().numpy()
    images = []
    for i, camera in enumerate(constant.cameras):
        rendering = taped_rendering(
            constant.device,
            points,
            constant.faces,
            colors,
            more,
            camera,
            background=backdrop[i] if backdrop.ndim == 4 else backdrop,
            world_to_camera=None if poses is None else poses[i].detach().double().numpy(),
            face_splat=constant.face_splat,
            depth_group=constant.depth_group,
            tape_bytes=None if tapes is None else constant.tape_bytes,
            **constant.options,
        )
        images.append((rendering.color, rendering.alpha, rendering.attributes))
        if tapes is not None:
            tapes.append(rendering)

    def stacked(parts: Sequence[np.ndarray]) -> torch.Tensor:
        return torch.from_numpy(parts[0][None] if len(parts) == 1 else np.stack(parts))

    color, alpha, extra = (stacked(parts) for parts in zip(*images, strict=True))
    return color, alpha, extra


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        vertices: torch.Tensor,
        attributes: torch.Tensor,
        background: torch.Tensor,
        poses: torch.Tensor | None,
        constant: _Constant,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        ctx.tapes = []
        images = _forward(vertices, attributes, background, poses, constant, ctx.tapes)
        # The core reads these arrays again: torch checks that nobody has changed them in place.
        ctx.save_for_backward(vertices, attributes, background, poses, images[1])
        ctx.set_materialize_grads(False)
        return images

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any,
        grad_color: torch.Tensor | None,
        grad_alpha: torch.Tensor | None,
        grad_extra: torch.Tensor | None,
    ) -> tuple[torch.Tensor | None, ...]:
        vertices, attributes, background, poses, alpha = ctx.saved_tensors
        needs = ctx.needs_input_grad
        if grad_color is None:
            grad_color = torch.zeros(*alpha.shape, 3)
        of_images = [None if part is None else _array(part) for part in (grad_color, grad_alpha, grad_extra)]
        grad_vertices = grad_attributes = grad_poses = grad_background = None
        if needs[0] or needs[1] or needs[3]:
            width = attributes.shape[1] - 4
            points = np.zeros(vertices.shape, np.float32)
            colors = np.zeros((len(vertices), 4), np.float32)
            more = np.zeros((len(vertices), width), np.float32)
            by_pose = []
            for i, rendering in enumerate(ctx.tapes):
                of_image = [None if part is None else part[i] for part in of_images]
                own = np.zeros_like(points) if needs[3] else points
                rendering.backward(*of_image, vertices=own, colors=colors, vertex_attributes=more)
                if needs[3]:
                    by_pose.append(_pose_gradient(vertices, poses[i], own))
                    points += own
            if needs[3]:
                grad_poses = torch.from_numpy(np.stack(by_pose)).to(poses)
            grad_vertices = torch.from_numpy(points)
            grad_attributes = torch.from_numpy(np.concatenate([colors, more], axis=1) if width else colors)
        if needs[2]:
            grad_background = grad_color * (1 - alpha)[..., None]
            if background.ndim < 4:
                grad_background = grad_background.sum(dim=0 if background.ndim == 3 else (0, 1, 2))
        return grad_vertices, grad_attributes, grad_background, grad_poses, None


def _pose_gradient(vertices: torch.Tensor, pose: torch.Tensor, gradients: np.ndarray) -> np.ndarray:
    """(4, 4) gradient of a pose from the ``gradients`` (v, 3) of the world positions p.

    With p_camera = R p + t, dL/dp = R^T dL/dp_camera, so dL/dR = R^-T sum dL/dp p^T.
    """
    rotation = pose.detach().double().numpy()[:3, :3]
    points = vertices.detach().numpy()
    # Sums over all points come first, in float64: the rotation is applied once.
    of_world = gradients.astype(np.float64)
    to_camera = np.linalg.inv(rotation.T)
    result = np.zeros((4, 4))
    result[:3, :3] = to_camera @ (of_world.T @ points.astype(np.float64))
    result[:3, 3] = to_camera @ of_world.sum(axis=0)
    return result


def _check(name: str, tensor: torch.Tensor, shape: str, fits: bool) -> None:
    if tensor.device.type != "cpu" or tensor.dtype != torch.float32 or not fits:
        raise ValueError(
            f"{name} must be {shape} float32 on the CPU, got {tuple(tensor.shape)} {tensor.dtype} on"
            f" {tensor.device}"
        )


def _array(tensor: torch.Tensor) -> np.ndarray:
    """The tensor's own memory where it is contiguous, else a copy."""
    return tensor.detach().contiguous().numpy()


def _faces(faces: torch.Tensor | np.ndarray, vertices: int) -> np.ndarray:
    array = np.ascontiguousarray(faces.numpy() if isinstance(faces, torch.Tensor) else faces)
    if array.ndim != 2 or array.shape[1] != 3 or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"faces must be (f, 3) int32, got {array.shape} {array.dtype}")
    if len(array) and (array.min() < 0 or array.max() >= vertices):
        raise ValueError(
            f"faces must be vertex indices from 0 to {vertices - 1}, got {array.min()} to {array.max()}"
        )
    return array.astype(np.int32, copy=False)


def _per_face(name: str, indices: torch.Tensor | np.ndarray | None, faces: int) -> np.ndarray | None:
    if indices is None:
        return None
    array = np.ascontiguousarray(indices.numpy() if isinstance(indices, torch.Tensor) else indices)
    if array.shape != (faces,) or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name} must be ({faces},) int32, got {array.shape} {array.dtype}")
    return array.astype(np.int32, copy=False)


def _background(
    background: Sequence[float] | np.ndarray | torch.Tensor, count: int, size: tuple[int, int]
) -> torch.Tensor:
    tensor = (
        background
        if isinstance(background, torch.Tensor)
        else torch.as_tensor(np.asarray(background, np.float32))
    )
    if tuple(tensor.shape) not in ((3,), (*size, 3), (count, *size, 3)):
        raise ValueError(
            f"background must have shape (3,), {(*size, 3)} or {(count, *size, 3)}, got {tuple(tensor.shape)}"
        )
    return tensor.float()
