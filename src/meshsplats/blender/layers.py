"""Counts layers behind each other, which decide Blender's limit on transparent bounces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.cameras.framing import front_axes, scene_bounds
from meshsplats.cameras.trajectories import look_at
from meshsplats.rendering import render
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh

_PROBE = 2.0**-12
PROBE_SIDE = 192
"""Longer side in pixels of the images in which layers are counted: the count varies slowly over
an image."""


def count_layers(mesh: SplatMesh, camera: Camera, *, threads: int | None = None) -> np.ndarray:
    """(h, w) int32 count of the triangles that cover each pixel's centre, hidden ones too.

    All triangles are rendered with the same tiny opacity a. The transmittance of n of them is (1 - a)^n,
    which gives n to one in a thousand.
    """
    colors = np.empty_like(mesh.colors)
    colors[:] = (0, 0, 0, _PROBE)
    probe = replace(mesh, colors=colors, attributes={}, normals=None)
    seen = render(probe, camera, min_transmittance=0.0, threads=threads).alpha.astype(np.float64)
    return np.rint(np.log1p(-np.minimum(seen, 1 - 1e-12)) / np.log1p(-_PROBE)).astype(np.int32)


def most_layers(
    mesh: SplatMesh,
    cameras: Sequence[Camera] = (),
    directions: Sequence[np.ndarray] = (),
    *,
    threads: int | None = None,
) -> int:
    """The most layers along any ray from up to eight of the ``cameras`` and along ``directions``.

    ``directions`` are (3,) unit vectors in the world frame from the subject to a distant light. The scene's
    six axis directions sample indirect light.
    """
    if len(mesh.faces) == 0:
        return 0
    probes = [camera.within(PROBE_SIDE) for camera in subsample(cameras or (), 8)]
    bounds = scene_bounds(mesh)
    reach = float(np.linalg.norm(bounds.points - bounds.center, axis=1).max()) or bounds.radius
    axes = front_axes(mesh.up.astype(np.float64))
    for direction in [*directions, axes[0], axes[1], axes[2]]:
        # From far enough that rays are nearly parallel, as a sun's are; opposite directions count the same.
        away = 20 * reach
        angle = 2 * np.degrees(np.arctan(reach / away))
        center = bounds.center + away * np.asarray(direction, np.float64)
        probes.append(
            look_at(
                center,
                bounds.center,
                up=axes[1],
                width=PROBE_SIDE,
                height=PROBE_SIDE,
                fov=max(angle, 1.0),
                near=away / 100,
            )
        )
    return max(int(count_layers(mesh, camera, threads=threads).max()) for camera in probes)


def bounce_limit(layers: int, largest: int = 1024) -> int:
    """Limit on transparent bounces for a scene with ``layers``: a quarter more, as only some rays were
    tried."""
    return int(min(largest, max(64, -(-layers * 5 // 4))))


def hidden_by_limit(
    mesh: SplatMesh, camera: Camera, limit: int = 1024, *, threads: int | None = None
) -> float:
    """Share of the pixels (0 to 1) whose alpha changes by more than half an 8-bit step if only ``limit``
    layers are followed."""
    probe = camera.within(2 * PROBE_SIDE)
    whole = render(mesh, probe, threads=threads).alpha
    cut = render(mesh, probe, max_layers=limit, threads=threads).alpha
    return float(np.mean(np.abs(whole - cut) > 0.5 / 255))
