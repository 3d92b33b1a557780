"""``meshsplats cameras``: from where a scene is to be seen, found from its splats."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from meshsplats._common.words import command_line, optional_up
from meshsplats.cli import option
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import SplatOptions
from meshsplats.cli.messages import UsageError, say

if TYPE_CHECKING:
    import numpy as np

    from meshsplats.viewpoints.finding import FoundCameras


@dataclass(frozen=True)
class Cameras(Command):
    """Finds cameras that see a scene as its photographs did, from the splats alone.

    An object is seen from all around; a room, a garden or a town from where its splats look sharp and leave
    no holes. The first camera is the view to open with. NAME.preview.png beside the result NAME shows them.
    """

    input: tyro.conf.Positional[Path]
    """Splats."""
    output: option.Output
    """The cameras, for --cameras of other commands: .json."""
    count: int = 24
    """Number of views."""
    up: option.Text = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the file, else found."""
    width: int = 800
    """Image width in pixels."""
    height: option.Count = None
    """Image height in pixels. Default: the width."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    threads: option.Threads = None
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats._files.atomic import together
        from meshsplats.cameras.files import save_cameras
        from meshsplats.cameras.framing import guess_up
        from meshsplats.formats.outputs import PREVIEW, beside, check_outputs
        from meshsplats.images.writing import save_image
        from meshsplats.scene.gaussians import GaussianCloud
        from meshsplats.viewpoints.beside import cameras_beside, stored_cameras
        from meshsplats.viewpoints.finding import find_cameras
        from meshsplats.viewpoints.sheet import contact_sheet
        from meshsplats.viewpoints.showing import opened_with

        start = time.perf_counter()
        if self.output.suffix.lower() != ".json":
            raise UsageError(f"cameras are written as .json, got {self.output.name!r}")
        preview = beside(self.output, PREVIEW)
        check_outputs([self.output, preview], self.force, inputs=[self.input])
        scene = self.reading.load_scene(self.input, up=self.up, find_up=False)
        if not isinstance(scene, GaussianCloud):
            raise UsageError(f"{self.input} is a mesh: cameras are found from the splats it was made of")
        up = optional_up(self.up)
        given = cameras_beside(self.input, scene.origin)
        if given is not None:
            where = stored_cameras(self.input)
            say(f"{where} has {len(given)} training cameras, which --cameras {where} takes")
            up = guess_up(scene, given) if up is None else up
        side = self.width, self.width if self.height is None else self.height
        self.reading.tell_of("looking for views of", len(scene))
        found = find_cameras(scene, self.count, up=up, width=side[0], height=side[1], threads=self.threads)
        cameras = opened_with(found.cameras, self.input, scene.origin, side)
        with together():
            save_cameras(cameras, self.output, origin=scene.origin)
            save_image(preview, contact_sheet(scene, cameras, threads=self.threads))
        self._print_result(found, scene.origin, preview, time.perf_counter() - start)

    def _print_result(self, found: FoundCameras, origin: np.ndarray, preview: Path, seconds: float) -> None:
        facts = {
            "output": str(self.output),
            "preview": str(preview),
            "kind": found.kind,
            "confidence": round(found.confidence, 2),
            "up": [round(float(v), 4) for v in found.up],
            "up_confidence": round(found.up_confidence, 2),
            "ground": found.ground + float(origin @ found.up),
            "extent": found.extent,
            "cameras": len(found.cameras),
            "seconds": round(seconds, 2),
        }
        words = ["meshsplats", "render", self.input, "--as-splats", "--cameras", self.output, "-o", "views/"]
        made = f"{self.output} ({len(found.cameras)} cameras) in {seconds:.1f} s; {preview} shows them"
        self.finish(facts, found.in_words(), made, f"next: {command_line(words)}")
