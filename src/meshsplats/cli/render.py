"""``meshsplats render``: images of splats or of a mesh."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from meshsplats.camera import Camera, hiding_near_plane
from meshsplats.cameras.files import save_cameras
from meshsplats.cli import option
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import (
    ClusterOptions,
    PartOptions,
    SplatOptions,
    load_scene,
    open_tileset,
    optional_color,
    plural,
    size_of,
    track,
)
from meshsplats.cli.images import EXCLUSIVE_VIEWS, DrawOptions, ViewOptions, announce_cost
from meshsplats.cli.messages import UsageError, say
from meshsplats.cli.records import write_configuration
from meshsplats.errors import DataWarning
from meshsplats.evaluation.backgrounds import choose_background
from meshsplats.formats.outputs import CAMERAS, CONFIGURATION, beside, check_outputs
from meshsplats.frames import FrameOptions, Scene, depth_unit, draw_frames, remove_older, view_names
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.tiles.drawing import MAX_ERROR
from meshsplats.tiles.tileset import Tileset


@dataclass(frozen=True)
class _Files:
    """The outputs."""

    images: list[Path]
    depths: list[Path]
    turntable: Path | None
    cameras: Path
    config: Path

    @property
    def every(self) -> list[Path]:
        turntable = [self.turntable] if self.turntable else []
        return [*self.images, *self.depths, *turntable, self.cameras, self.config]


@dataclass(frozen=True)
class Render(Command):
    """Renders splats, a mesh or a tileset: one image (-o image.png), or a folder of images with a turntable.

    Splats (.ply, or the folder of a trained model) are converted to a mesh first, with default settings;
    --as-splats renders them as 3D Gaussian Splatting does.
    """

    COMMON = (
        *("input", "output", "as_splats", "orbit", "look_around", "cameras"),
        *("data", "elevation", "azimuth", "distance", "up", "width"),
        *("height", "background", "transparent", "depth", "json", "force"),
    )
    EXCLUSIVE = (*EXCLUSIVE_VIEWS, ("background", "transparent"))
    CONFIGURABLE = True

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, a mesh, or the folder of a tileset."""
    output: option.Output
    """A .png for one view, or a folder. Without other options: the front view, or an orbit of 60 views."""
    as_splats: bool = False
    """Render the splats themselves, not the mesh that they become."""
    views: ViewOptions = field(default_factory=ViewOptions)
    draw: DrawOptions = field(default_factory=DrawOptions)
    reading: SplatOptions = field(default_factory=SplatOptions)
    part: PartOptions = field(default_factory=PartOptions)
    cutoff: option.Number = None
    """Draw a mesh as a depth buffer does: opaque where its opacity is at least this, nothing elsewhere. 0 to
    1; default: blended."""
    max_error: option.Number = None
    """Tileset: draw tiles whose geometric error is at most this many pixels; 0 draws the finest ones.
    Default: 1."""
    transparent: bool = False
    """No background: images with an alpha channel."""
    depth: Literal["none", "png", "npy"] = "none"
    """Also depth images of a mesh: 16-bit PNG (depth_unit in the configuration is its scale) or float arrays;
    0: empty."""
    animation: Literal["webp", "gif", "png", "none"] = "webp"
    """Format of the turntable of an orbit; png is an animated PNG."""
    fps: float = 15.0
    """Images per second of the turntable."""
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        single = self.output.suffix.lower() == ".png"
        self._check(single)
        start = time.perf_counter()
        tileset = open_tileset(self.input, self.part, self.max_error)
        # The coarsest tile says where a tileset is.
        if tileset:
            scene: GaussianCloud | SplatMesh = replace(tileset.root.load(), origin=tileset.origin)
        else:
            scene = self.part.of(load_scene(self.input, self.reading, up=self.views.up))
        self._check_scene(scene)
        photographs = self.views.photographs(scene.origin)
        count = 1 if single else 60
        how: dict[str, Any] = {"photographs": photographs, "film": not single}
        cameras = self.views.make(scene, self.input, count=count, side=800, say=say, **how)
        if tileset is None:
            places = scene.means if isinstance(scene, GaussianCloud) else scene.vertices
            if hidden := hiding_near_plane(cameras, places):
                warnings.warn(f"the cameras see nothing: {hidden}", DataWarning, stacklevel=2)
        if single and len(cameras) > 1:
            raise UsageError(f"{plural(len(cameras), 'view')} do not fit one .png: give -o a folder")
        files = self._files(single, len(cameras))
        check_outputs(files.every, self.force, None if single else self.output)
        scene = self._drawable(scene)
        result: dict[str, Any] = {}
        unit = None
        if self.depth == "png" and isinstance(scene, SplatMesh):
            points = tileset.root.corners() if tileset else scene.vertices
            result["depth_unit"] = unit = depth_unit(points, cameras)
        color = (0.0, 0.0, 0.0)
        if not self.transparent:
            kind = "splats" if isinstance(scene, GaussianCloud) else "mesh"
            background = choose_background(
                optional_color(self.draw.background),
                photographs,
                {kind: scene},
                self.input,
                self.draw.threads,
                whole=False,
            )
            color = background.color
            result |= background.to_dict()
        if not single:
            remove_older(self.output, files.every)
        drawing = FrameOptions(
            background=color,
            transparent=self.transparent,
            samples=self.draw.samples,
            sh_degree=self.draw.sh_degree,
            max_layers=self.draw.max_layers,
            cutoff=self.cutoff,
            order=self.draw.order,
            device=self.draw.device,
            depth=self.depth,
            depth_unit=unit,
            max_error=MAX_ERROR if self.max_error is None else self.max_error,
        )
        self._draw(tileset or scene, cameras, files, drawing)
        if files.turntable:
            from meshsplats.images.reading import load_image
            from meshsplats.images.writing import save_animation

            save_animation(files.turntable, map(load_image, files.images), fps=self.fps)
        save_cameras(cameras, files.cameras, origin=scene.origin)
        write_configuration(files.config, "render", self, result)
        seconds = time.perf_counter() - start
        if self.json:
            output = {
                "images": files.images,
                "depth": files.depths,
                "turntable": files.turntable,
                "cameras": files.cameras,
                "seconds": round(seconds, 3),
            }
            print(json.dumps(output, default=str, indent=1))
            return
        size = f"{cameras[0].width} x {cameras[0].height}"
        where = f"{self.output} ({size_of(self.output)})" if single else f"{self.output}/"
        print(f"{plural(len(cameras), 'image')} of {size} in {seconds:.1f} s: {where}")
        if files.turntable:
            print(f"turntable: {files.turntable} ({size_of(files.turntable)})")

    def _files(self, single: bool, count: int) -> _Files:
        out = self.output
        if single:
            depths = [out.with_suffix(f".depth.{self.depth}")] if self.depth != "none" else []
            return _Files([out], depths, None, beside(out, CAMERAS), beside(out, CONFIGURATION))
        images = [out / name for name in view_names(count)]
        depths = (
            [out / name for name in view_names(count, "depth", f".{self.depth}")]
            if self.depth != "none"
            else []
        )
        turns = self.views.moving and self.animation != "none" and count > 1
        turntable = out / f"turntable.{self.animation}" if turns else None
        return _Files(images, depths, turntable, out / CAMERAS, out / CONFIGURATION)

    def _check(self, single: bool) -> None:
        from meshsplats.mesh import checked_cutoff

        self.views.check()
        optional_color(self.draw.background)
        if not single and self.output.suffix:
            raise UsageError(f"-o must end in .png for one image, or name a folder, got {self.output.name!r}")
        if self.transparent and self.draw.background is not None:
            raise UsageError("--transparent and --background exclude each other")
        if self.transparent and self.animation == "gif":
            raise UsageError("GIF has no translucency: use --animation webp, png or none with --transparent")
        if self.as_splats and self.depth != "none":
            raise UsageError("--depth is that of a mesh: leave out --as-splats")
        if self.cutoff is not None:
            checked_cutoff(self.cutoff)
            if self.as_splats:
                raise UsageError("--cutoff is for a mesh: leave out --as-splats")
            if self.draw.max_layers is not None:
                raise UsageError(
                    "--max-layers has no effect with --cutoff, which draws one triangle a sample"
                )
        if self.as_splats and self.draw.max_layers is not None:
            raise UsageError("--max-layers counts triangles: it has no effect with --as-splats")
        if self.as_splats and self.draw.order is not None:
            raise UsageError("--order is that of a mesh: leave out --as-splats")
        if self.as_splats and self.draw.device == "gpu":
            raise UsageError("--device gpu draws meshes: leave out --as-splats")
        self.draw.check_device()

    def _check_scene(self, scene: GaussianCloud | SplatMesh) -> None:
        if isinstance(scene, SplatMesh) and self.as_splats:
            raise ValueError(f"{self.input} is a mesh: --as-splats needs a splat file")
        if self.draw.sh_degree is not None and not self.as_splats:
            raise UsageError("--sh-degree is for splats: a mesh has one colour per vertex; add --as-splats")

    def _drawable(self, scene: GaussianCloud | SplatMesh) -> GaussianCloud | SplatMesh:
        """``scene``, converted if it is splats that are to be drawn as a mesh."""
        if isinstance(scene, SplatMesh) or self.as_splats:
            return scene
        from meshsplats.conversion import convert

        return convert(scene)

    def load(self) -> Scene:
        """The scene of the images, from the input."""
        tileset = open_tileset(self.input, self.part, self.max_error)
        return tileset or self._drawable(self.part.of(load_scene(self.input, self.reading, up=self.views.up)))

    def _draw(self, scene: Scene, cameras: Sequence[Camera], files: _Files, chosen: FrameOptions) -> None:
        from meshsplats._files.atomic import write_bytes

        chosen = chosen.for_scene(scene, cameras)
        if not isinstance(scene, Tileset):
            announce_cost(scene, cameras, chosen.samples or 1, self.draw.threads)
        with self.cluster.workers(self.draw.threads) as workers:
            drawn = draw_frames(scene, cameras, chosen, workers=workers, load=self.load)
            for i, (image, depth) in track(drawn, "rendering", len(cameras)):
                if not files.images[i].parent.exists():
                    files.images[i].parent.mkdir()  # not before there is something to write
                write_bytes(files.images[i], image)
                if depth is not None:
                    write_bytes(files.depths[i], depth)
