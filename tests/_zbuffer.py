"""A z-buffer written from the definition, triangle by triangle in float64: what a graphics card draws."""

from __future__ import annotations

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
    width, height = view.width * samples, view.height * samples
    points = mesh.vertices.astype(np.float64) @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    u = (view.fx * points[:, 0] / points[:, 2] + view.cx) * samples
    v = (view.fy * points[:, 1] / points[:, 2] + view.cy) * samples
    color = np.tile(np.asarray(background, float), (height, width, 1))
    depth = np.full((height, width), np.inf)
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
        window = depth[top:bottom, left:right]
        drawn = (screen >= 0).all(axis=-1) & (rgba[..., 3] >= cutoff) & (here < window)
        window[drawn] = here[drawn]
        color[top:bottom, left:right][drawn] = rgba[drawn][:, :3]

    def pixels(values: np.ndarray) -> np.ndarray:
        return values.reshape(view.height, samples, view.width, samples, -1).mean(axis=(1, 3))

    covered = np.isfinite(depth)
    distance = np.where(covered, depth, 0)
    return pixels(color), pixels(covered.astype(float))[..., 0], pixels(distance)[..., 0]
