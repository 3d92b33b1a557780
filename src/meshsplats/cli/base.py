"""``meshsplats base``: a classical mesh from splats, for a mesh prior."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from meshsplats.cli.arguments import Command
from meshsplats.cli.common import (
    Count,
    File,
    Origin,
    Output,
    SplatOptions,
    check_mesh_suffix,
    load_scene,
    size_of,
    written,
)
from meshsplats.cli.messages import UsageError, command_line
from meshsplats.formats.outputs import check_outputs
from meshsplats.mesh import SplatMesh


@dataclass(frozen=True)
class Base(Command):
    """Makes a closed mesh of the surface that splats form, to be edited and to carry a mesh prior.

    For objects that can be seen from all sides; space that no image sees becomes interior.
    """

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, or a mesh of splats."""
    output: Output
    """The mesh, coloured and opaque: .ply, .obj, .glb, .npz, .usdc."""
    resolution: int = 96
    """Voxels along the longest side, 8 to 512."""
    faces: int = 20_000
    """Approximate number of triangles, if the voxels give more; 0: all."""
    views: int = 48
    """Number of cameras around the object."""
    cameras: File = None
    """Camera file, in place of --views."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    threads: Count = None
    """Maximum number of threads. Default: all processors."""
    origin: Origin = "keep"
    json: bool = False
    """Print the result as JSON."""
    force: bool = False
    """Overwrite existing outputs."""

    def execute(self) -> None:
        from meshsplats.cameras.files import load_cameras
        from meshsplats.formats.meshes import save_mesh
        from meshsplats.prior.surface import base_surface

        start = time.perf_counter()
        check_mesh_suffix(self.output)
        if self.cameras is not None and self.views != type(self).views:
            raise UsageError("--views has no effect with --cameras")
        check_outputs([self.output], self.force, inputs=[self.input])
        scene, given = load_scene(self.input, self.reading), self.cameras
        base = base_surface(
            scene,
            resolution=self.resolution,
            faces=self.faces,
            cameras=self.views if given is None else load_cameras(given, origin=scene.origin),
            threads=self.threads,
        )
        assert base.colors is not None
        mesh = SplatMesh(base.vertices, base.faces, base.colors, up=base.up, origin=base.origin)
        save_mesh(written(mesh, self.origin), self.output)
        seconds = time.perf_counter() - start
        if self.json:
            result = {"mesh": str(self.output), "triangles": len(base.faces), "seconds": round(seconds, 2)}
            print(json.dumps(result, indent=1))
            return
        print(f"{self.output} ({len(base.faces):,} triangles, {size_of(self.output)}) in {seconds:.1f} s")
        splats = ["--splats", str(self.input), *self.reading.again()]
        source = ["--data", "photos/"] if isinstance(scene, SplatMesh) else splats
        print(f"next: {command_line(['meshsplats', 'prior', self.output, *source, '-o', 'prior.npz'])}")
