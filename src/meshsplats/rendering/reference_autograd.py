"""The specification of :func:`meshsplats.rendering.autograd.rasterize`: torch in float64, slow, to be read.

The fragments of each sample and their order come from :mod:`meshsplats.rendering.reference` and are constant;
everything else is torch, differentiated by torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from meshsplats.errors import MissingDependencyError
from meshsplats.rendering import reference
from meshsplats.scene.camera import Camera
from meshsplats.scene.face_splats import FaceSplats
from meshsplats.scene.mesh import SplatMesh, Triangles
from meshsplats.scene.order import Order

try:
    import torch
except ModuleNotFoundError as error:
    raise MissingDependencyError(
        'meshsplats.rendering.reference_autograd needs torch: pip install "meshsplats[torch]"'
    ) from error

from meshsplats.rendering.autograd import Raster
from meshsplats.rendering.backward import OpacityRamp
from meshsplats.rendering.reference_samples import sample_positions
from meshsplats.scene.spherical_harmonics import degree_of, sh_basis


def rasterize(
    vertices: torch.Tensor,
    faces: np.ndarray,
    attributes: torch.Tensor,
    cameras: Camera | Sequence[Camera],
    *,
    background: Sequence[float] | np.ndarray | torch.Tensor = (1, 1, 1),
    world_to_camera: torch.Tensor | None = None,
    harmonics: torch.Tensor | None = None,
    samples: int = 1,
    face_splat: np.ndarray | None = None,
    depth_group: np.ndarray | None = None,
    filter_px2: float = 0.0,
    ramp: OpacityRamp | None = None,
    order: Order = "fragment",
) -> Raster:
    """The result of ``autograd.rasterize`` in float64, without early termination.

    Arguments are those of ``autograd.rasterize``; positions and colours may be float32 or float64, but the
    order of fragments is that of their float32 values. A ``ramp`` changes the opacities.
    """
    if isinstance(cameras, Camera):
        pose = None if world_to_camera is None else world_to_camera[None]
        batch = rasterize(
            vertices,
            faces,
            attributes,
            [cameras],
            background=background,
            world_to_camera=pose,
            harmonics=harmonics,
            samples=samples,
            face_splat=face_splat,
            depth_group=depth_group,
            filter_px2=filter_px2,
            ramp=ramp,
            order=order,
        )
        return Raster(*(part[0] for part in batch))
    backdrop = torch.as_tensor(background).double()
    images = []
    triangles = _detached(vertices, faces, attributes)._replace(
        face_splat=face_splat, depth_group=depth_group, filter_px2=filter_px2, order=order
    )
    for i, camera in enumerate(cameras):
        pose = (
            torch.from_numpy(camera.world_to_camera)
            if world_to_camera is None
            else world_to_camera[i].double()
        )
        own = backdrop[i] if backdrop.ndim == 4 else backdrop
        seen = attributes
        if harmonics is not None:
            seen = _shaded(attributes, harmonics, triangles, pose.detach().numpy())
        images.append(_image(vertices, seen, triangles, camera, pose, own, samples=samples, ramp=ramp)[0])
    return Raster(*(torch.stack(parts) for parts in zip(*images, strict=True)))


def expected_error(
    vertices: torch.Tensor,
    faces: np.ndarray,
    attributes: torch.Tensor,
    camera: Camera,
    target: torch.Tensor,
    *,
    background: Sequence[float] = (1, 1, 1),
    samples: int = 1,
    ramp: OpacityRamp | None = None,
) -> torch.Tensor:
    """(h, w) ``sum_k T_k a_k |c_k - target|^2``, the background included, of ``backward.ExpectedError``; with
    ``target`` (h, w, 3) float64."""
    pose, backdrop = torch.from_numpy(camera.world_to_camera), torch.as_tensor(background).double()
    image, squares = _image(
        vertices,
        attributes,
        _detached(vertices, faces, attributes),
        camera,
        pose,
        backdrop,
        samples=samples,
        ramp=ramp,
    )
    # The weights of a sample add up to 1.
    return squares - 2 * (image.color * target).sum(dim=-1) + (target**2).sum(dim=-1)


def _shaded(
    attributes: torch.Tensor, harmonics: torch.Tensor, triangles: Triangles, pose: np.ndarray
) -> torch.Tensor:
    """(v, 4 + k) ``attributes`` with the colours that the camera of that ``pose`` sees."""
    owner = FaceSplats(triangles.faces, triangles.face_splat, len(triangles.vertices)).of_vertex
    used = torch.from_numpy(np.flatnonzero(owner >= 0))
    away = triangles.vertices.astype(np.float64) + pose[:3, :3].T @ pose[:3, 3]
    away = away[used] / np.linalg.norm(away[used], axis=1, keepdims=True)
    basis = torch.from_numpy(np.ascontiguousarray(sh_basis(away, degree_of(harmonics))[:, 1:]))
    added = torch.einsum("vk,vkc->vc", basis, harmonics.double()[torch.from_numpy(owner)[used]])
    seen = _AtLeastZero.apply(attributes[used, :3].double() + added)  # type: ignore[no-untyped-call]
    return torch.cat([attributes[:, :3].double().index_put((used,), seen), attributes[:, 3:].double()], dim=1)


def _detached(vertices: torch.Tensor, faces: np.ndarray, attributes: torch.Tensor) -> Triangles:
    """The order of whose fragments counts; of the colours, the filter reads the opacities."""
    colors = np.zeros((len(vertices), 4))
    colors[:, 3] = attributes[:, 3].detach().numpy()
    return Triangles(vertices.detach().numpy(), faces, colors)


def filtered(
    points: torch.Tensor,
    faces: np.ndarray,
    opacity: torch.Tensor,
    camera: Camera,
    face_splat: np.ndarray,
    px2: float,
) -> torch.Tensor:
    """``reference.filtered``: (v, 3) ``points`` in the camera's frame, widened by their (v,) ``opacity``."""
    result, near = points.clone(), camera.near or 0
    focal = points.new_tensor([camera.fx, camera.fy])
    for splat in np.unique(face_splat):
        corner = torch.from_numpy(np.asarray(faces, np.int64)[face_splat == splat])
        z = points[corner][..., 2:]
        if not bool((z >= near).all()):
            continue
        projected = points[corner][..., :2] / z * focal
        k = reference.FILTER_DEPTH_SHARE * focal.prod().sqrt() * z[0, 0]
        a, b, c = torch.cat([projected, k / z], dim=2).unbind(1)
        area = torch.linalg.cross(b - a, c - a).norm(dim=1)
        if not bool(area.sum() > 0):
            continue
        weights, shares = zip(*reference.CUBATURE, strict=True)
        at = points.new_tensor(np.array(weights))
        opacities = opacity[corner] + reference.FILTER_OPACITY_BIAS
        share = points.new_tensor(shares) * area[:, None] * (opacities @ at.T)
        share = share / share.sum()
        position = torch.einsum("nk,tkc->tnc", at, projected)
        mean = (share[..., None] * position).sum((0, 1))
        covariance = torch.einsum("tn,tni,tnj->ij", share, position - mean, position - mean)
        one = torch.eye(2, dtype=points.dtype)
        square = one + px2 * torch.linalg.inv(covariance + reference.FILTER_MIN_VARIANCE * px2 * one)
        root = torch.linalg.det(square).sqrt()
        spread = (square + root * one) / (torch.trace(square) + 2 * root).sqrt()  # its square root
        own = torch.unique(corner)
        moved = mean + (points[own, :2] / points[own, 2:] * focal - mean) @ spread
        moved = torch.cat([moved / focal * points[own, 2:], points[own, 2:]], dim=1)
        result = result.index_put((own,), moved)
    return result


