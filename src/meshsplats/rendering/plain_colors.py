"""plain_colors_of: vertex colours that are the same from everywhere, for programs without harmonics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._common.arrays import check_faces
from meshsplats._common.kinds import need, need_all
from meshsplats.rendering.devices import engine
from meshsplats.rendering.engine import visible_pixels
from meshsplats.rendering.shading import shaded
from meshsplats.scene.camera import OUT_OF_SIGHT, Camera
from meshsplats.scene.mesh import SplatMesh

_HIDDEN_PIXELS = 1e-6
"""Weight in a view of a vertex that the view does not show, so that one that none shows has a mean, too."""


def plain_colors_of(mesh: SplatMesh, cameras: Sequence[Camera], *, threads: int | None = None) -> np.ndarray:
    """The colours of ``mesh`` for programs that draw no harmonics, as ``SplatMesh.plain_colors``.

    The colour of a vertex is the mean of its colours in all views, each weighted by the pixels that the
    vertex fills there: were there no other vertices, the colour of least squared error in these images. A
    vertex that no view shows has the plain mean.

    Args:
        mesh: the mesh.
        cameras: the views, at least one.
        threads: at most so many; None: all processors.

    Returns:
        (v, 3) float32 in [0, 1].

    Raises ValueError for no views, and for views that show nothing of the mesh.
    """
    need(SplatMesh, mesh=mesh)
    need_all(Camera, cameras=cameras)
    if not len(cameras):
        raise ValueError("cameras must be at least one view that colours are taken from, got none")
    check_faces(mesh.faces, len(mesh.vertices))
    if mesh.harmonics is None:
        return mesh.plain.colors[:, :3].copy()
    colors, shown = plain_means(mesh, cameras, threads=threads)
    if not shown and mesh.colors[mesh.faces, 3].any():
        raise ValueError(
            f"none of the {len(cameras)} cameras sees any of the {len(mesh.faces):,} triangles:"
            f" {OUT_OF_SIGHT}"
        )
    return colors


def plain_means(
    mesh: SplatMesh, cameras: Sequence[Camera], *, threads: int | None = None
) -> tuple[np.ndarray, bool]:
    """``plain_colors_of`` a mesh with harmonics, and whether any view shows something of it."""
    drawing = engine("cpu", threads)
    sums, weights = np.zeros((len(mesh.vertices), 3)), np.zeros((len(mesh.vertices), 1))
    shown = False
    for camera in cameras:
        triangles = shaded(mesh.triangles, camera, threads=threads)
        visible = visible_pixels(drawing, triangles, camera)[:, None]
        shown = shown or bool(visible.any())
        pixels = visible + _HIDDEN_PIXELS
        sums += pixels * triangles.colors[:, :3]
        weights += pixels
    return np.clip(sums / weights, 0, 1).astype(np.float32), shown
