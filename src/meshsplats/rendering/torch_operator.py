"""The operator behind ``rasterize``, which needs torch to be imported."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from meshsplats._common.kinds import described
from meshsplats.errors import GET_TORCH, MissingDependencyError
from meshsplats.rendering.backward import TapeOptions
from meshsplats.rendering.engine import Engine, Taped
from meshsplats.scene.camera import Camera
from meshsplats.scene.face_splats import FaceSplats, check_ascending
from meshsplats.scene.mesh import Triangles
from meshsplats.scene.order import Order
from meshsplats.scene.spherical_harmonics import TERMS

try:
    import torch
    from torch.autograd.function import once_differentiable
except ModuleNotFoundError as error:
    raise MissingDependencyError(f"meshsplats.rendering.torch_operator needs torch; {GET_TORCH}") from error

Images = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Colour, alpha and attributes of b images."""


class Scene(NamedTuple):
    """What is constant for the gradients; as in ``rasterize``."""

    cameras: list[Camera]
    faces: torch.Tensor | np.ndarray
    face_splat: torch.Tensor | np.ndarray | None
    depth_group: torch.Tensor | np.ndarray | None
    filter_px2: float
    order: Order


class Optional(NamedTuple):
    """Tensors that may be missing."""

    poses: torch.Tensor | None
    """(b, 4, 4), or (4, 4) of one camera; None for those of the cameras."""
    harmonics: torch.Tensor | None
    """(s, k, 3) of the splats."""


_NOTHING = np.zeros((0, 0), np.float32)
_MOST_STRETCH = 1e12
"""Condition number from which on a pose flattens space."""


class _Constant(NamedTuple):
    cameras: list[Camera]
    triangles: Triangles
    """Without positions and colours, which are tensors."""
    options: TapeOptions
    engine: Engine
    tape_bytes: int


def images_of(
    vertices: torch.Tensor,
    attributes: torch.Tensor,
    background: Sequence[float] | np.ndarray | torch.Tensor,
    optional: Optional,
    scene: Scene,
    options: TapeOptions,
    engine: Engine,
    tape_bytes: int,
) -> Images:
    """The images of ``rasterize``.

    Args:
        optional: further tensors that gradients may go to.

    Raises TypeError or ValueError for tensors that do not fit.
    """
    views, (poses, harmonics) = scene.cameras, optional
    _check("vertices", vertices, "(v, 3)", lambda shape: len(shape) == 2 and shape[1] == 3)
    _check(
        "attributes",
        attributes,
        f"({len(vertices)}, 4 + k)",
        lambda shape: len(shape) == 2 and shape[1] >= 4 and shape[0] == len(vertices),
    )
    backdrop = _background(background, len(views), (views[0].height, views[0].width))
    if poses is not None:
        _need_tensor("world_to_camera", poses)
        poses = poses[None] if len(views) == 1 and poses.ndim == 2 else poses
        if poses.shape != (len(views), 4, 4):
            raise ValueError(
                f"world_to_camera must have shape ({len(views)}, 4, 4), got {tuple(poses.shape)}"
            )
        _check_poses(poses)
    faces = _faces(scene.faces, len(vertices))
    face_splat = _per_face("face_splat", scene.face_splat, len(faces))
    check_ascending(face_splat)
    if harmonics is not None:
        _check_harmonics(harmonics, FaceSplats(faces, face_splat, len(vertices)))
    constant = _Constant(
        views,
        Triangles(
            _NOTHING,
            faces,
            _NOTHING,
            face_splat=face_splat,
            depth_group=_per_face("depth_group", scene.depth_group, len(faces)),
            filter_px2=scene.filter_px2,
            order=scene.order,
        ),
        options,
        engine,
        tape_bytes,
    )
    inputs = (vertices, attributes, backdrop, poses, harmonics)
    if torch.is_grad_enabled() and any(part is not None and part.requires_grad for part in inputs):
        images: Images = _Rasterize.apply(*inputs, constant)  # type: ignore[no-untyped-call]
        return images
    return _forward(*inputs, constant, None)


