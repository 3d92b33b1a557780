"""Tiles of splats as CesiumJS streams them: GLB with KHR_gaussian_splatting whose splats are SPZ.

The extension of SPZ, KHR_gaussian_splatting_compression_spz_2, is a draft. What is written here is what
CesiumJS 1.145 reads, and Cesium ion writes: SPZ in the axes of the glTF file, the names of the attributes
without data, one node with a matrix, and none of the properties that KHR_gaussian_splatting as ratified
asks for; a file that has them holds SPZ in its own axes (``splats.py``). Draft:
https://github.com/KhronosGroup/glTF/pull/2531.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._files.atomic import atomic_path
from meshsplats.formats._orientation import HALF_TURN_X, up_rotation
from meshsplats.formats.gltf.binary_chunk import BinaryChunk, write_binary
from meshsplats.formats.gltf.splats import EXTENSION
from meshsplats.formats.splats.spz_writer import spz_bytes
from meshsplats.scene.gaussians import GaussianCloud

SPZ = "KHR_gaussian_splatting_compression_spz_2"
CONTENT = {
    "extensionsUsed": ["3DTILES_content_gltf"],
    "extensions": {
        "3DTILES_content_gltf": {"extensionsUsed": [EXTENSION, SPZ], "extensionsRequired": [EXTENSION, SPZ]}
    },
}
"""What a tileset file says of such tiles, for viewers that choose by it what draws them."""
_FLOAT, _UINT8 = 5126, 5121


def write_splat_tile(cloud: GaussianCloud, path: Path, up: np.ndarray) -> None:
    """Writes ``cloud``, whose positions lie around its own middle for fine steps, as a GLB file in which
    ``up`` (3,) is +y, whole or not at all."""
    middle = (cloud.means.min(axis=0).astype(np.float64) + cloud.means.max(axis=0)) / 2
    # SPZ has the axes of HALF_TURN_X, which the node takes back.
    near = replace(cloud, means=(cloud.means - middle).astype(np.float32), up=None)
    chunk = BinaryChunk()
    view = chunk.view(np.frombuffer(spz_bytes(near, path), np.uint8))
    matrix = np.eye(4)
    matrix[:3, :3] = up_rotation(up) @ HALF_TURN_X
    matrix[:3, 3] = up_rotation(up) @ middle
    stored = near.means.astype(np.float64) @ HALF_TURN_X
    accessors: list[dict[str, Any]] = [
        {"min": stored.min(axis=0).tolist(), "max": stored.max(axis=0).tolist(), **_floats(3)},
        {"componentType": _UINT8, "normalized": True, "type": "VEC4"},
        _floats(3),
        _floats(4),
    ]
    names = ["POSITION", "COLOR_0", f"{EXTENSION}:SCALE", f"{EXTENSION}:ROTATION"]
    for degree in range(1, cloud.sh_degree + 1):
        names += [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}" for i in range(2 * degree + 1)]
    accessors += [_floats(3) for _ in names[4:]]
    primitive = {
        "attributes": {name: i for i, name in enumerate(names)},
        "mode": 0,
        "extensions": {EXTENSION: {"extensions": {SPZ: {"bufferView": view}}}},
    }
    chunk.accessors = [{"count": len(cloud), **accessor} for accessor in accessors]
    nodes = [{"mesh": 0, "matrix": (matrix.T.ravel() + 0.0).tolist()}]
    extensions = {"extensionsUsed": [EXTENSION, SPZ], "extensionsRequired": [EXTENSION, SPZ]}
    document = chunk.document(nodes, [{"primitives": [primitive]}], extensions=extensions)
    with atomic_path(path, needs=chunk.length) as temporary:
        write_binary(temporary, document, chunk, what=f"{path}: the splats", advice="")


def _floats(columns: int) -> dict[str, Any]:
    return {"componentType": _FLOAT, "type": f"VEC{columns}"}
