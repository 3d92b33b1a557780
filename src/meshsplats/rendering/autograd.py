"""rasterize: the renderer as a torch operator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from meshsplats.camera import Camera
from meshsplats.errors import GET_TORCH, MissingDependencyError
from meshsplats.rendering.api import MIN_TRANSMITTANCE
from meshsplats.rendering.backward import TAPE_BYTES, TapedRendering

try:
    import torch
    from torch.autograd.function import once_differentiable
except ImportError as error:
    raise MissingDependencyError(f"meshsplats.rendering.autograd needs torch; {GET_TORCH}") from error


class Raster(NamedTuple):
    """Pictures of b cameras; without the first axis if one camera was given, not a sequence."""

    color: torch.Tensor
    """(b, h, w, 3) float32 RGB over the background."""
    alpha: torch.Tensor
    """(b, h, w) float32 opacity in [0, 1]."""
    attributes: torch.Tensor
    """(b, h, w, k) float32: the vertices' further attributes, summed with the weights of colour; not over the
    background."""


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
) -> Raster:
    """The pictures that ``render`` draws, differentiable once.

    Gradients go to ``vertices``, ``attributes``, ``background`` and ``world_to_camera``. They are those of
    the pictures as drawn: values move with the interpolation (perspective included) and the blending; which
    triangles a sample sees and in which order is constant, so an edge that passes over a sample gives no
    gradient. An opacity of 1 is no exception: its gradient tells what is behind (at least six layers
    of it). Memory for the way back is a log of at most ``tape_bytes`` a picture, about two bytes for each
    fragment; tiles beyond are drawn once more. Every result has the same bits in every run, with any number
    of threads.

    Args:
        vertices: (v, 3) float32 world positions.
        faces: (f, 3) int32, numbers of vertices.
        attributes: (v, 4 + k) float32: straight RGBA, opacities in [0, 1], then k further numbers. With k > 0
            the two parts are copied.
        cameras: one, or several of one size.
        background: (3,), (h, w, 3) or (b, h, w, 3) RGB.
        world_to_camera: (b, 4, 4), or (4, 4) for one camera: takes the place of the cameras' own, to optimise
            poses. The last row is not used.
        samples: side of the grid of samples in each pixel.
        face_splat, depth_group: (f,) int32, as in ``SplatMesh``.
        filter_px2: variance in square pixels of the filter for splats, as in ``render``. Gradients go through
            the filter to positions and opacities.
        min_transmittance: a sample stops once less than this fraction of light comes through.
        threads: at most this many; all processors by default.

    Raises:
        ValueError: tensors of other types, shapes or devices; faces that name missing vertices; options out
            of range; a filter without ``face_splat``, or for splats that share vertices.
        RuntimeError: from torch, where a second derivative is asked for.
    """
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
    behind = _background(background, len(views), size)
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
    )
    inputs = (vertices, attributes, behind, poses)
    if torch.is_grad_enabled() and any(part is not None and part.requires_grad for part in inputs):
        pictures = _Rasterize.apply(*inputs, constant)
    else:
        pictures = _draw(*inputs, constant, None)
    return Raster(*((part[0] for part in pictures) if single else pictures))


class _Constant(NamedTuple):
    cameras: list[Camera]
    faces: np.ndarray
    face_splat: np.ndarray | None
    depth_group: np.ndarray | None
    options: dict[str, Any]
    tape_bytes: int


def _draw(
    vertices: torch.Tensor,
    attributes: torch.Tensor,
    background: torch.Tensor,
    poses: torch.Tensor | None,
    constant: _Constant,
    records: list[TapedRendering] | None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The pictures; to ``records``, if given, what going back needs."""
    points = _array(vertices)
    values = attributes.detach()
    colors = _array(values if values.shape[1] == 4 else values[:, :4])
    more = _array(values[:, 4:]) if values.shape[1] > 4 else None
    behind = background.detach().numpy()
    drawn = []
    for number, camera in enumerate(constant.cameras):
        picture = TapedRendering(
            points,
            constant.faces,
            colors,
            more,
            camera,
            background=behind[number] if behind.ndim == 4 else behind,
            world_to_camera=None if poses is None else poses[number].detach().double().numpy(),
            face_splat=constant.face_splat,
            depth_group=constant.depth_group,
            tape_bytes=None if records is None else constant.tape_bytes,
            **constant.options,
        )
        drawn.append((picture.color, picture.alpha, picture.attributes))
        if records is not None:
            records.append(picture)

    def together(parts: Sequence[np.ndarray]) -> torch.Tensor:
        return torch.from_numpy(parts[0][None] if len(parts) == 1 else np.stack(parts))

    color, alpha, extra = (together(parts) for parts in zip(*drawn, strict=True))
    return color, alpha, extra


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, vertices, attributes, background, poses, constant):  # type: ignore[override]
        ctx.records = []
        pictures = _draw(vertices, attributes, background, poses, constant, ctx.records)
        # What the core reads again must not have been changed in place: torch checks it.
        ctx.save_for_backward(vertices, attributes, background, poses, pictures[1])
        ctx.set_materialize_grads(False)
        return pictures

    @staticmethod
    @once_differentiable
    def backward(ctx, to_color, to_alpha, to_extra):  # type: ignore[override]
        vertices, attributes, background, poses, alpha = ctx.saved_tensors
        needs = ctx.needs_input_grad
        if to_color is None:
            to_color = torch.zeros(*alpha.shape, 3)
        towards = [None if part is None else _array(part) for part in (to_color, to_alpha, to_extra)]
        to_points = to_values = to_poses = to_behind = None
        if needs[0] or needs[1] or needs[3]:
            width = attributes.shape[1] - 4
            points = np.zeros(vertices.shape, np.float32)
            colors = np.zeros((len(vertices), 4), np.float32)
            more = np.zeros((len(vertices), width), np.float32)
            by_pose = []
            for number, record in enumerate(ctx.records):
                given = [None if part is None else part[number] for part in towards]
                moved = np.zeros_like(points) if needs[3] else points
                record.back(*given, vertices=moved, colors=colors, vertex_attributes=more)
                if needs[3]:
                    by_pose.append(_pose_gradient(vertices, poses[number], moved))
                    points += moved
            if needs[3]:
                to_poses = torch.from_numpy(np.stack(by_pose)).to(poses)
            to_points = torch.from_numpy(points)
            to_values = torch.from_numpy(np.concatenate([colors, more], axis=1) if width else colors)
        if needs[2]:
            to_behind = to_color * (1 - alpha)[..., None]
            if background.ndim < 4:
                to_behind = to_behind.sum(dim=0 if background.ndim == 3 else (0, 1, 2))
        return to_points, to_values, to_behind, to_poses, None


