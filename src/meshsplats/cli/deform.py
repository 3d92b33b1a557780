"""``meshsplats deform``: the splats of a mesh prior moved to an edited base."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from meshsplats._common.words import plural
from meshsplats.cli import option
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import say_origin, size_of, track
from meshsplats.cli.messages import UsageError

if TYPE_CHECKING:
    from meshsplats.scene.mesh import SplatMesh


@dataclass(frozen=True)
class Deform(Command):
    """Moves splats with the mesh that they are bound to; nothing is trained.

    Several bases, such as the frames of an animation, give a file each, as do the time samples of a USD file.
    """

    input: tyro.conf.Positional[Path]
    """The result of 'meshsplats prior': .npz or .glb."""
    base: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE...")]
    """The edited base: the same vertices, moved; or several, such as frames, for a file each."""
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
        from meshsplats.formats.outputs import placed
        from meshsplats.prior.planning import by_number, save_poses

        start, bases = time.perf_counter(), by_number(self.base)
        if not self.base:
            raise UsageError("give the edited base with --base")
        triangles = 0

        def place(mesh: SplatMesh) -> SplatMesh:
            nonlocal triangles
            if not triangles:
                say_origin(mesh.origin, self.origin)
            triangles = len(mesh.faces)
            return placed(mesh, self.origin)

        how: dict[str, Any] = {"lift": self.lift, "place": place, "force": self.force}
        shown = partial(track, label="moving")
        bases_of = save_poses(self.input, bases, self.output, progress=shown, **how)
        seconds = time.perf_counter() - start
        files = list(bases_of)
        more = f" to {files[-1]}" if len(files) > 1 else ""
        made = f"{files[0]}{more} ({plural(triangles, 'triangle')}, {size_of(files[0])}):"
        names = {"files": list(map(str, files)), "bases": list(map(str, bases_of.values()))}
        self.finish(
            names | {"triangles": triangles, "seconds": round(seconds, 3)},
            f"{made} {plural(len(files), 'pose')} in {seconds:.2f} s",
            indent=None,
        )
