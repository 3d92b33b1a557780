"""``meshsplats view``: a scene in the browser, or a page of it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from meshsplats.camera import Camera
from meshsplats.cameras.files import cameras_beside, load_cameras
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import (
    Count,
    File,
    Folder,
    Missing,
    PartOptions,
    SplatOptions,
    Text,
    check_data,
    load_scene,
    optional_color,
    parse_color,
    parse_up,
    plural,
    size_of,
)
from meshsplats.cli.images import views_of_a_place
from meshsplats.cli.messages import UsageError, say, shown_path
from meshsplats.cli.records import write_configuration
from meshsplats.datasets.views import Dataset
from meshsplats.evaluation.backgrounds import choose_background
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
    """Shows splats or a mesh in the browser, exactly, the splats beside it for comparison; or writes a page
    that anyone can open with a double click (-o scene.html).

    Splats are converted to a mesh first, with default settings; very many are merged before. Nothing leaves
    this machine: the browser gets the scene from 127.0.0.1 until Ctrl-C.
    """

    EXCLUSIVE = (("cameras", "data"), ("splats", "without_splats"), ("max_triangles", "whole"))
    CONFIGURABLE = True

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, or a mesh."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = (
        None
    )
    """An .html file with everything inside. Default: the browser is opened."""
    splats: File = None
    """Splats to compare a mesh with. Default: the input, where that is splats."""
    without_splats: bool = False
    """Leave the splats out: the page is smaller."""
    max_triangles: Count = None
    """Splats are merged until their mesh has no more triangles. Default: 4,000,000."""
    whole: bool = False
    """Merge no splats, up to 20,000,000 triangles."""
    cameras: File = None
    """Viewpoints to choose from: a JSON list of cameras, a cameras.json of a 3DGS trainer, or the model
    folder that has one. Default: those of the input, if it is a model folder."""
    data: Folder = None
    """Data set of photographs (COLMAP, NeRF-synthetic, nerfstudio, LLFF): viewpoints to choose from."""
    missing: Missing = "error"
    up: Text = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the cameras, else of the
    mesh."""
    background: Text = None
    """Background: white, black, grey, #rrggbb, or r,g,b from 0 to 1. Default: white; with --data that of the
    model folder or of the photographs."""
    title: Text = None
    """Name of the scene in the page. Default: that of the file."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    part: PartOptions = field(default_factory=PartOptions)
    no_open: bool = False
    """Print the address, and open no browser."""
    json: bool = False
    """Print the result as JSON."""
    force: bool = False
    """Overwrite existing outputs."""

    def execute(self) -> None:
        self._check()
        if self.output is not None:
            inputs = [path for path in (self.input, self.splats, self.cameras) if path is not None]
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
        check_data(self.data, self.missing)
        for first, second in self.EXCLUSIVE:
            if getattr(self, first) and getattr(self, second):
                raise UsageError(f"give --{first} or --{second.replace('_', '-')}, not both")
        if self.max_triangles is not None and not 8 <= self.max_triangles <= content.MOST_TRIANGLES:
            raise UsageError(
                f"--max-triangles must be from 8, one splat's, to {content.MOST_TRIANGLES:,},"
                f" got {self.max_triangles}"
            )
        if self.background is not None:
            parse_color(self.background)
        if self.up is not None:
            parse_up(self.up)

    def _scene(self) -> GaussianCloud | SplatMesh:
        scene = self.part.of(load_scene(self.input, self.reading, up=self.up))
        if isinstance(scene, SplatMesh):
            if self.max_triangles is not None or self.whole:
                given = "--whole" if self.whole else "--max-triangles"
                raise UsageError(f"{shown_path(self.input)} is a mesh: {given} is for splats")
            return scene
        if self.splats is not None:
            raise UsageError(f"{shown_path(self.input)} is splats: --splats is for a mesh")
        return scene

    def _content(self, scene: GaussianCloud | SplatMesh, cameras: list[Camera]) -> Content:
        """What the page will show."""
        try:
            if isinstance(scene, GaussianCloud):
                advice = "leave --whole out, or make 'meshsplats tiles'"
                most = None if self.whole else self.max_triangles or content.TRIANGLES
                shown = not self.without_splats
                return content.content_of_splats(scene, cameras, max_triangles=most, shown=shown)
            advice = "fine-tune it with --max-triangles, or make 'meshsplats tiles'"
            splats = None
            if self.splats is not None:
                splats = self.part.of(self.reading.load(self.splats, scene.origin))
            return content.content_of_mesh(scene, splats)
        except content.TooManyTrianglesError as error:
            raise UsageError(f"{error}: {advice}") from None

    def _photographs(self, origin: np.ndarray) -> Dataset | None:
        if self.data is None:
            return None
        from meshsplats.datasets.folder import load_dataset

        return load_dataset(self.data, missing=self.missing, origin=origin)

    def _cameras(self, photographs: Dataset | None, scene: GaussianCloud | SplatMesh) -> list[Camera]:
        if photographs is not None:
            return [view.camera for view in photographs.views]
        if self.cameras is not None:
            return load_cameras(self.cameras, origin=scene.origin)
        splats = isinstance(scene, GaussianCloud)
        opening = opening_beside(self.input, scene.origin) if splats else None
        first, beside = [] if opening is None else [opening], cameras_beside(self.input, scene.origin)
        if beside is not None:
            return [*first, *beside]
        up = None if self.up is None else parse_up(self.up)
        return views_of_a_place(scene, self.input, FOUND_VIEWS, up=up) or first

    def _announce(self, shown: Content) -> None:
        """Says what was merged, and how large the file will be, before the work of packing it."""
        from meshsplats._files.atomic import in_words
        from meshsplats.viewer.page import estimated_size

        if self.json:
            return  # the result has the same numbers
        if shown.merged_from is not None:
            say(
                f"{shown.merged_from:,} splats were merged to {shown.kept:,}: an image of them with"
                f" {content.SIDE} pixels has {shown.merging_psnr:.1f} dB against that of all;"
                " --max-triangles N or --whole keeps more"
            )
        if self.output is not None:
            size = in_words(estimated_size(shown.mesh, shown.splats, shown.coarse))
            say(f"{self.output} will have about {size}: {_sizes(shown)}")

    def _page(self, shown: Content, photographs: Dataset | None, cameras: list[Camera]) -> Page:
        from meshsplats.viewer.page import PageOptions, make_page

        background = choose_background(
            optional_color(self.background),
            photographs,
            {"mesh": shown.mesh},
            self.input,
            None,
            whole=self.part.crop is None,
        )
        name = shown_path(self.input)
        options = PageOptions(
            title=self.title or ("scene" if name == "-" else Path(name).resolve().stem),
            background=background.color,
            up=None if self.up is None else parse_up(self.up),
            merged_from=shown.merged_from,
        )
        return make_page(
            shown.mesh, splats=shown.splats, coarse=shown.coarse, cameras=cameras, options=options
        )

    def _write(self, page: Page, result: dict[str, Any]) -> None:
        from meshsplats._files.atomic import write_text

        assert self.output is not None
        write_text(self.output, page.html)
        write_configuration(beside(self.output, CONFIGURATION), "view", self, result)
        if self.json:
            print(json.dumps({"page": str(self.output), **result}, indent=1, allow_nan=False))
            return
        print(f"{self.output} ({size_of(self.output)}): {_contents(result)}")
        print(_errors(result))
        print("next: open it with a double click, or send it to someone; it needs no network")

    def _serve(self, page: Page, result: dict[str, Any]) -> None:
        from meshsplats.viewer.server import open_page, serving

        with serving(page.html) as server:
            if self.json:
                print(json.dumps({"url": server.url, **result}, allow_nan=False), flush=True)
            else:
                print(_contents(result))
                print(_errors(result))
                print(f"{server.url}\nCtrl-C ends", flush=True)
            if not self.no_open and not open_page(server.url):
                say("no browser was found: open the address above in one, on this machine")
            try:
                server.serve_forever()
            except KeyboardInterrupt:
                say("ended")


def _sizes(shown: Content) -> str:
    parts = [plural(len(shown.mesh.faces), "triangle")]
    parts += [] if shown.coarse is None else [f"a coarse level of {len(shown.coarse.faces):,}"]
    return ", ".join(parts if shown.splats is None else [*parts, plural(len(shown.splats), "splat")])


def _contents(result: dict[str, Any]) -> str:
    parts = [plural(result["triangles"], "triangle")]
    parts += [f"a coarse level of {result['coarse_triangles']:,}"] if result["coarse_triangles"] else []
    parts += [plural(result["splats"], "splat")] if result["splats"] else []
    parts += [plural(result["viewpoints"], "viewpoint")] if result["viewpoints"] else []
    return ", ".join(parts)


def _errors(result: dict[str, Any]) -> str:
    return (
        f"{result['bytes_a_triangle']:.1f} bytes a triangle; quantisation moves vertices by at most"
        f" {result['position_error_radii']:.1g} of the scene's radius,\ncolours by"
        f" {result['color_error_levels']:.2g}, opacities by {result['alpha_error_levels']:.2g} and pixels of"
        f" one view by {result['image_error_levels']:.2g} of 255 levels"
    )
