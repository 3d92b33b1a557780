"""Meshes, cameras and options as arguments of the compiled core, checked where that costs nothing."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_double

import numpy as np

from meshsplats._common.choices import MAX_SIDE
from meshsplats._common.kinds import need_array
from meshsplats._core import library, structures
from meshsplats._core.library import check_threads
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import MAX_COLOR, Triangles, checked_filter
from meshsplats.scene.order import checked_order

MAX_SAMPLES = 16
"""Largest side of the grid of samples in each pixel."""

_TEXT = {"path": "white is (1, 1, 1), black (0, 0, 0); np.asarray(Image.open(path)) / 255 reads an image"}
"""What to give in place of a background in words."""


class Pointers:
    """Gives the core pointers to arrays, and keeps the arrays alive as long as itself."""

    def __init__(self) -> None:
        self._arrays: list[np.ndarray] = []

    def __call__(self, array: np.ndarray | None) -> int | None:
        if array is not None:
            self._arrays.append(array)
        return library.pointer(array)


def mesh_struct(keep: Pointers, triangles: Triangles) -> structures.MeshStruct:
    """The core's structure of ``triangles``, whose arrays ``keep`` holds.

    Raises ValueError for a filter that is out of range, and for a filter or an order that has no splats.
    """
    values = triangles.values
    width = 0 if values is None else values.shape[1]
    return structures.MeshStruct(
        vertex_count=len(triangles.vertices),
        face_count=len(triangles.faces),
        vertices=keep(triangles.vertices),
        colors=keep(triangles.colors),
        faces=keep(triangles.faces),
        face_splat=keep(triangles.face_splat),
        depth_group=keep(compact_groups(triangles.depth_group)),
        normals=keep(triangles.normals),
        attributes=keep(values if width else None),
        attribute_count=width,
        by_splat=checked_order(triangles.order, triangles.face_splat) == "splat",
        filter_px2=checked_filter(triangles.filter_px2, triangles.face_splat),
    )


def camera_struct(camera: Camera) -> structures.CameraStruct:
    """``camera``, which has a near plane, for the core."""
    assert camera.near is not None
    rows = (c_double * 12)(*camera.world_to_camera[:3].ravel())
    return structures.CameraStruct(
        rows, camera.fx, camera.fy, camera.cx, camera.cy, camera.near, camera.width, camera.height
    )


def checked_options(
    keep: Pointers,
    camera: Camera,
    background: Sequence[float] | np.ndarray,
    samples: int,
    threads: int | None,
) -> structures.OptionsStruct:
    """The options of an image. ValueError for values out of range, or a background of another shape;
    TypeError for one that is no array."""
    if not (isinstance(samples, (int, np.integer)) and 1 <= samples <= MAX_SAMPLES):
        raise ValueError(f"samples must be the side of the sample grid, 1 to {MAX_SAMPLES}, got {samples!r}")
    check_threads(threads)
    need_array(background=background, wanted="RGB from 0 to 1, or an image of it", instead=_TEXT)
    backdrop = np.ascontiguousarray(background, np.float32)
    if backdrop.shape not in ((3,), (camera.height, camera.width, 3)):
        raise ValueError(
            f"background must have shape (3,) or ({camera.height}, {camera.width}, 3), got {backdrop.shape}"
        )
    if not np.isfinite(backdrop).all():
        raise ValueError("background must be finite")
    if backdrop.max() > MAX_COLOR:
        raise ValueError(
            f"background must be RGB from 0 to 1, got values up to {backdrop.max():g}; divide bytes by 255"
        )
    assert max(camera.width, camera.height) <= MAX_SIDE
    return structures.OptionsStruct(
        samples=int(samples),
        max_layers=0,
        threads=library.thread_count(threads),
        min_transmittance=0,
        background=keep(backdrop),
        background_per_pixel=backdrop.ndim == 3,
        cutoff=-1,
    )


def compact_groups(depth_group: np.ndarray | None) -> np.ndarray | None:
    """The same groups, indexed without gaps, so that tables over them are no larger than the mesh."""
    if depth_group is None or not len(depth_group) or depth_group.max() < len(depth_group):
        return depth_group
    values, indices = np.unique(depth_group, return_inverse=True)
    shift = int(values[0] == -1)
    return np.ascontiguousarray(indices.reshape(-1) - shift, np.int32)
