"""``meshsplats evaluate``: scores against held-out photographs, or against images of the splats."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from meshsplats.cli import option
from meshsplats.cli.arguments import Command, Flat, as_cli_options
from meshsplats.cli.common import ClusterOptions, SplatOptions, print_table, track
from meshsplats.cli.messages import UsageError
from meshsplats.cli.records import write_configuration
from meshsplats.formats.outputs import CONFIGURATION
from meshsplats.operations.options import ScoringOptions

Files = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]


@as_cli_options(presets=False)
class EvaluateOptions(ScoringOptions):
    lpips: Files = ()
    reading: SplatOptions


@dataclass(frozen=True)
class Evaluate(Command):
    """Scores images of meshes and splats on held-out views: PSNR, SSIM and LPIPS of each view, means and
    medians, and strips ground truth | mesh | splats | error.

    results.json and per_view.json have the structure of those of the 3DGS code; report.json has everything.
    """

    COMMON = (
        *("mesh", "output", "data", "splats", "before", "cameras", "downscale", "test_every"),
        *("look", "background", "samples", "lpips", "fit_exposure", "threads", "json", "force"),
    )
    EXCLUSIVE = (("data", "cameras"),)
    CONFIGURABLE = True

    mesh: tyro.conf.Positional[Files] = ()
    """The mesh, or several, to score side by side. With --protocol: a folder with a mesh, splats or a model
    folder for each scene, by its name."""
    output: option.Output = tyro.MISSING
    """Folder for the results."""
    how: Annotated[EvaluateOptions, Flat] = field(default_factory=EvaluateOptions)
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    threads: option.Threads = None
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.evaluation.report import SSIM_CONVENTION
        from meshsplats.evaluation.results import notes
        from meshsplats.evaluation.strips import score_table
        from meshsplats.operations.scoring import Scoring

        self.how.check(self.mesh)
        here = self.cluster.cluster is None  # workers share a terminal
        if self.how.protocol is None and not here:
            raise UsageError("--cluster is for the scenes of --protocol")
        start = time.perf_counter()
        scoring = Scoring(
            self.how, self.output, self.threads, partial(track, label="scoring") if here else None
        )
        if self.how.protocol is None:
            reports = [scoring.run(self.mesh, force=self.force)]
        else:
            reports = scoring.run_benchmark(self.mesh[0], self.cluster.workers, force=self.force)
        seconds = round(time.perf_counter() - start, 2)
        write_configuration(self.output / CONFIGURATION, "evaluate", self)
        if not self.json:
            print_table(*score_table(reports, {}), left=2)
        self.finish(
            {"scenes": [report.to_dict() for report in reports], "seconds": seconds},
            *notes(reports),
            f"SSIM: convention {SSIM_CONVENTION!r}; {seconds:.1f} s; {self.output}/",
        )
