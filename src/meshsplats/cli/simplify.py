"""``meshsplats simplify``: fewer splats."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from meshsplats._files.atomic import together
from meshsplats.cameras.files import cameras_beside
from meshsplats.cli import option
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import SplatOptions, draw_preview, named, written
from meshsplats.cli.messages import UsageError
from meshsplats.cli.records import write_configuration
from meshsplats.datasets.scene_views import cameras_named, check_photographs
from meshsplats.errors import FileFormatError
from meshsplats.formats.outputs import CONFIGURATION, PREVIEW, beside, check_outputs, check_splat_endings
from meshsplats.formats.sniff import identify
from meshsplats.formats.splat_formats import written_ending


@dataclass(frozen=True)
class Simplify(Command):
    """Merges the splats that are most alike: fewer splats that look the same, and none are dropped.

    Writes a preview and the configuration beside them.
    """

    EXCLUSIVE = (("count", "share"), ("cameras", "data"))
    CONFIGURABLE = True

    input: tyro.conf.Positional[Path]
    """Splat file, or the folder of a trained model."""
    output: option.Output
    """The splats: .ply, .spz, .sog or another format."""
    count: option.Count = None
    """Number of splats to keep."""
    share: option.Number = None
    """Share of the splats to keep, above 0 to 1: 0.25 keeps a quarter."""
    cameras: option.File = None
    """Cameras that the splats will be seen from: a JSON list, a cameras.json of a 3DGS trainer, or the model
    folder that has one. Detail finer than their pixels goes first. Default: those of the input if it is a
    model folder, else images of 1000 pixels that hold the subject."""
    data: option.Folder = None
    """Data set of photographs, in place of --cameras: the cameras of its training views."""
    missing: option.Missing = "few"
    no_preview: bool = False
    """Write no preview."""
    origin: option.Origin = "keep"
    reading: SplatOptions = field(default_factory=SplatOptions)
    threads: option.Threads = None
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.conversion.merging import simplify
        from meshsplats.formats.gaussians import save_gaussians

        self._check()
        preview, config = beside(self.output, PREVIEW), beside(self.output, CONFIGURATION)
        outputs = [self.output, config] if self.no_preview else [self.output, preview, config]
        check_outputs(outputs, self.force, inputs=[self.input])
        if identify(self.input) != "splats":
            raise FileFormatError(f"{self.input}: not splats; simplify needs a splat file or a model folder")
        cloud = self.reading.load(self.input)
        cameras = cameras_named(self.cameras, self.data, self.missing, cloud.origin)
        if cameras is None:
            cameras = cameras_beside(self.input, cloud.origin)
        start = time.perf_counter()
        count = self.count if self.share is None else max(1, round(self.share * len(cloud)))
        assert count is not None
        kept = simplify(cloud, count, cameras=cameras, threads=self.threads)
        seconds = time.perf_counter() - start
        placed = written(kept, self.origin)
        with together():
            save_gaussians(placed, self.output)
            write_configuration(config, "simplify", self)
            if not self.no_preview:
                draw_preview(kept, preview)
        result = {
            "splats": str(self.output),
            "preview": None if self.no_preview else str(preview),
            "read": len(cloud),
            "written": len(kept),
            "bytes": self.output.stat().st_size,
            "seconds": round(seconds, 4),
        }
        made = f"{len(cloud):,} splats -> {len(kept):,} ({len(kept) / len(cloud):.1%}) in {seconds:.2f} s"
        more = [] if self.no_preview else [f"preview: {preview}"]
        self.finish(result, made, named(self.output), *more)

    def _check(self) -> None:
        """UsageError for options that contradict each other or are out of range."""
        check_splat_endings(written_ending(self.output.name))
        if (self.count is None) == (self.share is None):
            raise UsageError("give --count or --share, one of them")
        if self.count is not None and self.count < 1:
            raise UsageError(f"--count must be at least 1, got {self.count}")
        if self.share is not None and not 0 < self.share <= 1:
            raise UsageError(f"--share must be above 0 and at most 1, got {self.share}")
        check_photographs(self.data, self.missing, self.cameras)
