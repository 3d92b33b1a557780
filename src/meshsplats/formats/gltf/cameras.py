"""Cameras of glTF files with splats, which viewers of splats and modelling programs set."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.camera import OPENGL, Camera
from meshsplats.choices import MAX_SIDE
from meshsplats.formats._orientation import HALF_TURN_Z
from meshsplats.formats.gltf.document import GltfDocument, dict_or_empty
from meshsplats.formats.gltf.scene import placed_nodes
from meshsplats.formats.gltf.splats import has_own_frame, names_splats, splat_document

_SIDE = 800
"""Height of the images, pixels; the file names only their shape."""


def cameras_in_gltf(path: Path) -> list[Camera]:
    """The perspective cameras of the scene of a glTF file with splats, in the world of ``load_gaussians``, in
    the order of their nodes; none of a file without splats, nor of our own files that note another frame.

    glTF 2.0, 3.10: cameras look along -z of their node, y points up, and ``yfov`` is the angle in radians
    from the lower edge of the image to the upper one.

    Raises FileFormatError for a broken file.
    """
    document = splat_document(path)
    if not names_splats(document) or has_own_frame(document):
        return []
    found = []
    for node, matrix in placed_nodes(document):
        if "camera" not in node:
            continue
        kind = document.item("cameras", node["camera"], "a node")
        if kind.get("type") == "perspective":
            lens = dict_or_empty(kind.get("perspective"))
            found.append(_camera(document, lens, matrix, str(node.get("name", kind.get("name", "")))[:100]))
    return found


def _camera(document: GltfDocument, lens: dict[str, Any], matrix: np.ndarray, name: str) -> Camera:
    (angle,) = document.numbers([lens.get("yfov")], 1, "yfov of a camera")
    (shape,) = document.numbers([lens.get("aspectRatio", 1.0)], 1, "aspectRatio of a camera")
    if not 0.01 < angle < 3.1 or not 1 / 16 <= shape <= 16:
        raise document.error(
            "a camera needs a yfov of 0.01 to 3.1 radians and an aspectRatio of 1/16 to 16, got"
            f" {angle:g} and {shape:g}"
        )
    left, size, right = np.linalg.svd(matrix[:3, :3])
    axes = left @ right
    if size.min() <= 0 or np.linalg.det(axes) < 0:
        raise document.error("the node of a camera mirrors it, or has no size")
    rotation = (HALF_TURN_Z @ axes * OPENGL).T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ HALF_TURN_Z @ matrix[:3, 3]
    width = min(round(_SIDE * shape), MAX_SIDE)
    focal = _SIDE / 2 / np.tan(angle / 2)
    return Camera(pose, focal, focal, width / 2, _SIDE / 2, width, _SIDE, name=name)
