"""Texture atlases: where the triangles of a surface lie in its texture, and what is between them."""

from __future__ import annotations

import numpy as np

from meshsplats.errors import MissingDependencyError

GUTTER = 3
"""Texels between the charts of an atlas, and at its border."""


def unwrap(vertices: np.ndarray, faces: np.ndarray, side: int) -> np.ndarray:
    """(f, 3, 2) float32 texture coordinates of the corners of triangles, u to the right, v down, in charts
    that do not overlap, at least ``GUTTER`` texels apart in a texture of ``side`` x ``side``.

    They are packed in a tenth of the time that it takes to pack them by their shapes, a tenth more loosely.

    Raises:
        ValueError: the charts do not fit, or the library fails.
        MissingDependencyError: the library of the extra ``base`` is missing.
    """
    try:
        import uvunwrap
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "textures need the extra 'base', with Python 3.11 or newer: pip install uvunwrap. Without it,"
            " texture=0 (--texture 0) gives vertex colours"
        ) from error
    points = np.ascontiguousarray(vertices, np.float32)
    try:
        atlas = uvunwrap.generate(
            [uvunwrap.Mesh(points, np.ascontiguousarray(faces, np.uint32))],
            page_size=side,
            padding=GUTTER,
            packing="fast",
        )
    except uvunwrap.UnwrapError as error:
        raise ValueError(f"the surface does not fit into a texture of {side} texels: {error}") from error
    except BaseException as error:
        # A panic of compiled code is no Exception: uvunwrap 0.3 with 120,000 faces of a flat.
        if type(error).__name__ != "PanicException":
            raise
        raise ValueError(
            f"uvunwrap fails for the {len(faces):,} triangles of this surface ({error}): choose another"
            " number of faces"
        ) from error
    if atlas.page_count > 1:
        raise ValueError(
            f"the surface needs {atlas.page_count} textures of {side} texels: choose fewer faces or"
            " more texels"
        )
    return np.array(atlas.meshes[0].corner_uvs, np.float32).reshape(-1, 3, 2)


def cells(count: int, side: int) -> np.ndarray:
    """(count, 3, 2) float32 texture coordinates of as many triangles, each by itself, two in each square cell
    of a grid: without seams that anybody sees, as the vertex colours need none."""
    across = int(np.ceil(np.sqrt(-(-count // 2))))
    cell, corner = divmod(np.arange(count), 2)
    size = side / across
    low = np.stack([cell % across, cell // across], axis=1) * size
    far = size - 2  # the diagonals of both keep two texels apart
    first = np.array([[1, 1], [far, 1], [1, far]])
    places = np.where((corner == 0)[:, None, None], first, size - first)
    return ((low[:, None] + places) / side).astype(np.float32)


def cells_side(count: int) -> int:
    """Side of a texture for ``cells``: 8 x 8 texels for two triangles, and at least 4 x 4."""
    return int(np.clip(8 * np.ceil(np.sqrt(-(-count // 2))), 64, 8192))


def filled(texels: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32 ``texels`` with those of no ``weight`` (h, w) filled from the nearest others, by
    pushing means to coarser levels and pulling them back (Gortler and others 1996)."""
    known = weight > 0
    if known.all():
        return texels
    if not known.any():
        return np.full_like(texels, 0.5)
    height, width = known.shape
    padded = ((0, height % 2), (0, width % 2))
    colors = np.pad(np.where(known[..., None], texels, 0), (*padded, (0, 0)))
    share = np.pad(known.astype(np.float32), padded)
    count = share.reshape(share.shape[0] // 2, 2, -1, 2).sum(axis=(1, 3))
    sums = colors.reshape(colors.shape[0] // 2, 2, -1, 2, 3).sum(axis=(1, 3))
    coarse = filled(sums / np.maximum(count, 1)[..., None], count)
    fine = coarse.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(known[..., None], texels, fine).astype(np.float32)
