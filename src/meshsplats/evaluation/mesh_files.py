"""Meshes as files for other programs: cut, with normals for light, in the alpha mode that suits viewers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from meshsplats.camera import Camera
from meshsplats.conversion.normals import shading_normals
from meshsplats.draw_order import DrawOrder
from meshsplats.evaluation.viewers import AlphaChoice, choose_alpha
from meshsplats.formats.cutting import CUTOFF, cut_mesh
from meshsplats.formats.mesh_formats import takes
from meshsplats.formats.meshes import save_mesh
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.ordering import NODES, drawing_order

GLB_ALPHA = ("mask", "hybrid", "ordered")
"""Values of ``alpha`` that only .glb files have."""


@dataclass(frozen=True)
class MeshFileOptions:
    """How a mesh is saved, in one or several formats. What a format does not have does not count there."""

    alpha: Literal["auto", "blend", "mask", "opaque", "hybrid", "ordered"] = "auto"
    """'auto': for a .glb, measured (``choose_alpha``); 'opaque': cut to solid triangles before; 'ordered': in
    an order of blending for viewers that cull (``drawing_order``)."""
    cutoff: float | None = None
    """Least opacity that is drawn, of 'mask' and 'opaque'; None: ``CUTOFF``."""
    lit: bool = False
    """.glb, .usd: a material that takes light."""
    smooth: bool = False
    """Normals of the surface that the splats form."""
    color_type: Literal["uint16", "float32"] = "uint16"
    """.glb."""
    compression: Literal["none", "meshopt"] = "none"
    """.glb."""
    nodes: int | Literal["auto"] = NODES
    """Of 'ordered'."""
    quick: bool = False
    """Of 'ordered': an order by a formula."""

    def prepared(self, mesh: SplatMesh, cameras: Sequence[Camera] = ()) -> SplatMesh:
        """``mesh`` cut and with normals, where that is asked for. ``cameras``: where it is seen from."""
        if self.alpha == "opaque":
            mesh = cut_mesh(mesh, CUTOFF if self.cutoff is None else self.cutoff)
        return replace(mesh, normals=shading_normals(mesh, cameras)) if self.smooth else mesh

    def choice(
        self, mesh: SplatMesh, paths: Sequence[Path], cameras: Sequence[Camera] = ()
    ) -> AlphaChoice | None:
        """The alpha mode of the .glb among ``paths``, where it is left to the measurement."""
        measured = self.alpha == "auto" and len(mesh.faces) and any(takes(path, "alpha") for path in paths)
        return choose_alpha(mesh, cameras) if measured else None

    def order(
        self, mesh: SplatMesh, paths: Sequence[Path], cameras: Sequence[Camera] = ()
    ) -> DrawOrder | None:
        """The order of blending of the .glb among ``paths``, where it is to have one."""
        if self.alpha != "ordered" or not any(takes(path, "alpha") for path in paths):
            return None
        return drawing_order(mesh, cameras or None, nodes=self.nodes, quick=self.quick)

    def save(
        self,
        mesh: SplatMesh,
        paths: Sequence[Path],
        choice: AlphaChoice | None = None,
        order: DrawOrder | None = None,
    ) -> None:
        """Saves a ``prepared`` mesh with the alpha mode of the ``choice``, or in an ``order``."""
        own: dict[str, Any] = {"order": order}
        if order is None:
            own = {
                "alpha": self.alpha if self.alpha in GLB_ALPHA else None,  # or cut already
                "cutoff": self.cutoff if self.alpha == "mask" else None,
            }
        compression = None if self.compression == "none" else self.compression
        asked = {"color_type": self.color_type, "compression": compression, "lit": self.lit}
        for path in paths:
            more: dict[str, Any] = {name: value for name, value in asked.items() if takes(path, name)}
            if takes(path, "alpha"):
                more |= own if choice is None else choice.options
            save_mesh(mesh, path, **more)
