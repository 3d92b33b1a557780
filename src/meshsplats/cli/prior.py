"""``meshsplats prior``: splats on a classical mesh, trained on photographs or on splats."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from meshsplats._common.words import quoted
from meshsplats.cli import option
from meshsplats.cli.arguments import as_cli_options
from meshsplats.cli.common import SplatOptions
from meshsplats.cli.messages import say
from meshsplats.cli.training import TrainingCommand, tuning_options
from meshsplats.finetuning.config import CUTTING, FinetuneConfig
from meshsplats.prior.options import LayingOptions, prior_config

if TYPE_CHECKING:
    from meshsplats.finetuning.checkpoint import Checkpoint
    from meshsplats.finetuning.plans import Plan
    from meshsplats.finetuning.run_files import RunFiles
    from meshsplats.finetuning.setup import Setup
    from meshsplats.prior.planning import PriorTraining


# Layers on a base share a depth, which only the order of fragments knows, and are never cut.
@tuning_options({"default": prior_config()}, without=("order", *CUTTING))
class PriorTuningOptions(FinetuneConfig):
    """The optimisation."""


@as_cli_options(presets=False)
class LayOptions(LayingOptions):
    """Splats on the base."""


@dataclass(frozen=True)
class Prior(TrainingCommand):
    """Binds splats to a mesh and optimises them until they match photographs, or other splats.

    They follow the mesh: 'meshsplats deform' moves them as the mesh is edited. Beside the result NAME: its
    configuration, a preview, and a folder NAME.run with metrics, previews and a checkpoint, from which
    --resume continues.
    """

    COMMON = (
        *("input", "output", "data", "splats", "minutes", "steps", "triangles", "layers"),
        *("colors", "texture", "downscale", "width", "threads", "resume", "json", "force"),
    )
    EXCLUSIVE = (("epochs", "steps", "minutes"), ("data", "splats"), ("data", "cameras"))

    input: tyro.conf.Positional[Path]
    """Base mesh: .obj, .ply, .glb, .gltf, .npz, USD; in the frame of the photographs or splats."""
    output: option.Output
    """The result with its binding to the base: .npz, which keeps everything, or .glb."""
    splats: option.File = None
    """Splats whose images are the targets, in place of --data: a file or a model folder."""
    laying: LayOptions = field(default_factory=LayOptions)
    tuning: PriorTuningOptions = field(default_factory=PriorTuningOptions)  # type: ignore[assignment]
    reading: SplatOptions = field(default_factory=SplatOptions)

    @property
    def inputs(self) -> list[Path]:
        return [path for path in (self.input, self.splats) if path]

    def configured(self) -> FinetuneConfig:
        return prior_config(**self.explicit_settings())

    def check(self) -> None:
        self._training.check()
        super().check()

    def plan(self, config: FinetuneConfig, earlier: Checkpoint | None, setup: Setup) -> Plan:
        return self._training.plan(config, earlier)

    def next_steps(self, files: RunFiles, config: FinetuneConfig, plan: Plan) -> list[str]:
        return [
            f"next: edit {self.input}, moving its vertices, and",
            f"  meshsplats deform {quoted(str(files.mesh))} --base edited.obj -o edited.glb",
        ]

    @property
    def _training(self) -> PriorTraining:
        from meshsplats.prior.planning import PriorTraining

        given = (self.input, self.output, self.laying, self.target, self.splats, self.reading)
        return PriorTraining(*given, say, self.threads)
