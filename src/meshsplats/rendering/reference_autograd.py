"""The specification of :func:`meshsplats.rendering.autograd.rasterize`: torch in float64, slow, to be read.

Which triangles a sample sees, and in which order, comes from :mod:`meshsplats.rendering.reference` and is
constant; everything else is torch, differentiated by torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats.camera import Camera
from meshsplats.errors import MissingDependencyError
from meshsplats.mesh import SplatMesh
from meshsplats.rendering import reference

try:
    import torch
except ImportError as error:
    raise MissingDependencyError(
        "meshsplats.rendering.reference_autograd needs torch: pip install 'meshsplats[finetune]'"
    ) from error

from meshsplats.rendering.autograd import Raster


def rasterize(
    vertices: torch.Tensor,
    faces: np.ndarray,
    attributes: torch.Tensor,
    cameras: Camera | Sequence[Camera],
    *,
    background: Sequence[float] | np.ndarray | torch.Tensor = (1, 1, 1),
    world_to_camera: torch.Tensor | None = None,
    samples: int = 1,
    depth_group: np.ndarray | None = None,
) -> Raster:
    """What ``autograd.rasterize`` returns, in float64, with no limit to the layers that are blended.

    Arguments are those of ``autograd.rasterize``; positions and colours may be float32 or float64, but order
    and visibility are found from their float32 values.
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
            samples=samples,
            depth_group=depth_group,
        )
        return Raster(*(part[0] for part in batch))
    backdrop = torch.as_tensor(background).double()
    pictures = []
    for number, camera in enumerate(cameras):
        pose = (
            torch.from_numpy(camera.world_to_camera)
            if world_to_camera is None
            else world_to_camera[number].double()
        )
        behind = backdrop[number] if backdrop.ndim == 4 else backdrop
        pictures.append(
            _picture(
                vertices.double(), faces, attributes.double(), camera, pose, behind, samples, depth_group
            )
        )
    return Raster(*(torch.stack(parts) for parts in zip(*pictures, strict=True)))


def _picture(vertices, faces, attributes, camera, pose, background, samples, depth_group) -> Raster:
    seen = replace(camera, world_to_camera=pose.detach().numpy())
    x, y = reference._sample_positions(camera, samples)
    colors = np.zeros((len(vertices), 4))  # have no part in what is seen
    mesh = SplatMesh(vertices.detach().numpy(), faces, colors, depth_group=depth_group)
    sheet = reference._fragments(mesh, seen, x, y)
    sample, face = torch.from_numpy(sheet.sample), torch.from_numpy(sheet.face)

    corner = torch.from_numpy(np.asarray(faces, np.int64))[face]
    # Weights of the corners at each fragment (reference._cover).
    in_camera = vertices @ pose[:3, :3].T + pose[:3, 3]
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

    # Front to back, a layer of all samples at a time.
    layer = torch.arange(len(sample)) - torch.searchsorted(sample, sample)
    by_layer = torch.argsort(layer, stable=True)
    sizes = torch.bincount(layer).tolist()
    sums = torch.zeros(len(x), attributes.shape[1] - 1, dtype=torch.float64)
    through = torch.ones(len(x), 1, dtype=torch.float64)
    for here, value in zip(sample[by_layer].split(sizes), values[by_layer].split(sizes), strict=True):
        opacity, channels = value[:, 3:4], torch.cat([value[:, :3], value[:, 4:]], dim=1)
        sums = sums.index_add(0, here, through[here] * opacity * channels)
        through = through.index_put((here,), through[here] * (1 - opacity))

    def pixels(part: torch.Tensor) -> torch.Tensor:
        return part.reshape(camera.height, samples, camera.width, samples, -1).mean(dim=(1, 3))

    left = pixels(through)
    mean = pixels(sums)
    return Raster(mean[..., :3] + left * background, 1 - left[..., 0], mean[..., 3:])
