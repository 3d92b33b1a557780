"""``meshsplats surface``: an ordinary, textured mesh of the surface that splats form."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from meshsplats._common.words import command_line
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, Flat, as_cli_options
from meshsplats.cli.common import SplatOptions, size_of, written
from meshsplats.cli.messages import say
from meshsplats.cli.progress import progress_display
from meshsplats.cli.records import write_configuration
from meshsplats.formats.base_meshes import PRINTED
from meshsplats.scene.mesh import SplatMesh
from meshsplats.surfaces.files import SurfaceFileOptions, SurfaceRun
from meshsplats.surfaces.options import SurfaceOptions, default_in_words


@as_cli_options(defaults=default_in_words)
class Options(SurfaceOptions):
    """What is made, and how."""


@as_cli_options(presets=False)
class FileArguments(SurfaceFileOptions):
    surface: Options


@dataclass(frozen=True)
class Surface(Command):
    """Makes a textured mesh of few triangles of the surface that splats form: connected, opaque, to light,
    edit, walk on or print, or as the base of a mesh prior.

    Writes a preview and the configuration beside it.
    """

    EXCLUSIVE = (("cameras", "data"),)
    CONFIGURABLE = True

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, or a mesh of splats."""
    output: option.Output
    """The mesh, opaque: .glb, .usdz with the texture inside; .obj, .ply, .usdc with the texture beside; .npz
    without; .stl, .3mf for printing."""
    files: Annotated[FileArguments, Flat] = field(default_factory=FileArguments)
    reading: SplatOptions = field(default_factory=SplatOptions)
    threads: option.Threads = None
    origin: option.Origin = "keep"
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        start = time.perf_counter()
        run = SurfaceRun(
            self.input,
            self.output,
            self.files,
            self.reading,
            self.threads,
            place=partial(written, origin=self.origin),
            record=lambda path: write_configuration(path, "surface", self),
            say=say,
        )
        run.check(self.force)
        with progress_display() as show:
            scene, made = run.save(
                force=self.force, progress=lambda name, done, total: show.phase(name, done / total)
            )
        seconds, lines = time.perf_counter() - start, []
        rows = run.rows(made)
        for path, base in made:
            look = f"{len(base.textures[0].pixels)} texels, " if base.textures else "vertex colours, "
            look = "" if path.suffix.lower() in PRINTED else look
            lines.append(f"{path} ({len(base.faces):,} triangles, {look}{size_of(path)})")
        lines += [f"in {seconds:.1f} s", *([] if self.files.no_preview else [f"preview: {run.preview}"])]
        in_place = self.files.scale is None and self.origin == "keep"
        if in_place and self.output.suffix.lower() not in (*PRINTED, ".usdz"):
            splats = ["--splats", str(self.input), *self.reading.again()]
            words = ["--data", "photos/"] if isinstance(scene, SplatMesh) else splats
            words = ["meshsplats", "prior", str(self.output), *words, "-o", "prior.npz"]
            lines.append(f"next: {command_line(words)}")
        self.finish(rows[0] | {"levels": rows[1:], "seconds": round(seconds, 2)}, *lines)

    def resolved(self) -> dict[str, Any]:
        return asdict(self.files.checked(self.output))
