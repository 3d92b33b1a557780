"""Textured surfaces for the viewer: triangles, texture coordinates and the image of the texture.

The triangles are those of any mesh (``packing``); the texture is the file that it would be beside a mesh. Its
normal map is left out: the page has no lights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshsplats.formats.surfaces.corners import check_texture, corners_of, plain_mesh, texture_file
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewer.packing import vertex_order
from meshsplats.viewer.quantise import QuantisedMesh, quantise_mesh
from meshsplats.viewer.streams import Packer

STEPS = 1 << 16
"""Steps of texture coordinates from one side of a texture to the other."""
_TYPES = {".png": "image/png", ".jpg": "image/jpeg"}


@dataclass(frozen=True)
class PackedSurface:
    """A surface as blocks of a page."""

    shape: SplatMesh
    """Its triangles, with a vertex for each pair of a place and its texture coordinates."""
    mesh: QuantisedMesh
    coordinates: bytes | None
    """A container with the texture coordinates of the vertices in ``mesh``; None without a texture."""
    picture: bytes
    """The file of the texture; empty without one."""

    @property
    def size(self) -> int:
        """Bytes of all of it."""
        return len(self.mesh.data) + len(self.coordinates or b"") + len(self.picture)


def pack_surface(base: BaseMesh) -> PackedSurface:
    """``base``, opaque, with its texture and the tints of that, or else the colours of its vertices.

    Raises ValueError for a mesh without triangles, and for one that is not textured as surfaces are: with one
    texture on all faces, or none.
    """
    check_texture(base)
    if not base.textured:
        plain = plain_mesh(base)
        colors = plain.colors.copy()
        colors[:, 3] = 1
        plain = replace(plain, colors=colors, normals=None)
        return PackedSurface(plain, quantise_mesh(plain), None, b"")
    corners = corners_of(replace(base, normal_map=None))
    assert corners.uv is not None
    colors = np.ones((len(corners.vertices), 4), np.float32)
    if corners.tints is not None:
        colors[:, :3] = linear_to_srgb(corners.tints[:, :3])
    shape = SplatMesh(corners.vertices, corners.faces, colors, up=base.up, origin=base.origin)
    packer, texture = Packer(), base.textures[0]
    suffix, picture = texture_file(base)
    header = {
        "kind": "coordinates",
        "row": packer.add_rows(np.rint(corners.uv[vertex_order(shape)] * float(STEPS)).astype(np.int64)),
        "steps": STEPS,
        "wrap": texture.wrap,
        "type": _TYPES[suffix],
    }
    return PackedSurface(shape, quantise_mesh(shape), packer.finish(header), picture)
