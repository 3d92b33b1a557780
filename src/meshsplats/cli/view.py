"""``meshsplats view``: a scene in the browser, or a page of it."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from meshsplats.camera import Camera
from meshsplats.cameras.files import load_cameras
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import (
    File,
    Folder,
    PartOptions,
    SplatOptions,
    Text,
    cameras_beside,
    check_outputs,
    chosen_background,
    load_scene,
    parse_color,
    parse_up,
    plural,
    size_of,
)
from meshsplats.cli.messages import UsageError, say, shown_path
from meshsplats.cli.records import CONFIGURATION, beside, write_configuration
from meshsplats.datasets.views import Dataset
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    from meshsplats.viewer.page import Page

SIDE = 400
"""Largest side of the image by which the error of quantisation is measured."""


@dataclass(frozen=True)
class View(Command):
    """Shows splats or a mesh in the browser, exactly, the splats beside it for comparison; or writes a page
    that anyone can open with a double click (-o scene.html).

    Splats are converted to a mesh first, with default settings. Nothing leaves this machine: the browser gets
    the scene from 127.0.0.1 until Ctrl-C.
    """

    EXCLUSIVE = (("cameras", "data"), ("splats", "without_splats"))
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
    cameras: File = None
    """Viewpoints to choose from: a JSON list of cameras, a cameras.json of a 3DGS trainer, or the model
    folder that has one. Default: those of the input, if it is a model folder."""
    data: Folder = None
    """Data set of photographs (COLMAP, NeRF-synthetic, nerfstudio): viewpoints to choose from."""
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
        scene = self.part.of(load_scene(self.input, self.reading))
        if isinstance(scene, GaussianCloud) and self.splats is not None:
            raise UsageError(f"{shown_path(self.input)} is splats: --splats is for a mesh")
        mesh, splats = self._content(scene)
        photographs = self._photographs()
        page, cameras = self._page(mesh, splats, photographs)
        result = self._measured(mesh, splats, page, cameras)
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
        for first, second in self.EXCLUSIVE:
            if getattr(self, first) and getattr(self, second):
                raise UsageError(f"give --{first} or --{second.replace('_', '-')}, not both")
        if self.background is not None:
            parse_color(self.background)
        if self.up is not None:
            parse_up(self.up)

    def _content(self, scene: GaussianCloud | SplatMesh) -> tuple[SplatMesh, GaussianCloud | None]:
        """The mesh, and the splats to compare it with."""
        if isinstance(scene, SplatMesh):
            return scene, None if self.splats is None else self.part.of(self.reading.load(self.splats))
        from meshsplats.conversion import convert

        return convert(scene), None if self.without_splats else scene

    def _photographs(self) -> Dataset | None:
        if self.data is None:
            return None
        from meshsplats.datasets.folder import load_dataset

        return load_dataset(self.data)

    def _cameras(self, photographs: Dataset | None) -> list[Camera]:
        if photographs is not None:
            return [view.camera for view in photographs.views]
        if self.cameras is not None:
            return load_cameras(self.cameras)
        return cameras_beside(self.input) or []

    def _page(
        self, mesh: SplatMesh, splats: GaussianCloud | None, photographs: Dataset | None
    ) -> tuple[Page, list[Camera]]:
        from meshsplats.viewer.page import PageOptions, make_page

        background = chosen_background(
            self.background, photographs, {"mesh": mesh}, self.input, None, whole=self.part.crop is None
        )
        name = shown_path(self.input)
        options = PageOptions(
            title=self.title or ("scene" if name == "-" else Path(name).resolve().stem),
            background=background.color,
            up=None if self.up is None else parse_up(self.up),
        )
        cameras = self._cameras(photographs)
        return make_page(mesh, splats=splats, cameras=cameras, options=options), cameras

    def _measured(
        self, mesh: SplatMesh, splats: GaussianCloud | None, page: Page, cameras: list[Camera]
    ) -> dict[str, Any]:
        """Sizes, and the errors that quantisation makes."""
        from meshsplats.cameras.trajectories import orbit
        from meshsplats.rendering import render

        camera = (
            cameras[0].within(SIDE) if cameras else orbit(mesh, 1, azimuth=30, width=SIDE, height=SIDE)[0]
        )
        packed = page.mesh
        images = [render(each, camera, samples=2).color for each in (mesh, packed.decoded)]
        return {
            "triangles": len(mesh.faces),
            "splats": 0 if splats is None else len(splats),
            "viewpoints": len(cameras),
            "bytes": len(page.html.encode("utf-8")),
            "bytes_a_triangle": round(packed.bytes_a_triangle, 2),
            "position_error": packed.position_error,
            "position_error_radii": packed.relative_error,
            "color_error_levels": packed.color_error,
            "alpha_error_levels": packed.alpha_error,
            "image_error_levels": 255 * float(np.abs(images[0] - images[1]).max()),
        }

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
        from meshsplats.viewer.server import serving

        with serving(page.html) as server:
            if self.json:
                print(json.dumps({"url": server.url, **result}, allow_nan=False), flush=True)
            else:
                print(_contents(result))
                print(_errors(result))
                print(f"{server.url}\nCtrl-C ends", flush=True)
            if not self.no_open and not _opened(server.url):
                say("no browser was found: open the address above in one, on this machine")
            try:
                server.serve_forever()
            except KeyboardInterrupt:
                say("ended")


def _opened(url: str) -> bool:
    """Whether a browser with a window opens ``url``."""
    import webbrowser

    windowless = sys.platform not in ("win32", "darwin") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
    return not windowless and webbrowser.open(url)


def _contents(result: dict[str, Any]) -> str:
    parts = [plural(result["triangles"], "triangle")]
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
