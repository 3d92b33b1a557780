"""Writes splats as binary glTF 2.0 with KHR_gaussian_splatting, ratified in 2026: a primitive of points.

Specification: KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting. Attributes are float and
activated, in the axes that other writers of splats use: x left, y up, z forward. A node turns the cloud's
``up`` to +y and puts it at its ``origin``; the mesh's ``extras.meshsplats`` name both, too. COLOR_0 is for
viewers that know points only. What compresses splats in glTF (SPZ) is a draft, which only tiles use
(``splat_tiles.py``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.geometry import rotation_rows
from meshsplats.formats._orientation import HALF_TURN_Z
from meshsplats.formats.gltf.binary_chunk import BinaryChunk, write_binary
from meshsplats.formats.gltf.splats import EXTENSION, turn_of
from meshsplats.formats.splats._quantising import as_bytes
from meshsplats.formats.writing import FormatWriter, Writing
from meshsplats.scene.colors import srgb_to_linear
from meshsplats.scene.gaussians import GaussianCloud


def write_splat_glb(cloud: GaussianCloud, path: Path, writing: Writing) -> None:
    """Writes ``cloud``; see ``save_gaussians``. ValueError for more than the 4 GiB that a file can hold."""
    document, chunk = splats_part(cloud)
    advice = ": write .ply, or .sog, which is a twentieth of it"
    write_binary(path, document, chunk, what=f"{writing.where}: the splats", advice=advice)


def splats_part(cloud: GaussianCloud, *, beside_meshes: bool = False) -> tuple[dict[str, Any], BinaryChunk]:
    """The document of ``cloud`` and its chunk. ``beside_meshes``: its node turns it to where our writer of
    meshes puts those of the same world, whose axes have no half turn about the vertical."""
    turned = cloud.transformed(HALF_TURN_Z)
    chunk, attributes = BinaryChunk(), {}
    for name, array in _attributes(turned).items():
        attributes[name] = chunk.positions(array) if name == "POSITION" else chunk.attribute(array)
    kind = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    kind |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: kind}}
    nodes = [{"name": "splats", "mesh": 0, **_place(cloud, beside_meshes)}]
    meshes = [{"name": "splats", "primitives": [primitive], **_note(cloud, beside_meshes)}]
    return chunk.document(nodes, meshes, extensions={"extensionsUsed": [EXTENSION]}), chunk


def _attributes(cloud: GaussianCloud) -> dict[str, np.ndarray]:
    """By their names in the file, of ``cloud`` in its axes."""
    colors = np.concatenate([srgb_to_linear(cloud.colors), cloud.opacities[:, None]], axis=1)
    found = {
        "POSITION": cloud.means,
        "COLOR_0": as_bytes(colors * 255),
        f"{EXTENSION}:ROTATION": cloud.quaternions[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": cloud.scales,
        f"{EXTENSION}:OPACITY": cloud.opacities,
    }
    for degree in range(cloud.sh_degree + 1):
        for i in range(2 * degree + 1):
            found[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}"] = cloud.sh[:, degree * degree + i]
    return found


def _place(cloud: GaussianCloud, beside_meshes: bool) -> dict[str, Any]:
    """Of the node."""
    x, y, z, w = turn_of(cloud.up, beside_meshes=beside_meshes)
    place = {} if w == 1 else {"rotation": [x, y, z, w]}
    if cloud.origin.any():
        turn = np.array(list(rotation_rows(w, x, y, z))) @ HALF_TURN_Z
        place["translation"] = (turn @ cloud.origin + 0.0).tolist()
    return place


def _note(cloud: GaussianCloud, beside_meshes: bool) -> dict[str, Any]:
    """What only this project reads of a mesh."""
    note: dict[str, Any] = {"version": 1} | ({"besideMeshes": True} if beside_meshes else {})
    if cloud.up is not None:
        note["up"] = cloud.up.astype(np.float64).tolist()
    if cloud.origin.any():
        note["origin"] = cloud.origin.tolist()
    if cloud.kernel != "3dgs":
        note["kernel"] = cloud.kernel
    return {"extras": {"meshsplats": note}} if len(note) > 1 else {}


def _bytes_a_splat(coefficients: int) -> float:
    return 48 + 12 * coefficients


WRITER = FormatWriter(write_splat_glb, _bytes_a_splat)
