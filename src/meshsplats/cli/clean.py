"""``meshsplats clean``: splats or a mesh without floaters."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from meshsplats._files.atomic import together
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, as_cli_options
from meshsplats.cli.common import SplatOptions, named, written
from meshsplats.cli.messages import shown_path
from meshsplats.conversion.cleaning import FLOATERS, CleaningRules, Findings, find, remove, save_strip
from meshsplats.errors import StraysWarning
from meshsplats.formats.outputs import (
    PREVIEW,
    beside,
    check_mesh_suffix,
    check_outputs,
    check_splat_endings,
)
from meshsplats.formats.splat_formats import written_ending
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh


@as_cli_options(
    "Rules: splats with any of these properties are removed."
    f" Default: --max-size {FLOATERS.max_size:g} --sparse {FLOATERS.sparse} --min-part {FLOATERS.min_part}.",
)
class RuleOptions(CleaningRules):
    pass


@dataclass(frozen=True)
class Clean(Command):
    """Removes floaters: splats that are faint, far away, alone, or in small separate parts.

    By default, walls and skies of a place stay, which the rules alone would take for floaters: it is looked
    at from within. Prints what each rule removes. NAME.preview.png beside the result NAME shows before |
    removed, in red | after.
    """

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, or a mesh."""
    output: option.Output
    """The remaining splats: .ply, .spz, .sog or others; a mesh: .glb, .npz, .ply, .usdc, .obj."""
    rules: RuleOptions = field(default_factory=RuleOptions)
    preview_only: bool = False
    """Print and draw what would be removed, but write no result."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    threads: option.Threads = None
    origin: option.Origin = "keep"
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        from meshsplats.conversion.surroundings import floaters
        from meshsplats.evaluation.viewers import alpha_for_viewers
        from meshsplats.formats.gaussians import save_gaussians
        from meshsplats.formats.meshes import save_mesh

        start = time.perf_counter()
        preview = beside(self.output, PREVIEW)
        outputs = [preview] if self.preview_only else [self.output, preview]
        check_outputs(outputs, self.force, inputs=[self.input])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", StraysWarning)  # which names this command
            scene = self.reading.load_scene(self.input)
        if isinstance(scene, GaussianCloud):
            check_splat_endings(written_ending(self.output.name))
        else:
            check_mesh_suffix(self.output)
        explicit = any(value is not None for value in vars(self.rules).values())
        rules = self.rules if explicit else FLOATERS
        found = find(scene, rules) if explicit else floaters(scene, self.input, threads=self.threads)
        left = remove(scene, found)
        alpha = {}
        result = left if self.preview_only else written(left, self.origin)
        if isinstance(left, SplatMesh) and not self.preview_only:
            alpha = alpha_for_viewers(left, self.output, self.threads)
        with together():
            if not self.preview_only:
                if isinstance(result, SplatMesh):
                    save_mesh(result, self.output, **alpha)
                else:
                    save_gaussians(result, self.output)
            save_strip(scene, left, found, preview, self.threads)
        self._print_result(rules, found, left, preview, time.perf_counter() - start)

    def _print_result(
        self,
        rules: CleaningRules,
        found: Findings,
        left: GaussianCloud | SplatMesh,
        preview: Path,
        seconds: float,
    ) -> None:
        places = left.means if isinstance(left, GaussianCloud) else left.vertices
        lower, upper = (
            [round(float(v), 4) for v in side + left.origin]
            for side in (places.min(axis=0), places.max(axis=0))
        )
        counts, kept = found.counts(), int(found.kept.sum())
        around = counts.pop("surroundings", None)
        result = {
            "input": shown_path(self.input),
            "output": None if self.preview_only else str(self.output),
            "preview": str(preview),
            "splats": len(found.opacities),
            "kept": kept,
            "removed": counts,
            "surroundings": around,
            "lower": lower,
            "upper": upper,
            "seconds": round(seconds, 3),
        }
        lines = [*found.in_words(rules), f"kept: {kept:,} splats, from {lower} to {upper}"]
        lines += [] if self.preview_only else [named(self.output)]
        self.finish(result, *lines, f"preview, before | removed, in red | after: {preview}", indent=None)