def _forward(
    vertices: torch.Tensor,
    attributes: torch.Tensor,
    background: torch.Tensor,
    poses: torch.Tensor | None,
    harmonics: torch.Tensor | None,
    constant: _Constant,
    tapes: list[Taped] | None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Colour, alpha and attributes of the images; appends the renderings to ``tapes``, where there is one."""
    values = attributes.detach()
    triangles = constant.triangles._replace(
        vertices=_array(vertices),
        colors=_array(values if values.shape[1] == 4 else values[:, :4]),
        values=_array(values[:, 4:]) if values.shape[1] > 4 else None,
        harmonics=None if harmonics is None else _array(harmonics),
    )
    backdrop = background.detach().numpy()
    images = []
    for i, camera in enumerate(constant.cameras):
        options = replace(
            constant.options,
            background=backdrop[i] if backdrop.ndim == 4 else backdrop,
            pose=None if poses is None else poses[i].detach().double().numpy(),
        )
        rendering = constant.engine.tape(
            triangles, camera, options, tape_bytes=None if tapes is None else constant.tape_bytes
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
        harmonics: torch.Tensor | None,
        constant: _Constant,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        ctx.tapes = []
        images = _forward(vertices, attributes, background, poses, harmonics, constant, ctx.tapes)
        # The core reads these arrays again: torch checks that nobody has changed them in place.
        ctx.save_for_backward(vertices, attributes, background, poses, harmonics, images[1])
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
        vertices, attributes, background, poses, harmonics, alpha = ctx.saved_tensors
        needs = ctx.needs_input_grad
        if grad_color is None:
            grad_color = torch.zeros(*alpha.shape, 3)
        of_images = [None if part is None else _array(part) for part in (grad_color, grad_alpha, grad_extra)]
        grad_vertices = grad_attributes = grad_poses = grad_background = grad_harmonics = None
        if needs[0] or needs[1] or needs[3] or needs[4]:
            width = attributes.shape[1] - 4
            points = np.zeros(vertices.shape, np.float32)
            colors = np.zeros((len(vertices), 4), np.float32)
            more = np.zeros((len(vertices), width), np.float32)
            shades = np.zeros(harmonics.shape, np.float32) if needs[4] else None
            by_pose = []
            for i, rendering in enumerate(ctx.tapes):
                of_image = [None if part is None else part[i] for part in of_images]
                own = np.zeros_like(points) if needs[3] else points
                rendering.backward(
                    *of_image, vertices=own, colors=colors, vertex_attributes=more, harmonics=shades
                )
                if needs[3]:
                    by_pose.append(_pose_gradient(vertices, poses[i], own))
                    points += own
            if needs[3]:
                grad_poses = torch.from_numpy(np.stack(by_pose)).to(poses)
            grad_harmonics = None if shades is None else torch.from_numpy(shades)
            grad_vertices = torch.from_numpy(points)
            grad_attributes = torch.from_numpy(np.concatenate([colors, more], axis=1) if width else colors)
        if needs[2]:
            grad_background = grad_color * (1 - alpha)[..., None]
            if background.ndim < 4:
                grad_background = grad_background.sum(dim=0 if background.ndim == 3 else (0, 1, 2))
        return grad_vertices, grad_attributes, grad_background, grad_poses, grad_harmonics, None


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


def _need_tensor(name: str, value: object) -> None:
    if not isinstance(value, torch.Tensor):
        made = "torch.from_numpy" if isinstance(value, np.ndarray) else "torch.as_tensor"
        raise TypeError(f"{name} must be a torch.Tensor, got {described(value)}: {made}({name}) makes one")


def _check(name: str, tensor: torch.Tensor, shape: str, fits: Callable[[torch.Size], bool]) -> None:
    _need_tensor(name, tensor)
    if tensor.device.type != "cpu" or tensor.dtype != torch.float32 or not fits(tensor.shape):
        raise ValueError(
            f"{name} must be {shape} float32 on the CPU, got {tuple(tensor.shape)} {tensor.dtype} on"
            f" {tensor.device}"
        )


def _need_cpu(name: str, value: object) -> None:
    if isinstance(value, torch.Tensor) and value.device.type != "cpu":
        raise ValueError(f"{name} must be on the CPU, got a tensor on {value.device}: give {name}.cpu()")


def _check_poses(poses: torch.Tensor) -> None:
    _need_cpu("world_to_camera", poses)
    linear = poses.detach()[:, :3, :3].double().numpy()
    if not bool(torch.isfinite(poses).all()):
        raise ValueError("world_to_camera must be finite")
    singular = np.linalg.cond(linear) > _MOST_STRETCH
    if singular.any():
        raise ValueError(
            f"world_to_camera must be rotations with a shift, number {int(singular.argmax())} flattens space"
            " (a singular matrix)"
        )


def _check_harmonics(harmonics: torch.Tensor, splats: FaceSplats) -> None:
    if splats.face_splat is None:
        raise ValueError("harmonics are of splats: give face_splat, too")
    _check(
        "harmonics",
        harmonics,
        f"({len(splats)}, 3, 8 or 15, 3)",
        lambda shape: len(shape) == 3 and shape[0] == len(splats) and shape[1] in TERMS and shape[2] == 3,
    )
    if splats.share_vertices:
        raise ValueError("harmonics are of splats, but two splats share a vertex: give each its own")


def _array(tensor: torch.Tensor) -> np.ndarray:
    """The tensor's own memory where it is contiguous, else a copy."""
    return tensor.detach().contiguous().numpy()


def _indices(name: str, indices: torch.Tensor | np.ndarray) -> np.ndarray:
    """A copy, C-contiguous: the backward pass reads the indices again, and theirs may have changed by then.
    It takes a hundredth of the time of an image."""
    _need_cpu(name, indices)
    return np.array(indices.numpy() if isinstance(indices, torch.Tensor) else indices, order="C")


def _faces(faces: torch.Tensor | np.ndarray, vertices: int) -> np.ndarray:
    array = _indices("faces", faces)
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
    array = _indices(name, indices)
    if array.shape != (faces,) or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name} must be ({faces},) int32, got {array.shape} {array.dtype}")
    return array.astype(np.int32, copy=False)


def _background(
    background: Sequence[float] | np.ndarray | torch.Tensor, count: int, size: tuple[int, int]
) -> torch.Tensor:
    _need_cpu("background", background)
    # An array is copied as indices are; torch itself checks a tensor.
    tensor = (
        background
        if isinstance(background, torch.Tensor)
        else torch.from_numpy(np.array(background, np.float32))
    )
    if tuple(tensor.shape) not in ((3,), (*size, 3), (count, *size, 3)):
        raise ValueError(
            f"background must have shape (3,), {(*size, 3)} or {(count, *size, 3)}, got {tuple(tensor.shape)}"
        )
    return tensor.float()
