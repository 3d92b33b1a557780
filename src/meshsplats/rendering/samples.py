"""How many samples a mesh needs in each pixel at its size in the images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.kinds import need, need_all
from meshsplats.cameras.framing import weighted_quantile
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh

FEWEST, MOST = 2, 8
"""Least and greatest side of the grid of samples in each pixel."""

SPAN = 8.0
"""Samples along the side of a small fan. Images of five real scenes are then within 46 to 57 dB of those with
12 x 12 samples; the error falls nearly with the square of the side of the grid."""

SMALL = 0.1
"""A small fan: fans that are smaller have this share of the sum of opacity times area."""

FANS = 20_000
"""Largest number of fans to measure, evenly spread."""

CAMERAS = 4
"""Largest number of cameras to measure in, evenly spread."""


def needed_samples(mesh: SplatMesh, cameras: Sequence[Camera]) -> int:
    """Side of the grid of samples in each pixel, 2 to 8, that keeps sampling noise out of the images of
    ``mesh`` from ``cameras``. It is the same for all of them, so that animations do not flicker.

    Fans are the triangles of one splat (``face_splat``); a mesh without them needs 2, one with a low-pass
    filter (``filter_px2``) 1, and so does one that no camera sees, or without cameras.

    Raises TypeError for what is no mesh or no list of cameras.
    """
    need(SplatMesh, mesh=mesh)
    need_all(Camera, cameras=cameras)
    if mesh.filter_px2:
        return 1  # its filter is as wide as a pixel, as that of splats
    if mesh.face_splat is None or not len(mesh.faces):
        return FEWEST
    splats = mesh.splats
    step = -(-len(splats) // FANS)
    starts, counts = splats.starts[::step], splats.counts[::step]
    first = np.cumsum(counts) - counts
    rows = np.arange(int(counts.sum())) - np.repeat(first, counts) + np.repeat(starts, counts)
    corners = mesh.faces[rows]
    opacity = mesh.colors[corners, 3].mean(axis=1)
    points = mesh.vertices[corners].astype(np.float64)
    sides = []
    for camera in subsample(cameras, CAMERAS):
        near = camera.near_plane(mesh.vertices)
        x, y, z = np.moveaxis(points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3], 2, 0)
        depth = np.maximum(z, near)
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        area = 0.5 * np.abs(
            (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
        )
        shown = (z > near).all(axis=1) & (u.max(axis=1) > 0) & (u.min(axis=1) < camera.width)
        shown &= (v.max(axis=1) > 0) & (v.min(axis=1) < camera.height)
        area *= shown
        whole, weight = np.add.reduceat(area, first), np.add.reduceat(area * opacity, first)
        if weight.sum() > 0:
            sides.append(weighted_quantile(np.sqrt(whole), weight, SMALL))
    if not sides or min(sides) <= 0:
        return FEWEST
    return int(np.clip(round(SPAN / min(sides)), FEWEST, MOST))