def _pose_gradient(vertices: torch.Tensor, pose: torch.Tensor, moved: np.ndarray) -> np.ndarray:
    """(4, 4) from the gradients of the world's points, as p_camera = R p + t: dL/dp = R^T dL/dp_camera."""
    rotation = pose.detach().double().numpy()[:3, :3]
    points = vertices.detach().numpy()
    # Sums over all points first: they are what the rotation is to be taken from.
    moved64 = moved.astype(np.float64)
    back = np.linalg.inv(rotation.T)
    result = np.zeros((4, 4))
    result[:3, :3] = back @ (moved64.T @ points.astype(np.float64))
    result[:3, 3] = back @ moved64.sum(axis=0)
    return result


def _check(name: str, tensor: torch.Tensor, shape: str, fits: bool) -> None:
    if tensor.device.type != "cpu" or tensor.dtype != torch.float32 or not fits:
        raise ValueError(
            f"{name} must be {shape} float32 on the CPU, got {tuple(tensor.shape)} {tensor.dtype} on"
            f" {tensor.device}"
        )


def _array(tensor: torch.Tensor) -> np.ndarray:
    """The tensor's own memory where it is contiguous, as it should be."""
    return tensor.detach().contiguous().numpy()


def _faces(faces: torch.Tensor | np.ndarray, vertices: int) -> np.ndarray:
    array = np.ascontiguousarray(faces.numpy() if isinstance(faces, torch.Tensor) else faces)
    if array.ndim != 2 or array.shape[1] != 3 or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"faces must be (f, 3) int32, got {array.shape} {array.dtype}")
    if len(array) and (array.min() < 0 or array.max() >= vertices):
        raise ValueError(f"faces must name vertices 0 to {vertices - 1}, got {array.min()} to {array.max()}")
    return array.astype(np.int32, copy=False)


def _per_face(name: str, numbers: torch.Tensor | np.ndarray | None, faces: int) -> np.ndarray | None:
    if numbers is None:
        return None
    array = np.ascontiguousarray(numbers.numpy() if isinstance(numbers, torch.Tensor) else numbers)
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
