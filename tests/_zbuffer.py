"""A z-buffer written from the definition, triangle by triangle in float64: what a graphics card draws."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from meshsplats import Camera, SplatMesh


def zbuffer(
    mesh: SplatMesh,
    view: Camera,
    cutoff: float = 0.0,
    *,
    background=(1.0, 1.0, 1.0),
    samples: int = 1,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour (h, w, 3), coverage (h, w) and depth (h, w; covered samples only, summed as ``render`` does).

    Keeps at every sample the nearest fragment whose interpolated opacity is at least ``cutoff``. All vertices
    of a drawn triangle must lie in front of the near plane.
    """
    color, depth = _solid(mesh, view, cutoff, background, samples)
    covered = np.isfinite(depth)
    color, alpha, depth = (
        _pixels(values, samples) for values in (color, covered.astype(float), np.where(covered, depth, 0))
    )
    return color, alpha[..., 0], depth[..., 0]


def hybrid_image(
    solid: SplatMesh, soft: SplatMesh, view: Camera, *, background=(1.0, 1.0, 1.0), samples: int = 1
) -> np.ndarray:
    """Colour (h, w, 3): ``solid`` with a depth buffer, over it ``soft`` blended in the order of its triangles
    where the depth buffer shows nothing nearer."""
    color, depth = _solid(solid, view, 0.0, background, samples)
    for rows, columns, inside, here, rgba in _fragments(soft, view, samples):
        drawn = inside & (here < depth[rows, columns])
        window, alpha = color[rows, columns], rgba[drawn][:, 3:]
        window[drawn] += alpha * (rgba[drawn][:, :3] - window[drawn])
    return _pixels(color, samples)


def _solid(
    mesh: SplatMesh, view: Camera, cutoff: float, background, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth of every sample; depth is infinite where nothing is drawn."""
    size = view.height * samples, view.width * samples
    color = np.tile(np.asarray(background, float), (*size, 1))
    depth = np.full(size, np.inf)
    for rows, columns, inside, here, rgba in _fragments(mesh, view, samples):
        window = depth[rows, columns]
        drawn = inside & (rgba[..., 3] >= cutoff) & (here < window)
        window[drawn] = here[drawn]
        color[rows, columns][drawn] = rgba[drawn][:, :3]
    return color, depth


def _fragments(
    mesh: SplatMesh, view: Camera, samples: int
) -> Iterator[tuple[slice, slice, np.ndarray, np.ndarray, np.ndarray]]:
    """For each triangle a window of samples: its rows and columns, and which of it are inside, their depth
    and RGBA."""
    width, height = view.width * samples, view.height * samples
    points = mesh.vertices.astype(np.float64) @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    u = (view.fx * points[:, 0] / points[:, 2] + view.cx) * samples
    v = (view.fy * points[:, 1] / points[:, 2] + view.cy) * samples
    for face in mesh.faces:
        z = points[face, 2]
        if (z < view.near).any():
            continue
        x, y = u[face], v[face]
        left, top = max(0, int(x.min() - 1)), max(0, int(y.min() - 1))
        right, bottom = min(width, int(x.max() + 2)), min(height, int(y.max() + 2))
        if left >= right or top >= bottom:
            continue
        px, py = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
        areas = np.stack(
            [(x[j] - px) * (y[k] - py) - (x[k] - px) * (y[j] - py) for j, k in ((1, 2), (2, 0), (0, 1))],
            axis=-1,
        )
        whole = areas.sum(axis=-1, keepdims=True)
        if not np.abs(whole).max() > 0:
            continue
        screen = areas / whole
        perspective = screen / z
        here = 1 / perspective.sum(axis=-1)
        rgba = np.einsum("ijk,kc->ijc", perspective * here[..., None], mesh.colors[face].astype(np.float64))
        yield slice(top, bottom), slice(left, right), (screen >= 0).all(axis=-1), here, rgba


def _pixels(values: np.ndarray, samples: int) -> np.ndarray:
    """Means over the samples of each pixel."""
    height, width = (side // samples for side in values.shape[:2])
    return values.reshape(height, samples, width, samples, -1).mean(axis=(1, 3))
