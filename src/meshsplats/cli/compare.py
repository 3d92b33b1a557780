"""``meshsplats compare``: scores of a mesh against its splats."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import tyro

from meshsplats.cameras.files import save_cameras
from meshsplats.cli import option
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import PartOptions, SplatOptions, optional_color, print_table, track
from meshsplats.cli.images import EXCLUSIVE_VIEWS, DrawOptions, ViewOptions
from meshsplats.cli.messages import say
from meshsplats.cli.records import write_configuration, write_json
from meshsplats.errors import FileFormatError
from meshsplats.evaluation.backgrounds import choose_background
from meshsplats.evaluation.comparison import Comparison, compare_views
from meshsplats.formats.outputs import CAMERAS, CONFIGURATION, check_outputs
from meshsplats.formats.sniff import identify
from meshsplats.frames import view_names
from meshsplats.rendering.looks import comparison_in_words, mesh_samples

RESULTS = "results.json"


@dataclass(frozen=True)
class Compare(Command):
    """Renders splats and mesh from the same cameras: PSNR and SSIM per view, and strips splats | mesh |
    error."""

    COMMON = (
        *("splats", "mesh", "output", "preset", "look", "orbit", "look_around", "cameras"),
        *("data", "downscale", "width", "background", "crop", "json", "force"),
    )
    EXCLUSIVE = EXCLUSIVE_VIEWS
    CONFIGURABLE = True

    splats: tyro.conf.Positional[Path]
    """Splat file or model folder."""
    mesh: tyro.conf.Positional[option.File] = None
    """The mesh. Default: the splats, converted with --preset for these cameras."""
    output: option.Output = tyro.MISSING
    """Folder for strips, results.json, cameras.json and config.toml."""
    preset: Literal["default", "paper"] = "default"
    """Preset of the conversion, without a mesh."""
    look: Literal["area", "splats"] = "area"
    """Ground truth. area: the mean over each pixel's area, as in photographs, Blender, MSAA and ray tracers.
    splats: the image of a 3DGS viewer at this size."""
    views: ViewOptions = field(default_factory=ViewOptions)
    """Default: 8 views of an orbit, 400 pixels wide."""
    draw: DrawOptions = field(default_factory=DrawOptions)
    reading: SplatOptions = field(default_factory=SplatOptions)
    part: PartOptions = field(default_factory=PartOptions)
    """Of the splats and of the mesh."""
    amplify: float = 4.0
    """Factor of the error in the strips."""
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.images.writing import amplified_error, save_image, strip

        if not self.amplify > 0:
            raise ValueError(f"--amplify must be positive, got {self.amplify}")
        optional_color(self.draw.background)
        self.views.check()
        self.draw.check_device()
        cloud = self.part.of(self.reading.load(self.splats))
        photographs = self.views.photographs(cloud.origin)
        cameras = self.views.make(cloud, self.splats, count=8, side=400, photographs=photographs, say=say)
        strips = view_names(len(cameras))
        names = (*strips, RESULTS, CAMERAS, CONFIGURATION)
        check_outputs([self.output / name for name in names], self.force, self.output)
        if self.mesh is None:
            from meshsplats.conversion import convert

            mesh = convert(cloud, preset=self.preset, cameras=cameras, look=self.look)
        else:
            from meshsplats.formats.meshes import load_mesh

            if identify(self.mesh) != "mesh":
                raise FileFormatError(f"{self.mesh}: not a mesh; give splats first, then the mesh")
            mesh = self.part.of(load_mesh(self.mesh, origin=cloud.origin))
        if self.draw.order is not None:
            mesh = replace(mesh, order=self.draw.order)
        start = time.perf_counter()
        background = choose_background(
            optional_color(self.draw.background),
            photographs,
            {"splats": cloud},
            self.splats,
            self.draw.threads,
        )
        scores = []
        samples = self.draw.samples or mesh_samples(self.look, mesh, cameras)
        views = compare_views(
            cloud,
            mesh,
            cameras,
            look=self.look,
            sh_degree=self.draw.sh_degree,
            background=background.color,
            samples=samples,
            max_layers=self.draw.max_layers,
            threads=self.draw.threads,
            device=self.draw.device,
        )
        captions = ("splats", "mesh", f"error x {self.amplify:g}")
        for name, view in zip(strips, track(views, "comparing", len(cameras)), strict=True):
            scores.append(view.score)
            self.output.mkdir(exist_ok=True)
            error = amplified_error(view.splats, view.mesh, self.amplify)
            save_image(self.output / name, strip([view.splats, view.mesh, error], captions))
        comparison = Comparison(tuple(scores))
        result = {
            "splats": len(cloud),
            "triangles": len(mesh.faces),
            "look": self.look,
            "samples": samples,
            "ssim_convention": "3dgs",
            "error_amplified": self.amplify,
            **background.to_dict(),
            "seconds": round(time.perf_counter() - start, 3),
            **comparison.to_dict(),
        }
        write_json(self.output / RESULTS, result)
        save_cameras(cameras, self.output / CAMERAS, origin=cloud.origin)
        write_configuration(self.output / CONFIGURATION, "compare", self)
        if self.json:
            print(json.dumps(result, indent=1, allow_nan=False))
            return
        rows = [(view.name, f"{view.psnr:.2f}", f"{view.ssim:.4f}") for view in comparison.views]
        rows.append(("mean", f"{comparison.psnr:.2f}", f"{comparison.ssim:.4f}"))
        print_table(("view", "PSNR dB", "SSIM"), rows)
        print(comparison_in_words(self.look, samples))
        print(f"{len(cloud):,} splats against {len(mesh.faces):,} triangles, {result['seconds']:.1f} s")
        print(f"background: {background.describe()}")
        print(f"strips splats | mesh | error x {self.amplify:g}: {self.output}/")
