"""``meshsplats compare``: scores of a mesh against its splats."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from meshsplats.cli import option
from meshsplats.cli.arguments import Command, Flat, as_cli_options
from meshsplats.cli.common import PartOptions, SplatOptions, print_table, track
from meshsplats.cli.images import DrawOptions, ViewOptions
from meshsplats.cli.messages import say
from meshsplats.cli.records import write_configuration
from meshsplats.datasets.scene_views import WAYS_OF_VIEWS
from meshsplats.evaluation.options import ComparisonOptions
from meshsplats.formats.outputs import CONFIGURATION


@as_cli_options(presets=False)
class CompareOptions(ComparisonOptions):
    views: ViewOptions
    draw: DrawOptions
    reading: SplatOptions
    part: PartOptions


@dataclass(frozen=True)
class Compare(Command):
    """Renders splats and mesh from the same cameras: PSNR and SSIM per view, and strips splats | mesh |
    error."""

    COMMON = (
        *("splats", "mesh", "output", "preset", "look", "orbit", "look_around", "cameras"),
        *("data", "downscale", "width", "background", "crop", "json", "force"),
    )
    EXCLUSIVE = WAYS_OF_VIEWS
    CONFIGURABLE = True

    splats: tyro.conf.Positional[Path]
    """Splat file or model folder."""
    mesh: tyro.conf.Positional[option.File] = None
    """The mesh to compare; may be left out: the splats are then converted with --preset for these cameras."""
    output: option.Output = tyro.MISSING
    """Folder for strips, results.json, cameras.json and config.toml."""
    how: Annotated[CompareOptions, Flat] = field(default_factory=CompareOptions)
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.evaluation.comparison_files import save_comparison
        from meshsplats.rendering.looks import comparison_in_words

        made = save_comparison(
            self.splats,
            self.mesh,
            self.output,
            self.how,
            force=self.force,
            say=say,
            progress=partial(track, label="comparing"),
        )
        write_configuration(self.output / CONFIGURATION, "compare", self)
        scores, result = made.scores, made.result
        if not self.json:
            rows = [(view.name, f"{view.psnr:.2f}", f"{view.ssim:.4f}") for view in scores.views]
            rows.append(("mean", f"{scores.psnr:.2f}", f"{scores.ssim:.4f}"))
            print_table(("view", "PSNR dB", "SSIM"), rows)
        self.finish(
            result,
            comparison_in_words(result["look"], result["samples"]),
            f"{result['splats']:,} splats against {result['triangles']:,} triangles,"
            f" {result['seconds']:.1f} s",
            f"background: {made.background.describe()}",
            f"strips splats | mesh | error x {self.how.amplify:g}: {self.output}/",
        )
