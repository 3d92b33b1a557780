"""Options of targets: photographs, or images of the splats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from meshsplats._options import changed
from meshsplats.cli.arguments import as_cli_options, spelled
from meshsplats.cli.messages import UsageError
from meshsplats.datasets.views import Dataset
from meshsplats.finetuning.targets import PLACING, Targets
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh


@as_cli_options(metavars={"data": "FOLDER", "cameras": "FILE", "up": "TEXT"}, presets=False)
class TargetOptions(Targets):
    """Targets: photographs (--data), else images of the splats."""

    def check(self) -> None:
        """UsageError for options without effect."""
        idle = ("views", "held_out", "width", *PLACING, "below", "cameras", "look", "sh_degree")
        of_data = ("downscale", "test_every", "missing", "masks")
        names, source = (idle, "--data") if self.data is not None else (of_data, "splats")
        given = changed(self)
        for name in names:
            if name in given:
                raise UsageError(f"{spelled(type(self), name)} has no effect with {source}")
        for name in (*PLACING, "below"):
            if self.cameras is not None and name in given:
                raise UsageError(f"{spelled(type(self), name)} has no effect with --cameras")
        if self.views is not None and self.views < 1:
            raise UsageError(f"--views must be at least 1, got {self.views}")
        if not self.cache >= 0:
            raise ValueError(f"--cache must be a number of gigabytes, >= 0, got {self.cache}")

    def make(self, scene: GaussianCloud | SplatMesh, source: Path, *more: Any) -> Dataset:
        if self.data is None and not isinstance(scene, GaussianCloud):
            raise UsageError(f"{source} is a mesh: give its photographs with --data, or splats in its place")
        return super().make(scene, source, *more)
