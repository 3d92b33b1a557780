"""Cameras of glTF files, which viewers of splats and modelling programs set, and our surfaces of places."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.formats._file_cameras import near_plane, placed_camera
from meshsplats.formats._orientation import HALF_TURN_Z, up_quaternion
from meshsplats.formats.gltf.document import GltfDocument, dict_or_empty
from meshsplats.formats.gltf.own import grid_of, is_own_placement, our_note
from meshsplats.formats.gltf.scene import placed_meshes, placed_nodes, rotation_matrix
from meshsplats.formats.gltf.splats import has_own_frame, names_splats, splat_document
from meshsplats.scene.camera import Camera, to_opengl


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
    turned = np.eye(4)
    turned[:3, :3] = HALF_TURN_Z
    return _cameras(document, turned)


def cameras_in_mesh(path: Path) -> list[Camera]:
    """The perspective cameras of the scene of a glTF file with a mesh, in the world of ``load_mesh``, in the
    order of their nodes. Raises FileFormatError for a broken file."""
    document = GltfDocument(path)
    to_mesh = np.eye(4)  # the node of a mesh of ours has turned it, and its place in the world with it
    first = next(iter(placed_meshes(document)), None)
    note = {} if first is None else our_note(first.mesh)
    if first is not None and note and is_own_placement(first.matrix, note, grid_of(document, note)):
        to_mesh[:3, :3] = rotation_matrix(up_quaternion(np.array(note["up"], np.float64))).T[:3, :3]
    return _cameras(document, to_mesh)


def _cameras(document: GltfDocument, frame: np.ndarray) -> list[Camera]:
    """The perspective cameras of the scene, in a frame to which (4, 4) ``frame`` moves it."""
    found = []
    for node, matrix in placed_nodes(document):
        if "camera" not in node:
            continue
        kind = document.item("cameras", node["camera"], "a node")
        if kind.get("type") == "perspective":
            lens = dict_or_empty(kind.get("perspective"))
            name = str(node.get("name", kind.get("name", "")))[:100]
            found.append(_camera(document, lens, frame @ matrix, name))
    return found


def camera_node(camera: Camera, number: int) -> dict[str, Any]:
    """The node of the camera ``number`` of a file, at the place of ``camera`` in the frame of its parent."""
    pose = to_opengl(camera.world_to_camera)
    return {"name": camera.name or f"view {number + 1}", "camera": number, "matrix": pose.T.ravel().tolist()}


def lens_of(camera: Camera, points: np.ndarray) -> dict[str, Any]:
    """The camera of a file with the angle of ``camera``; its near plane, or one that is small beside the
    extent of the ``points`` (n, 3) of the scene."""
    lens = {
        "yfov": 2 * float(np.arctan(camera.height / (2 * camera.fy))),
        "aspectRatio": camera.width * camera.fy / (camera.height * camera.fx),
        "znear": near_plane(camera, points),
    }
    return {"type": "perspective", "perspective": lens}


def _camera(document: GltfDocument, lens: dict[str, Any], matrix: np.ndarray, name: str) -> Camera:
    (angle,) = document.numbers([lens.get("yfov")], 1, "yfov of a camera")
    (shape,) = document.numbers([lens.get("aspectRatio", 1.0)], 1, "aspectRatio of a camera")
    try:
        return placed_camera(matrix, angle, shape, name)
    except ValueError as error:
        raise document.error(str(error)) from None