def _image(
    vertices: torch.Tensor,
    attributes: torch.Tensor,
    triangles: Triangles,
    camera: Camera,
    pose: torch.Tensor,
    background: torch.Tensor,
    *,
    samples: int,
    ramp: OpacityRamp | None,
) -> tuple[Raster, torch.Tensor]:
    """The image, and (h, w) ``sum_k T_k a_k |c_k|^2``, with the background's."""
    camera = camera.with_near_plane(triangles.vertices, pose.detach().numpy())
    posed = replace(camera, world_to_camera=pose.detach().numpy())
    x, y = sample_positions(camera, samples)
    vertices, attributes = vertices.double(), attributes.double()
    faces, face_splat, px2 = triangles.faces, triangles.face_splat, triangles.filter_px2
    mesh = SplatMesh(
        triangles.vertices, faces, triangles.colors, face_splat=face_splat, depth_group=triangles.depth_group
    )
    sheet = reference.fragments_of(mesh, posed, x, y, px2, triangles.order)
    sample, face = torch.from_numpy(sheet.sample), torch.from_numpy(sheet.face)

    corner = torch.from_numpy(np.asarray(faces, np.int64))[face]
    # Weights of the corners at each fragment (``reference._cover``).
    in_camera = vertices @ pose[:3, :3].T + pose[:3, 3]
    if px2:
        assert face_splat is not None
        in_camera = filtered(in_camera, faces, attributes[:, 3], camera, face_splat, px2)
    z = in_camera[:, 2]
    corners = torch.stack(
        [camera.fx * in_camera[:, 0] + camera.cx * z, camera.fy * in_camera[:, 1] + camera.cy * z, z], dim=1
    )[corner]
    point = torch.from_numpy(np.stack([x, y, np.ones_like(x)], axis=1))[sample]
    a, b, c = corners.unbind(1)
    edges = torch.stack(
        [(point * torch.linalg.cross(*pair)).sum(1) for pair in ((b, c), (c, a), (a, b))], dim=1
    )
    weights = edges / edges.sum(1, keepdim=True)
    values = (weights[:, :, None] * attributes[corner]).sum(1)
    if ramp is not None:
        alpha = values[:, 3]
        # Of e . a / sum e with e linear in x and y, whose coefficients are the cross products.
        rows = torch.stack([torch.linalg.cross(*pair) for pair in ((b, c), (c, a), (a, b))], dim=1)[..., :2]
        toward = (rows * (attributes[corner][..., 3] - alpha[:, None])[..., None]).sum(1)
        slope = (toward / edges.sum(1, keepdim=True)).norm(dim=1).detach()
        k = torch.clamp(1 / (ramp.width * slope).clamp(min=1e-20), max=ramp.slope)
        raised = _Leaky.apply(  # type: ignore[no-untyped-call]
            ramp.height + (alpha - ramp.cutoff) * k, k, ramp.leak
        )
        values = torch.cat([values[:, :3], raised[:, None], values[:, 4:]], dim=1)
    values = torch.cat([values, (values[:, :3] ** 2).sum(1, keepdim=True)], dim=1)

    # Front to back, a layer of all samples at a time.
    layer = torch.arange(len(sample)) - torch.searchsorted(sample, sample)
    by_layer = torch.argsort(layer, stable=True)
    sizes = torch.bincount(layer).tolist()
    sums = torch.zeros(len(x), attributes.shape[1], dtype=torch.float64)
    through = torch.ones(len(x), 1, dtype=torch.float64)
    layers = zip(torch.split(sample[by_layer], sizes), torch.split(values[by_layer], sizes), strict=True)
    for here, value in layers:
        opacity, channels = value[:, 3:4], torch.cat([value[:, :3], value[:, 4:]], dim=1)
        sums = sums.index_add(0, here, through[here] * opacity * channels)
        through = through.index_put((here,), through[here] * (1 - opacity))

    def pixels(part: torch.Tensor) -> torch.Tensor:
        return part.reshape(camera.height, samples, camera.width, samples, -1).mean(dim=(1, 3))

    left = pixels(through)
    mean = pixels(sums)
    squares = mean[..., -1] + left[..., 0] * (background**2).sum(dim=-1)
    return Raster(mean[..., :3] + left * background, 1 - left[..., 0], mean[..., 3:-1]), squares


class _Leaky(torch.autograd.Function):
    """Clamps to [0, 1]; outside, the derivative with respect to the opacity is ``leak``, not 0: that of the
    value, which has the slope k, is leak / k."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor, k: torch.Tensor, leak: float) -> torch.Tensor:
        ctx.save_for_backward((value > 0) & (value < 1), k)
        ctx.leak = leak
        return value.clamp(0, 1)

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        inside, k = ctx.saved_tensors
        return grad * torch.where(inside, torch.ones_like(k), ctx.leak / k), None, None


class _AtLeastZero(torch.autograd.Function):
    """Clamps at 0; there, the derivative is 1 for a gradient below 0, which raises the value, else 0."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(value > 0)
        return value.clamp(min=0)

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> torch.Tensor:
        (above,) = ctx.saved_tensors
        return torch.where(above | (grad < 0), grad, torch.zeros_like(grad))
