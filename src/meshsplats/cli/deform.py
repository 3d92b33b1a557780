"""``meshsplats deform``: the splats of a mesh prior moved to an edited base."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from meshsplats.cli import option
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import plural, say_origin, size_of, track
from meshsplats.cli.messages import UsageError
from meshsplats.formats.mesh_formats import keeps
from meshsplats.formats.outputs import check_mesh_suffix, check_outputs, placed
from meshsplats.mesh import SplatMesh


@dataclass(frozen=True)
class Deform(Command):
    """Moves splats with the mesh that they are bound to; nothing is trained.

    Several bases, such as the frames of an animation, give a file each.
    """

    input: tyro.conf.Positional[Path]
    """The result of 'meshsplats prior': .npz or .glb."""
    base: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE...")]
    """The edited base, or several: the same vertices and faces in the same order, at other positions."""
    output: option.Output
    """The moved splats: .glb, .npz (both can be moved again), .ply, .usdc, .obj. With several bases, files
    are numbered: edited.glb becomes edited_0001.glb, edited_0002.glb ..."""
    lift: option.Number = None
    """Distance between layers along the normals, scene units. Default: the spacing of the prior; for coplanar
    layers 0 in .npz, and 1/50000 of the base's diagonal in other formats, whose readers do not know the order
    of coplanar layers."""
    origin: option.Origin = "keep"
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.formats.base_meshes import load_base
        from meshsplats.prior import load_prior

        start = time.perf_counter()
        check_mesh_suffix(self.output)
        if not self.base:
            raise UsageError("give the edited base with --base")
        targets = self.targets()
        check_outputs(targets, self.force, inputs=[self.input, *self.base])
        prior = load_prior(self.input)
        origin = prior.mesh.origin
        bases = [load_base(path, textures=False, origin=origin) for path in self.base]
        for path, base in zip(self.base, bases, strict=True):  # all, before anything is written
            try:
                prior.check_topology(base)
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
        lift = self.lift
        if lift is None and self.output.suffix.lower() != ".npz" and not prior.lift:
            lift = prior.export_lift
        say_origin(origin, self.origin)
        for base, target in track(list(zip(bases, targets, strict=True)), "moving", len(targets)):
            _save(placed(prior.pose(base.vertices, lift=lift), self.origin), target)
        seconds = time.perf_counter() - start
        files, count = [str(target) for target in targets], len(prior.mesh.faces)
        more = f" to {targets[-1]}" if len(targets) > 1 else ""
        made = f"{targets[0]}{more} ({plural(count, 'triangle')}, {size_of(targets[0])}):"
        self.finish(
            {"files": files, "triangles": count, "seconds": round(seconds, 3)},
            f"{made} {plural(len(targets), 'pose')} in {seconds:.2f} s",
            indent=None,
        )

    def targets(self) -> list[Path]:
        """The output for each base."""
        if len(self.base) == 1:
            return [self.output]
        width = max(4, len(str(len(self.base))))
        stem, suffix = self.output.stem, self.output.suffix
        return [self.output.with_name(f"{stem}_{i:0{width}d}{suffix}") for i in range(1, len(self.base) + 1)]


def _save(mesh: SplatMesh, target: Path) -> None:
    from meshsplats.formats.meshes import save_mesh

    # Formats without a place for the binding would warn of it.
    save_mesh(mesh if keeps(target, "binding") else replace(mesh, binding=None), target)
