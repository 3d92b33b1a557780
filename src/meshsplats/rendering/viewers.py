"""Images of meshes as web viewers draw them: in the order of the file, unsorted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._core import kernels
from meshsplats.rendering.core_arguments import Pointers, camera_struct, checked_options
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh, checked_cutoff


def viewer_images(
    mesh: SplatMesh,
    camera: Camera,
    cutoffs: Sequence[float | None] = (None,),
    *,
    multisample: bool = True,
    background: Sequence[float] | np.ndarray = (1, 1, 1),
    threads: int | None = None,
) -> np.ndarray:
    """(k, h, w, 3) float32: images of ``mesh`` as three.js draws its `.glb` files with a stock loader, one
    for each of ``cutoffs``.

    None stands for the alpha mode 'blend': triangles are blended in their order, without a sort and without
    writing depth; those that show their backs first, as three.js draws a double-sided material. A number is
    the cutoff of 'mask': fragments of at least that opacity are solid, and the depth buffer keeps the nearest
    of them. Colours are blended as display values and rounded to 8 bits after each fragment. The low-pass
    filter of the mesh is left out.

    Args:
        mesh: the triangles, in the order of the file.
        camera: viewpoint, lens and size of the image.
        cutoffs: least opacities that are drawn, 0 to 1.
        multisample: MSAA: four samples of a pixel's coverage, and one of the colour at its centre, even where
            the triangle does not reach it. False: one sample of both.
        background: RGB, (3,), display values.
        threads: at most this many; all processors by default. The result does not depend on it.

    Raises ValueError for an option out of its range.
    """
    backdrop = _checked_backdrop(camera, background, threads)
    return kernels.viewer_images(
        (mesh.vertices, _display_colors(mesh), mesh.faces),
        camera_struct(camera.with_near_plane(mesh.vertices)),
        backdrop,
        np.array([-1 if c is None else checked_cutoff(c) for c in cutoffs], np.float32),
        multisample=multisample,
        threads=threads,
    )


def ordered_image(
    mesh: SplatMesh,
    order: DrawOrder,
    camera: Camera,
    *,
    multisample: bool = True,
    background: Sequence[float] | np.ndarray = (1, 1, 1),
    threads: int | None = None,
) -> np.ndarray:
    """(h, w, 3) float32: the image of ``mesh`` as three.js draws a `.glb` that lists its triangles in
    ``order``: the nodes by the depths of the middles of their bounds, farthest first, and of each the
    triangles that face the camera, blended as they come. The arguments are those of ``viewer_images``.
    """
    backdrop = _checked_backdrop(camera, background, threads)
    listed = order.listed(mesh.faces)
    parts = [listed[a:b] for a, b in zip(order.starts[:-1], order.starts[1:], strict=True)]
    corners = [mesh.vertices[part.reshape(-1)].astype(np.float64) for part in parts]
    middles = np.array([(points.min(axis=0) + points.max(axis=0)) / 2 for points in corners])
    depths = middles @ camera.world_to_camera[2, :3]
    faces = np.concatenate([parts[k] for k in np.argsort(-depths, kind="stable")])
    return kernels.viewer_images(
        (mesh.vertices, _display_colors(mesh), faces),
        camera_struct(camera.with_near_plane(mesh.vertices)),
        backdrop,
        np.array([-1], np.float32),
        multisample=multisample,
        culled=True,
        threads=threads,
    )[0]


def _checked_backdrop(
    camera: Camera, background: Sequence[float] | np.ndarray, threads: int | None
) -> np.ndarray:
    checked_options(Pointers(), camera, background, 1, threads)
    backdrop = np.ascontiguousarray(background, np.float32)
    if backdrop.shape != (3,):
        raise ValueError(f"background must have shape (3,), got {backdrop.shape}")
    return backdrop


def _display_colors(mesh: SplatMesh) -> np.ndarray:
    colors = mesh.plain.colors
    if mesh.blending == "linear":
        colors = np.concatenate([linear_to_srgb(colors[:, :3]), colors[:, 3:]], axis=1)
    return np.ascontiguousarray(colors, np.float32)
