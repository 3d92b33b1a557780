"""``meshsplats surface``: an ordinary, textured mesh of the surface that splats form."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from meshsplats._files.atomic import together
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, as_cli_options
from meshsplats.cli.common import SplatOptions, size_of, written
from meshsplats.cli.messages import UsageError, command_line, say
from meshsplats.cli.progress import progress_display
from meshsplats.cli.records import write_configuration
from meshsplats.datasets.scene_views import check_photographs
from meshsplats.formats import base_meshes as files
from meshsplats.formats.outputs import CONFIGURATION, PREVIEW, beside, check_outputs, scaled
from meshsplats.mesh import SplatMesh
from meshsplats.surfaces.options import SurfaceOptions, level_options


@as_cli_options(defaults=lambda name: f"(default: {getattr(SurfaceOptions(), name)})")
class Options(SurfaceOptions):
    """What is made, and how."""


Collider = Annotated[
    files.Collision | None, tyro.conf.arg(metavar="{drawn,only,convex}", help_behavior_hint="")
]
Image = Annotated[files.TextureImage | None, tyro.conf.arg(metavar="{png,jpg,webp}", help_behavior_hint="")]


@dataclass(frozen=True)
class Surface(Command):
    """Makes a light, connected, textured mesh of the surface that splats form: to be lit, edited, walked on,
    printed, or to carry a mesh prior.

    Writes a preview and the configuration beside it.
    """

    EXCLUSIVE = (("cameras", "data"),)
    CONFIGURABLE = True

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, or a mesh of splats."""
    output: option.Output
    """The mesh, opaque: .glb, .usdz with the texture inside; .obj, .ply, .usdc with the texture beside; .npz
    without; .stl, .3mf for printing."""
    surface: Options = field(default_factory=Options)
    levels: int = 1
    """Levels of detail, each with a quarter of the triangles of the one before: MESH.glb, MESH_lod1.glb..."""
    data: option.Folder = None
    """Data set of photographs to fit shape and texture to, in place of images of the scene."""
    missing: option.Missing = "few"
    masks: option.MeaningOfMasks = "count"
    cameras: option.File = None
    """Camera file: from where images are made, in place of --views."""
    unlit: bool = False
    """A material that shows the texture as it is, without lights."""
    image: Image = None
    """File of the texture. Default: png, or jpg where that is large and the format knows it."""
    collision: Collider = None
    """(.glb, USD) A static collider for engines, which is drawn, too, or not; or (.glb) convex parts of it
    that Unreal takes for its collider. Default: none."""
    scale: option.Number = None
    """Multiply all lengths: a scene unit of .stl and .3mf is a millimetre."""
    no_preview: bool = False
    """Write no preview."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    threads: option.Threads = None
    origin: option.Origin = "keep"
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.cameras.files import load_cameras
        from meshsplats.datasets.folder import load_dataset
        from meshsplats.images.writing import save_image
        from meshsplats.rendering.previews import preview_camera
        from meshsplats.surfaces import draw_surface
        from meshsplats.surfaces.making import surfaces_from
        from meshsplats.surfaces.views import place_of, sources_of

        start = time.perf_counter()
        options = self._checked()
        preview, config = beside(self.output, PREVIEW), beside(self.output, CONFIGURATION)
        meshes, textured = files.level_files(self.output, self.levels), self.collision != "only"
        more = [p for m in meshes for p in files.companions(m, self.image) if options.texture and textured]
        outputs = [*meshes, *more, config, *([] if self.no_preview else [preview])]
        check_outputs(outputs, self.force, inputs=[self.input])
        scene = self.reading.load_scene(self.input)
        origin = scene.origin
        data = None
        if self.data is not None:
            data = load_dataset(self.data, missing=self.missing, masks=self.masks, origin=origin)
        cameras = None if self.cameras is None else load_cameras(self.cameras, origin=origin)
        sources = sources_of(scene, data, cameras, options, self.threads)
        with progress_display() as display:
            bases = surfaces_from(
                scene,
                sources,
                options,
                self.levels,
                threads=self.threads,
                progress=lambda name, done, total: display.phase(name, done / total),
            )
        how: dict[str, Any] = {"unlit": self.unlit, "image": self.image, "collision": self.collision}
        with together():
            for base, path in zip(bases, meshes, strict=True):
                files.save_base(written(scaled(base, self.scale), self.origin), path, **how)
            write_configuration(config, "surface", self)
            if not self.no_preview:
                camera = preview_camera(scene)
                if place := place_of(scene, sources):
                    say(f"{place.in_words()}: seen from views that were found")
                    camera = place.cameras[0].within(camera.width)
                save_image(preview, draw_surface(bases[0], camera, threads=self.threads))
        seconds, made = time.perf_counter() - start, list(zip(meshes, bases, strict=True))
        if self.json:
            rows = [
                {"mesh": str(path), "triangles": len(base.faces), "bytes": path.stat().st_size}
                for path, base in made
            ]
            print(json.dumps(rows[0] | {"levels": rows[1:], "seconds": round(seconds, 2)}, indent=1))
            return
        for path, base in made:
            look = f"{len(base.textures[0].pixels)} texels" if base.textures else "colours of vertices"
            print(f"{path} ({len(base.faces):,} triangles, {look}, {size_of(path)})")
        print(f"in {seconds:.1f} s")
        if not self.no_preview:
            print(f"preview: {preview}")
        if self.output.suffix.lower() not in (*files.PRINTED, ".usdz"):
            splats = ["--splats", str(self.input), *self.reading.again()]
            source = ["--data", "photos/"] if isinstance(scene, SplatMesh) else splats
            print(f"next: {command_line(['meshsplats', 'prior', self.output, *source, '-o', 'prior.npz'])}")

    def resolved(self) -> dict[str, Any]:
        return asdict(self._checked())

    def _checked(self) -> SurfaceOptions:
        """The options of the library; UsageError or ValueError where they are wrong."""
        suffix = self.output.suffix.lower()
        if suffix not in files.BASE_SUFFIXES:
            raise UsageError(f"-o must end in {', '.join(files.BASE_SUFFIXES)}, got {self.output.name!r}")
        files.check_writing(self.output, unlit=self.unlit, image=self.image, collision=self.collision)
        if suffix in files.PRINTED and self.surface.shape in ("open", "floor"):
            raise UsageError(f"{suffix} is for printing, which wants a solid: --shape closed")
        check_photographs(self.data, self.missing, self.cameras, self.masks)
        if self.scale is not None and not 0 < self.scale < np.inf:
            raise UsageError(f"--scale must be above 0, got {self.scale}")
        given = {name: value for name, value in asdict(self.surface).items() if value is not None}
        return level_options(SurfaceOptions(**given), self.levels)[0]
