"""Meshes as files for other programs: cut, with normals for light, in the alpha mode that suits viewers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from meshsplats._common.options import Advanced, check_options
from meshsplats.errors import OptionsError
from meshsplats.formats.mesh_formats import takes

if TYPE_CHECKING:
    from typing_extensions import Self

    from meshsplats.evaluation.viewers import AlphaChoice
    from meshsplats.scene.camera import Camera
    from meshsplats.scene.draw_order import DrawOrder
    from meshsplats.scene.mesh import SplatMesh

GLB_ALPHA = ("mask", "hybrid", "ordered")
"""Values of ``alpha`` that only .glb files have."""


@dataclass(frozen=True)
class MeshFileOptions:
    """How a mesh is saved, in one or several formats. What a format does not have does not count there."""

    lit: bool = False
    """.glb, .usd: a material that takes light and shadow, not one that shows the colours as they are."""
    smooth: bool = False
    """With ``lit``: normals of the surface that the splats form, in place of the triangles' own, which look
    mottled under light."""
    color_type: Annotated[Literal["uint16", "float32"], Advanced] = "uint16"
    """.glb: storage of colours."""
    alpha: Literal["auto", "blend", "mask", "opaque", "hybrid", "ordered"] = "auto"
    """auto: for .glb, blend or mask, whichever is nearer to the sorted image in viewers that do not sort, by
    a few images of both; else blend. blend: the viewer blends true opacities; mask (.glb): it draws as solid
    what has at least ``cutoff``; opaque: solid triangles, cut there; hybrid (.glb), for a mesh of finetune
    with soft_share: solid and blended triangles apart; ordered (.glb), for web viewers and engines alone:
    every triangle twice, for either side, in an order of blending that suits views from all around."""
    nodes: Annotated[int | Literal["auto"] | None, Advanced] = None
    """``alpha`` ordered: parts that viewers sort, each a draw call; auto: few, if they do. Default: 8."""
    quick: Annotated[bool, Advanced] = False
    """``alpha`` ordered: an order by a formula, in a second, and several dB worse."""
    cutoff: Annotated[float | None, Advanced] = None
    """``alpha`` opaque, mask: least opacity that is drawn, 0 to 1. Default: 0.2."""
    compression: Literal["none", "meshopt"] = "none"
    """.glb: meshopt: a quarter to a third of the size, for viewers that can unpack it."""

    def check(self, kinds: Sequence[str]) -> None:
        """Checks options before the work. ``kinds``: suffixes of the files, without a dot.

        Raises:
            OptionsError: options contradict each other or have no effect.
            ValueError: one is out of range.
        """
        from meshsplats.rendering.ordering import check_nodes
        from meshsplats.scene.mesh import checked_cutoff

        check_options(self)
        names = [f"mesh.{kind}" for kind in kinds]
        if self.lit and not any(takes(name, "lit") for name in names):
            raise OptionsError(f"``lit`` is for .glb and .usd files: .{kinds[0]} has no material")
        if self.smooth and not self.lit:
            raise OptionsError("``smooth`` has no effect without ``lit``")
        only_glb = self.color_type != "uint16" or self.alpha in GLB_ALPHA or self.compression != "none"
        if only_glb and not any(takes(name, "alpha") for name in names):
            raise OptionsError(
                "``alpha`` mask, hybrid or ordered, ``compression`` and ``color_type`` are for .glb files"
            )
        if self.cutoff is not None:
            if self.alpha not in ("opaque", "mask"):
                raise OptionsError("``cutoff`` is for ``alpha`` opaque or mask")
            checked_cutoff(self.cutoff)
        if self.alpha != "ordered" and (self.nodes is not None or self.quick):
            raise OptionsError("``nodes`` and quick are for ``alpha`` ordered")
        if self.alpha == "ordered" and (self.lit or self.compression != "none"):
            raise OptionsError("``alpha`` ordered goes with neither ``lit`` nor ``compression``")
        if self.nodes is not None:
            check_nodes(self.nodes)

    def taken_by(self, path: Path) -> Self:
        """Those that have an effect on the file ``path``; the others as by default."""
        taken = self
        if not takes(path, "alpha"):
            taken = replace(taken, color_type="uint16", compression="none")
            if self.alpha in GLB_ALPHA:
                taken = replace(taken, alpha="auto", cutoff=None, nodes=None, quick=False)
        return taken if takes(path, "lit") else replace(taken, lit=False, smooth=False)

    def prepared(
        self, mesh: SplatMesh, cameras: Sequence[Camera] = (), threads: int | None = None
    ) -> SplatMesh:
        """``mesh`` cut and with normals, where that is asked for. ``cameras``: where it is seen from."""
        from meshsplats.conversion.normals import shading_normals
        from meshsplats.formats.cutting import CUTOFF, cut_mesh

        if self.alpha == "opaque":
            mesh = cut_mesh(mesh, CUTOFF if self.cutoff is None else self.cutoff)
        if not self.smooth:
            return mesh
        return replace(mesh, normals=shading_normals(mesh, cameras, threads=threads))

    def measures(self, paths: Sequence[Path]) -> bool:
        """Whether the alpha mode of a .glb among ``paths`` is left to the measurement."""
        return self.alpha == "auto" and any(takes(path, "alpha") for path in paths)

    def orders(self, paths: Sequence[Path]) -> bool:
        """Whether a .glb among ``paths`` is to list its triangles in an order of blending."""
        return self.alpha == "ordered" and any(takes(path, "alpha") for path in paths)

    def choice(
        self,
        mesh: SplatMesh,
        paths: Sequence[Path],
        cameras: Sequence[Camera] = (),
        threads: int | None = None,
    ) -> AlphaChoice | None:
        """The alpha mode of the .glb among ``paths``, where it is left to the measurement."""
        from meshsplats.evaluation.viewers import choose_alpha

        measured = len(mesh.faces) and self.measures(paths)
        return choose_alpha(mesh, cameras, threads=threads) if measured else None

    def order(
        self,
        mesh: SplatMesh,
        paths: Sequence[Path],
        cameras: Sequence[Camera] = (),
        threads: int | None = None,
    ) -> DrawOrder | None:
        """The order of blending of the .glb among ``paths``, where it is to have one."""
        from meshsplats.rendering.ordering import NODES, drawing_order

        if not self.orders(paths):
            return None
        nodes = NODES if self.nodes is None else self.nodes
        return drawing_order(mesh, cameras or None, nodes=nodes, quick=self.quick, threads=threads)

    def save(
        self,
        mesh: SplatMesh,
        paths: Sequence[Path],
        choice: AlphaChoice | None = None,
        order: DrawOrder | None = None,
    ) -> None:
        """Saves a ``prepared`` mesh with the alpha mode of the ``choice``, or in an ``order``."""
        from meshsplats.formats.meshes import save_mesh

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
