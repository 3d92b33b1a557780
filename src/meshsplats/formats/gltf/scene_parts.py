"""Which meshes of a glTF scene are read as triangles, where it holds splats and colliders, too."""

from __future__ import annotations

import warnings
from typing import Any

from meshsplats.errors import DataWarning
from meshsplats.formats.gltf.document import GltfDocument
from meshsplats.formats.gltf.scene import Placed, placed_meshes

COLLIDES = {"meshsplats": {"version": 1, "collider": True}}
"""Extras of the mesh of a collider, which our readers leave out."""
INVISIBLE = {
    "name": "invisible",
    "alphaMode": "MASK",
    "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0]},
}
"""Material of what no viewer draws: nothing of it passes the alpha test."""


def shown_meshes(document: GltfDocument) -> list[Placed]:
    """The meshes of a scene without our colliders, and without splats where there is more. A
    DataWarning names the splats."""
    placed = [place for place in placed_meshes(document) if not _is_collider(place.mesh)]
    others = [place for place in placed if not _holds_splats(place.mesh)]
    if others and len(others) < len(placed):
        warnings.warn(
            f"{document.path}: splats are left out: load_gaussians reads them", DataWarning, stacklevel=4
        )
    return others or placed


def is_splats(primitive: dict[str, Any]) -> bool:
    """Whether a primitive has an extension of splats."""
    extensions = primitive.get("extensions")
    return isinstance(extensions, dict) and any("gaussian_splatting" in name for name in extensions)


def _is_collider(mesh: dict[str, Any]) -> bool:
    extras = mesh.get("extras")
    note = extras.get("meshsplats") if isinstance(extras, dict) else None
    return isinstance(note, dict) and note.get("collider") is True


def _holds_splats(mesh: dict[str, Any]) -> bool:
    primitives = mesh.get("primitives")
    listed = primitives if isinstance(primitives, list) else []
    return bool(listed) and all(isinstance(p, dict) and is_splats(p) for p in listed)
