"""Parts of the compiled core on NumPy arrays: losses between images, Adam on selected rows, shapes of fans,
images of web viewers.

Callers have checked their arrays: C-contiguous, of the types and shapes named here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshsplats._core.library import pointer, processors, run
from meshsplats._core.structures import (
    AdamStruct,
    CameraStruct,
    ComparisonStruct,
    EdgesStruct,
    FansStruct,
    ViewerStruct,
)


class Comparison(NamedTuple):
    """Sums over the channels and the pixels that count."""

    l1: float
    ssim: float
    gradient: np.ndarray | None
    """(b, h, w, c) float32: of ``l1_rate * l1 + ssim_rate * ssim`` with respect to the images, 0 at pixels
    that do not count."""


def compare_images(
    images: np.ndarray,
    targets: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    l1_rate: float = 0,
    ssim_rate: float = 0,
    gradient: bool = False,
    threads: int | None = None,
) -> Comparison:
    """Sums of |image - target| and of SSIM, 3DGS convention, and the gradient of their weighted sum.

    ``images`` and ``targets`` are (b, h, w, c) float32, ``mask`` (b, h, w) bool. SSIM is not computed, and
    its sum is 0, where ``ssim_rate`` is 0. The result has the same bits with any number of ``threads`` (all
    processors by default) and on every instruction set.
    """
    count, height, width, channels = images.shape
    result = np.empty_like(images) if gradient else None
    comparison = ComparisonStruct(
        count=count,
        height=height,
        width=width,
        channels=channels,
        threads=threads or processors(),
        image=pointer(images),
        target=pointer(targets),
        mask=pointer(mask),
        gradient=pointer(result),
        l1_rate=l1_rate,
        ssim_rate=ssim_rate,
    )
    run("ms_compare_images", comparison)
    return Comparison(comparison.l1, comparison.ssim, result)


def adam_rows(
    values: np.ndarray,
    mean: np.ndarray,
    square: np.ndarray,
    gradient: np.ndarray,
    rows: np.ndarray | None,
    *,
    step: float,
    betas: tuple[float, float],
    eps: float,
    scale: np.ndarray | None = None,
    bounds: tuple[float, float] = (-np.inf, np.inf),
    threads: int | None = None,
) -> None:
    """Changes ``values`` and the moments ``mean`` and ``square`` in place, all (v, k) float32.

    ``rows`` is an increasing int32 array of row indices, a (v,) bool mask, or None for every row. ``step`` is
    the learning rate with its bias corrections, ``scale`` (v,) float32 multiplies it row by row.

    Raises ValueError, before anything changes, if row indices are out of range or do not increase.
    """
    mask = rows if rows is not None and rows.dtype == bool else None
    chosen = rows if mask is None else None
    adam = AdamStruct(
        rows=len(values),
        columns=values.shape[1],
        threads=threads or processors(),
        values=pointer(values),
        mean=pointer(mean),
        square=pointer(square),
        gradient=pointer(gradient),
        scale=pointer(scale),
        chosen=pointer(chosen),
        chosen_count=0 if chosen is None else len(chosen),
        mask=pointer(mask),
        step=step,
        one_minus_beta1=1 - betas[0],
        one_minus_beta2=1 - betas[1],
        epsilon=eps,
        low=bounds[0],
        high=bounds[1],
    )
    run("ms_adam_rows", adam)


def round_fans(fans: np.ndarray, share: float, threads: int | None = None) -> None:
    """Moves the vertices of ``fans`` in place by a ``share``, 0 to 1, of their distances to an ellipse: the
    nearest affine image of a regular polygon, and its centre.

    ``fans`` is (n, 1 + sides, 3) float32, centres first. The result has the same bits with any number of
    ``threads`` (all processors by default) and on every instruction set.
    """
    sides = fans.shape[1] - 1
    angle = 2 * np.pi * np.arange(sides) / sides
    polygon = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    struct = FansStruct(
        count=len(fans),
        sides=sides,
        threads=threads or processors(),
        vertices=pointer(fans),
        polygon=pointer(polygon),
        share=share,
    )
    run("ms_round_fans", struct)


def edge_gradients(
    screen: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray,
    beyond: np.ndarray,
    front: np.ndarray,
    image: np.ndarray,
    gradient: np.ndarray,
    *,
    near: float,
    cutoff: float,
    threads: int | None = None,
) -> np.ndarray:
    """(v, 2) float64 gradient of a loss with respect to the vertices' positions in an image of opaque
    triangles, in samples, by the motion of visible edges.

    The result has the same bits with any number of ``threads`` (all processors by default).

    Args:
        screen: (v, 3) float64 x and y in samples, and depth.
        faces, colors: (f, 3) int32 and (v, 4) float32, those of the mesh.
        beyond: (f, 3) int32, that of ``corners_beyond`` in rendering/edges.py.
        front: (h s, w s) int32 triangle in front at each of the s x s samples of a pixel, -1 for none.
        image: (h s, w s, 3) float32 colour there.
        gradient: (h, w, 3) float32 gradient of the loss with respect to the colour of each pixel.
        near: least depth; triangles with a vertex in front of it get nothing.
        cutoff: least opacity that is drawn.
    """
    height, width = gradient.shape[:2]
    result = np.zeros((len(screen), 2))
    struct = EdgesStruct(
        width=width,
        height=height,
        samples=front.shape[0] // height,
        threads=threads or processors(),
        vertex_count=len(screen),
        face_count=len(faces),
        screen=pointer(screen),
        colors=pointer(colors),
        faces=pointer(faces),
        beyond=pointer(beyond),
        front=pointer(front),
        color=pointer(image),
        gradient=pointer(gradient),
        near=near,
        cutoff=cutoff,
        result=pointer(result),
    )
    run("ms_edge_gradients", struct)
    return result


def viewer_images(
    vertices: np.ndarray,
    colors: np.ndarray,
    faces: np.ndarray,
    camera: CameraStruct,
    background: np.ndarray,
    cutoffs: np.ndarray,
    *,
    multisample: bool,
    threads: int | None = None,
) -> np.ndarray:
    """(k, h, w, 3) float32 images of triangles in their order: see ``viewer_images`` in rendering/viewers.py.

    The result has the same bits with any number of ``threads`` (all processors by default).

    Args:
        vertices, colors, faces: (v, 3) float32, (v, 4) float32 display values, (f, 3) int32.
        background: (3,) float32.
        cutoffs: (k,) float32 of the alpha test; negative: blend.
        multisample: four samples of coverage to a pixel.
    """
    result = np.empty((len(cutoffs), camera.height, camera.width, 3), np.float32)
    struct = ViewerStruct(
        camera=camera,
        vertex_count=len(vertices),
        face_count=len(faces),
        vertices=pointer(vertices),
        colors=pointer(colors),
        faces=pointer(faces),
        background=pointer(background),
        cutoffs=pointer(cutoffs),
        color=pointer(result),
        image_count=len(cutoffs),
        multisample=multisample,
        threads=min(threads or processors(), 256),
    )
    run("ms_viewer_images", struct)
    return result
