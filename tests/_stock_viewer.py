"""What a viewer without a sort of its own makes of a `.glb`: written from the file alone, in float64."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from _glb import read_glb
from _zbuffer import _fragments, _pixels

from meshsplats import Camera, SplatMesh
from meshsplats.scene.colors import linear_to_srgb

TYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
COLUMNS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def stock_image(path: Path, view: Camera, *, samples: int = 1) -> np.ndarray:
    """Colour (h, w, 3) on white. Meshes are sorted by the depths of the middles of their bounds, farthest
    first; their triangles are blended as they are listed, those that face away left out. Nodes are taken
    where the mesh's own frame has them."""
    document, binary = read_glb(path)
    assert all(not m.get("doubleSided") and m["alphaMode"] == "BLEND" for m in document["materials"])

    def array(index: int) -> np.ndarray:
        accessor = document["accessors"][index]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        columns = COLUMNS[accessor["type"]]
        values = np.frombuffer(
            binary, TYPES[accessor["componentType"]], accessor["count"] * columns, start
        ).reshape(-1, columns)
        return values / 65535 if accessor.get("normalized") else values

    parts = []
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            bounds = document["accessors"][attributes["POSITION"]]
            middle = (np.array(bounds["min"]) + np.array(bounds["max"])) / 2
            colors = array(attributes["COLOR_0"]).astype(np.float64)
            colors[:, :3] = linear_to_srgb(colors[:, :3])
            faces = array(primitive["indices"]).reshape(-1, 3).astype(np.int64)
            parts.append((middle, array(attributes["POSITION"]), faces, colors))
    rotation, shift = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3]
    image = np.ones((view.height * samples, view.width * samples, 3))
    for _, points, faces, colors in sorted(parts, key=lambda part: -(rotation @ part[0] + shift)[2]):
        corners = (points.astype(np.float64) @ rotation.T + shift)[faces]
        # Counter-clockwise from in front; the axes of images make that a negative volume with the eye.
        facing = np.linalg.det(corners) < 0
        listed = SplatMesh(points, faces[facing], np.clip(colors, 0, 1))
        for rows, columns, inside, _, rgba in _fragments(listed, view, samples):
            window, alpha = image[rows, columns], rgba[inside][:, 3:]
            window[inside] += alpha * (rgba[inside][:, :3] - window[inside])
    return _pixels(image, samples)
