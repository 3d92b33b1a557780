"""Parts of the compiled core on NumPy arrays: losses between images, Adam on selected rows, shapes of fans,
images of web viewers.

Callers have checked their arrays: C-contiguous, of the types and shapes named here.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from meshsplats._core.library import pointer, processors, run, thread_count
from meshsplats._core.structures import (
    AdamStruct,
    CameraStruct,
    ComparisonStruct,
    EdgesStruct,
    FansStruct,
    ListingStruct,
    OrderingStruct,
    ViewerStruct,
)


class Comparison(NamedTuple):
    """Sums over the channels and the pixels that count."""

    l1: float
    ssim: float
    gradient: np.ndarray | None
    """(b, h, w, c) float32: of ``l1_weight * l1 + ssim_weight * ssim`` with respect to the images, 0 at
    pixels that do not count."""


def compare_images(
    images: np.ndarray,
    targets: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    l1_weight: float = 0,
    ssim_weight: float = 0,
    gradient: bool = False,
    threads: int | None = None,
) -> Comparison:
    """Sums of |image - target| and of SSIM, 3DGS convention, and the gradient of their weighted sum.

    ``images`` and ``targets`` are (b, h, w, c) float32, ``mask`` (b, h, w) bool. SSIM is not computed, and
    its sum is 0, where ``ssim_weight`` is 0. The result has the same bits with any number of ``threads`` (all
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
        l1_weight=l1_weight,
        ssim_weight=ssim_weight,
    )
    run("ms_compare_images", comparison)
    return Comparison(comparison.l1, comparison.ssim, result)


class AdamStep(NamedTuple):
    """A step of Adam."""

    rate: float
    """Learning rate with its bias corrections."""
    betas: tuple[float, float]
    eps: float
    scale: np.ndarray | None = None
    """(v,) float32 factors of the rate, row by row."""
    bounds: tuple[float, float] = (-np.inf, np.inf)
    """Smallest and largest value afterwards."""


def adam_rows(
    values: np.ndarray,
    moments: tuple[np.ndarray, np.ndarray],
    gradient: np.ndarray,
    rows: np.ndarray | None,
    step: AdamStep,
    threads: int | None = None,
) -> None:
    """Changes ``values`` and the ``moments``, mean and mean square, in place; all (v, k) float32.

    ``rows`` is an increasing int32 array of row indices, a (v,) bool mask, or None for every row.

    Raises ValueError, before anything changes, if row indices are out of range or do not increase.
    """
    mask = rows if rows is not None and rows.dtype == bool else None
    chosen = rows if mask is None else None
    adam = AdamStruct(
        rows=len(values),
        columns=values.shape[1],
        threads=threads or processors(),
        values=pointer(values),
        mean=pointer(moments[0]),
        square=pointer(moments[1]),
        gradient=pointer(gradient),
        scale=pointer(step.scale),
        chosen=pointer(chosen),
        chosen_count=0 if chosen is None else len(chosen),
        mask=pointer(mask),
        step=step.rate,
        one_minus_beta1=1 - step.betas[0],
        one_minus_beta2=1 - step.betas[1],
        epsilon=step.eps,
        low=step.bounds[0],
        high=step.bounds[1],
    )
    run("ms_adam_rows", adam)


def regular_polygon(sides: int) -> np.ndarray:
    """(sides, 2) float64 corners on the unit circle."""
    angle = 2 * np.pi * np.arange(sides) / sides
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def round_fans(fans: np.ndarray, share: float, threads: int | None = None) -> None:
    """Moves the vertices of ``fans`` in place by a ``share``, 0 to 1, of their distances to an ellipse: the
    nearest affine image of a regular polygon, and its centre.

    ``fans`` is (n, 1 + sides, 3) float32, centres first. The result has the same bits with any number of
    ``threads`` (all processors by default) and on every instruction set.
    """
    sides = fans.shape[1] - 1
    polygon = regular_polygon(sides)
    struct = FansStruct(
        count=len(fans),
        sides=sides,
        threads=threads or processors(),
        vertices=pointer(fans),
        polygon=pointer(polygon),
        share=share,
    )
    run("ms_round_fans", struct)


class OpaqueImage(NamedTuple):
    """Opaque triangles, and their image with s x s samples to a pixel."""

    screen: np.ndarray
    """(v, 3) float64 x and y in samples, and depth."""
    faces: np.ndarray
    """(f, 3) int32"""
    colors: np.ndarray
    """(v, 4) float32"""
    across: np.ndarray
    """(f, 3) int32, that of ``faces_across`` in rendering/edges.py."""
    front: np.ndarray
    """(h s, w s) int32 triangle in front at each sample, -1 for none."""
    color: np.ndarray
    """(h s, w s, 3) float32 there."""
    near: float
    """Least depth; triangles with a vertex in front of it get no gradient."""
    cutoff: float
    """Least opacity that is drawn."""


