"""``meshsplats view``: a scene in the browser, or a page of it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from meshsplats._files.atomic import in_words
from meshsplats._words import optional_color, optional_up
from meshsplats.base_mesh import BaseMesh
from meshsplats.camera import Camera
from meshsplats.cameras.files import cameras_beside, load_cameras
from meshsplats.cli import option
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import PartOptions, SplatOptions, size_of
from meshsplats.cli.images import views_of_a_place
from meshsplats.cli.messages import UsageError, say, shown_path
from meshsplats.cli.records import write_configuration
from meshsplats.conversion.cleaning import cropped
from meshsplats.datasets.scene_views import check_photographs
from meshsplats.datasets.views import Dataset
from meshsplats.evaluation.backgrounds import choose_background
from meshsplats.formats.base_meshes import load_base
from meshsplats.formats.outputs import CONFIGURATION, beside, check_outputs
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh
from meshsplats.viewer import content
from meshsplats.viewer.content import Content
from meshsplats.viewpoints.showing import opening_beside

if TYPE_CHECKING:
    from meshsplats.viewer.page import Page
FOUND_VIEWS = 12
"""Viewpoints of a place, where the input has none."""


@dataclass(frozen=True)
class View(Command):
    """Shows splats or a mesh in the browser, exactly, the splats beside it for comparison; or a textured
    surface; or writes a page that anyone can open with a double click (-o scene.html).

    Splats are converted to a mesh first, with default settings; very many are merged before. Nothing leaves
    this machine: the browser gets the scene from 127.0.0.1 until Ctrl-C.
    """

    EXCLUSIVE = (("cameras", "data"), ("splats", "without_splats"), ("max_triangles", "whole"))
    CONFIGURABLE = True

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, a mesh, or a surface with a texture (.glb, .obj)."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = (
        None
    )
    """An .html file with everything inside. Default: the browser is opened."""
    splats: option.File = None
    """Splats to compare a mesh with. Default: the input, where that is splats."""
    surface: option.File = None
    """A surface to compare the input with (.glb or .obj with its texture, or any mesh)."""
    without_splats: bool = False
    """Leave the splats out: the page is smaller."""
    max_triangles: option.Count = None
    """Splats are merged until their mesh has no more triangles. Default: 4,000,000."""
    whole: bool = False
    """Merge no splats, up to 20,000,000 triangles."""
    cameras: option.File = None
    """Viewpoints to choose from: a JSON list of cameras, a cameras.json of a 3DGS trainer, or the model
    folder that has one. Default: those of the input, if it is a model folder."""
    data: option.Folder = None
    """Data set of photographs (COLMAP, NeRF-synthetic, nerfstudio, LLFF): viewpoints to choose from."""
    missing: option.Missing = "few"
    up: option.Text = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the cameras, else of the
    mesh."""
    background: option.Text = None
    """Background: white, black, grey, #rrggbb, or r,g,b from 0 to 1. Default: white; with --data that of the
    model folder or of the photographs."""
    title: option.Text = None
    """Name of the scene in the page. Default: that of the file."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    part: PartOptions = field(default_factory=PartOptions)
    no_open: bool = False
    """Print the address, and open no browser."""
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        self._check()
        if self.output is not None:
            inputs = [p for p in (self.input, self.splats, self.surface, self.cameras) if p is not None]
            outputs = [self.output, beside(self.output, CONFIGURATION)]
            check_outputs(outputs, self.force, inputs=inputs)
        scene = self._scene()
        photographs = self._photographs(scene.origin)
        cameras = self._cameras(photographs, scene)
        shown = self._content(scene, cameras)
        del scene  # large, and partly copied
        self._announce(shown)
        page = self._page(shown, photographs, cameras)
        result = content.measured(shown, page, cameras)
        if self.output is not None:
            self._write(page, result)
        else:
            self._serve(page, result)

    def _check(self) -> None:
        if self.output is not None and self.output.suffix.lower() not in (".html", ".htm"):
            raise UsageError(f"-o must end in .html, got {self.output.name!r}")
        if self.output is not None and self.no_open:
            raise UsageError("--no-open has no effect with -o, which opens nothing")
        if self.output is None and self.force:
            raise UsageError("--force has no effect without -o")
        check_photographs(self.data, self.missing)
        for first, second in self.EXCLUSIVE:
            if getattr(self, first) and getattr(self, second):
                raise UsageError(f"give --{first} or --{second.replace('_', '-')}, not both")
        if self.max_triangles is not None and not 8 <= self.max_triangles <= content.MOST_TRIANGLES:
            raise UsageError(
                f"--max-triangles must be from 8, one splat's, to {content.MOST_TRIANGLES:,},"
                f" got {self.max_triangles}"
            )
        optional_color(self.background)
        optional_up(self.up)

    def _scene(self) -> GaussianCloud | SplatMesh | BaseMesh:
        scene = content.surface_or(lambda path: self.reading.load_scene(path, up=self.up), self.input)
        if isinstance(scene, BaseMesh):
            if self.surface is not None or self.part.crop is not None:
                given = "--crop" if self.surface is None else "--surface"
                raise UsageError(f"{shown_path(self.input)} is a textured surface: {given} has no effect")
        else:
            scene = cropped(scene, self.part.crop)
        if not isinstance(scene, GaussianCloud):
            if self.max_triangles is not None or self.whole:
                given = "--whole" if self.whole else "--max-triangles"
                raise UsageError(f"{shown_path(self.input)} is a mesh: {given} is for splats")
            return scene
        if self.splats is not None:
            raise UsageError(f"{shown_path(self.input)} is splats: --splats is for a mesh")
        return scene

    def _content(self, scene: GaussianCloud | SplatMesh | BaseMesh, cameras: list[Camera]) -> Content:
        """What the page will show."""
        beside = None if self.surface is None else load_base(self.surface, origin=scene.origin)
        try:
            if isinstance(scene, GaussianCloud):
                advice = "leave --whole out, or make 'meshsplats tiles'"
                most = None if self.whole else self.max_triangles or content.TRIANGLES
                shown = not self.without_splats
                made = content.content_of_splats(scene, cameras, max_triangles=most, shown=shown)
                return replace(made, surface=beside)
            advice = "fine-tune it with --max-triangles, or make 'meshsplats tiles'"
            splats = None
            if self.splats is not None:
                splats = cropped(self.reading.load(self.splats, scene.origin), self.part.crop)
            if isinstance(scene, BaseMesh):
                return Content(None, splats, surface=scene)
            return replace(content.content_of_mesh(scene, splats), surface=beside)
        except content.TooManyTrianglesError as error:
            raise UsageError(f"{error}: {advice}") from None

    def _photographs(self, origin: np.ndarray) -> Dataset | None:
        if self.data is None:
            return None
        from meshsplats.datasets.folder import load_dataset

        return load_dataset(self.data, missing=self.missing, origin=origin)

    def _cameras(
        self, photographs: Dataset | None, scene: GaussianCloud | SplatMesh | BaseMesh
    ) -> list[Camera]:
        if photographs is not None:
            return [view.camera for view in photographs.views]
        if self.cameras is not None:
            return load_cameras(self.cameras, origin=scene.origin)
        if isinstance(scene, BaseMesh):
            return cameras_beside(self.input, scene.origin) or []
        splats = isinstance(scene, GaussianCloud)
        opening = opening_beside(self.input, scene.origin) if splats else None
        first, beside = [] if opening is None else [opening], cameras_beside(self.input, scene.origin)
        if beside is not None:
            return [*first, *beside]
        return views_of_a_place(scene, self.input, FOUND_VIEWS, up=optional_up(self.up)) or first

    def _announce(self, shown: Content) -> None:
        """Says what was merged, and how large the file will be, before the work of packing it."""
        if self.json:
            return  # the result has the same numbers
        if shown.merged_from is not None:
            say(
                f"{shown.merged_from:,} splats were merged to {shown.kept:,}: an image of them with"
                f" {content.SIDE} pixels has {shown.merging_psnr:.1f} dB against that of all;"
                " --max-triangles N or --whole keeps more"
            )
        if self.output is not None:
            size = in_words(shown.estimated_size())
            say(f"{self.output} will have about {size}: {content.in_words(shown.counts())}")

    def _page(self, shown: Content, photographs: Dataset | None, cameras: list[Camera]) -> Page:
        from meshsplats.viewer.page import PageOptions

        background = choose_background(
            optional_color(self.background),
            None if shown.mesh is None else photographs,
            {} if shown.mesh is None else {"mesh": shown.mesh},
            self.input,
            None,
            whole=self.part.crop is None,
        )
        name = shown_path(self.input)
        options = PageOptions(
            title=self.title or ("scene" if name == "-" else Path(name).resolve().stem),
            background=background.color,
            up=optional_up(self.up),
            merged_from=shown.merged_from,
        )
        return shown.page(cameras, options)

    def _write(self, page: Page, result: dict[str, Any]) -> None:
        from meshsplats._files.atomic import write_text

        assert self.output is not None
        write_text(self.output, page.html)
        write_configuration(beside(self.output, CONFIGURATION), "view", self, result)
        if self.json:
            print(json.dumps({"page": str(self.output), **result}, indent=1, allow_nan=False))
            return
        print(f"{self.output} ({size_of(self.output)}): {content.in_words(result)}")
        print(content.errors_in_words(result))
        print("next: open it with a double click, or send it to someone; it needs no network")

    def _serve(self, page: Page, result: dict[str, Any]) -> None:
        from meshsplats.viewer.server import open_page, serving

        with serving(page.html) as server:
            if self.json:
                print(json.dumps({"url": server.url, **result}, allow_nan=False), flush=True)
            else:
                print(content.in_words(result))
                print(content.errors_in_words(result))
                print(f"{server.url}\nCtrl-C ends", flush=True)
            if not self.no_open and not open_page(server.url):
                say("no browser was found: open the address above in one, on this machine")
            try:
                server.serve_forever()
            except KeyboardInterrupt:
                say("ended")
