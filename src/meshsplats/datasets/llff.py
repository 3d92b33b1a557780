"""LLFF's ``poses_bounds.npy``: cameras of images that it does not name.

A row has 17 numbers: a 3 x 5 matrix, row by row, and the depths of the nearest and farthest content. The
first four columns are camera to world, with the axes down, right and back; the last is height, width and
focal length of the images in pixels. Specification: github.com/Fyusion/LLFF, "Using your own poses"; NeRF's
load_llff.py turns the axes to right, up and back.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshsplats._common.choices import MAX_SIDE
from meshsplats.datasets.image_files import Frame, ImageIndex
from meshsplats.datasets.lens import Lens
from meshsplats.errors import FileFormatError
from meshsplats.formats.npz import read_npy_header
from meshsplats.scene.camera import MAX_SKEW

MAX_BYTES = 32 << 20
"""Longer files are refused."""
NEAR_SHARE = 0.5
"""Share of the nearest content's depth at which the near plane lies: the bound leaves out a thousandth of the
content, which is nearer."""


def read_poses_bounds(path: Path, images: str) -> list[Frame]:
    """A frame for each row of ``path``, in the order of the names of the images in the folder ``images``
    beside it, or in its own if that is empty. FileFormatError if they are not as many, or it is broken."""
    rows = _rows(path)
    names = ImageIndex(path.parent / images).images()
    if len(names) != len(rows):
        place = f"{images}/" if images else "the folder"
        raise FileFormatError(
            f"{path}: has the cameras of {len(rows)} images, in the order of their names, but {place} holds"
            f" {len(names)}, and which belongs to which is not in the file: it must hold all and no others"
        )
    prefix = f"{images}/" if images else ""
    return [
        _frame(row, name, prefix + name, f"{path}: row {i}")
        for i, (row, name) in enumerate(zip(rows, names, strict=True))
    ]


def _rows(path: Path) -> np.ndarray:
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise FileFormatError(f"{path}: larger than {MAX_BYTES >> 20} MiB, the limit for such a file")
    with open(path, "rb") as file:
        shape, dtype, fortran, start = read_npy_header(file, path.name, f"{path}: the array")
        if len(shape) != 2 or shape[1] != 17:
            raise FileFormatError(
                f"{path}: must hold rows of 17 numbers, one for each image; its shape is {shape}"
            )
        if start + dtype.itemsize * 17 * shape[0] != size:
            raise FileFormatError(f"{path}: {shape[0]} rows do not fit its {size:,} bytes (truncated?)")
        values = np.frombuffer(file.read(), dtype)
    rows = values.reshape(shape, order="F" if fortran else "C").astype(np.float64)
    if not np.isfinite(rows).all():
        raise FileFormatError(f"{path}: has values that are not finite")
    return rows


def _frame(row: np.ndarray, name: str, file: str, where: str) -> Frame:
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4]
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE and focal > 0):
        raise FileFormatError(
            f"{where}: an image of {width:g} x {height:g} pixels with a focal length of {focal:g}; sides go"
            f" from 1 to {MAX_SIDE}"
        )
    down, right, back = matrix[:, :3].T
    axes = np.stack([right, down, -back])  # OpenCV's in the world, row by row
    if np.abs(axes @ axes.T - np.eye(3)).max() > MAX_SKEW or np.linalg.det(axes) < 0:
        raise FileFormatError(f"{where}: its axes down, right and back are not those of a camera")
    left, _, across = np.linalg.svd(axes)
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = left @ across
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ matrix[:, 3]
    w, h = round(width), round(height)
    near = NEAR_SHARE * float(row[15]) if row[15] > 0 else None
    lens = Lens("PINHOLE", float(focal), float(focal), w / 2, h / 2, w, h)
    return Frame(name, file, lens, world_to_camera, near=near)