def edge_gradients(image: OpaqueImage, gradient: np.ndarray, threads: int | None = None) -> np.ndarray:
    """(v, 2) float64 gradient of a loss with respect to the vertices' positions in an image of opaque
    triangles, in samples, by the motion of visible edges.

    ``gradient`` is that of the loss with respect to the colour of each pixel, (h, w, 3) float32. The result
    has the same bits with any number of ``threads`` (all processors by default).
    """
    height, width = gradient.shape[:2]
    result = np.zeros((len(image.screen), 2))
    struct = EdgesStruct(
        width=width,
        height=height,
        samples=image.front.shape[0] // height,
        threads=threads or processors(),
        vertex_count=len(image.screen),
        face_count=len(image.faces),
        screen=pointer(image.screen),
        colors=pointer(image.colors),
        faces=pointer(image.faces),
        across=pointer(image.across),
        front=pointer(image.front),
        color=pointer(image.color),
        gradient=pointer(gradient),
        near=image.near,
        cutoff=image.cutoff,
        result=pointer(result),
    )
    run("ms_edge_gradients", struct)
    return result


def viewer_images(
    triangles: tuple[np.ndarray, np.ndarray, np.ndarray],
    camera: CameraStruct,
    background: np.ndarray,
    cutoffs: np.ndarray,
    *,
    multisample: bool,
    culled: bool = False,
    threads: int | None = None,
) -> np.ndarray:
    """(k, h, w, 3) float32 images of triangles in their order: see ``viewer_images`` in rendering/viewers.py.

    The result has the same bits with any number of ``threads`` (all processors by default).

    Args:
        triangles: vertices (v, 3) float32, colours (v, 4) float32 display values, faces (f, 3) int32.
        background: (3,) float32.
        cutoffs: (k,) float32 of the alpha test; negative: blend.
        multisample: four samples of coverage to a pixel.
        culled: without triangles that show their backs.
    """
    vertices, colors, faces = triangles
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
        culled=culled,
        threads=thread_count(threads),
    )
    run("ms_viewer_images", struct)
    return result


class Pieces(NamedTuple):
    """Triangles of a mesh by the planar pieces of splats that they form."""

    vertices: np.ndarray
    """(v, 3) float32"""
    colors: np.ndarray
    """(v, 4) float32"""
    faces: np.ndarray
    """(f, 3) int32, those of a piece side by side."""
    turned: np.ndarray
    """(f,) bool: the winding shows the back of the piece."""
    start: np.ndarray
    """(p + 1,) int64 first triangle of each piece."""
    centers: np.ndarray
    """(p, 3) float64"""
    splat: np.ndarray
    """(p,) int32"""
    node: np.ndarray
    """(p,) int32"""


class Ordered(NamedTuple):
    """Places of units in an order of blending, and the weight of the pairs of units that are out of order."""

    rank: np.ndarray
    """(2 p,) int32 place of each unit."""
    pairs: int
    weight: float
    """Of all pairs."""
    before: float
    after: float


def order_triangles(
    pieces: Pieces,
    rank: np.ndarray,
    cameras: Sequence[CameraStruct],
    *,
    sweeps: int,
    max_pairs: int,
    threads: int | None = None,
) -> Ordered:
    """The order of blending of triangles that suits all ``cameras`` best, from that of ``rank``: see
    csrc/ordering.h. The result has the same bits with any number of ``threads`` (all processors by default).
    """
    result = rank.astype(np.int32)
    views = (CameraStruct * len(cameras))(*cameras)
    struct = OrderingStruct(
        vertex_count=len(pieces.vertices),
        face_count=len(pieces.faces),
        piece_count=len(pieces.centers),
        vertices=pointer(pieces.vertices),
        colors=pointer(pieces.colors),
        faces=pointer(pieces.faces),
        turned=pointer(pieces.turned),
        piece_start=pointer(pieces.start),
        centers=pointer(pieces.centers),
        splat=pointer(pieces.splat),
        node=pointer(pieces.node),
        cameras=ctypes.addressof(views),
        camera_count=len(cameras),
        sweeps=sweeps,
        threads=thread_count(threads),
        max_pairs=max_pairs,
        rank=pointer(result),
    )
    run("ms_order_triangles", struct)
    return Ordered(result, struct.pairs, struct.weight, struct.before, struct.after)


def listed_triangles(
    triangles: tuple[np.ndarray, np.ndarray, np.ndarray | None],
    order: tuple[np.ndarray, np.ndarray],
    camera: CameraStruct,
    threads: int | None = None,
) -> tuple[np.ndarray, np.ndarray | None]:
    """What a viewer draws of a file that lists triangles with both windings: (f, 3) int32 triangles in the
    order of blending, and (f,) int32 their splats.

    Args:
        triangles: vertices (v, 3) float32, faces (f, 3) int32, splats (f,) int32 or None.
        order: copies and starts, as in ``DrawOrder``.
    """
    vertices, faces, splats = triangles
    copies, starts = order
    listed = np.empty_like(faces)
    listed_splats = None if splats is None else np.empty_like(splats)
    struct = ListingStruct(
        camera=camera,
        vertex_count=len(vertices),
        face_count=len(faces),
        vertices=pointer(vertices),
        faces=pointer(faces),
        face_splat=pointer(splats),
        copies=pointer(copies),
        starts=pointer(starts),
        listed=pointer(listed),
        listed_splat=pointer(listed_splats),
        node_count=len(starts) - 1,
        threads=thread_count(threads),
    )
    run("ms_list_triangles", struct)
    return listed, listed_splats
