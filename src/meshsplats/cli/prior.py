"""``meshsplats prior``: splats on a classical mesh, trained on photographs or on splats."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from meshsplats.base_mesh import BaseMesh
from meshsplats.cameras.framing import guess_up
from meshsplats.cli import option
from meshsplats.cli.common import SplatOptions
from meshsplats.cli.messages import UsageError, quoted
from meshsplats.cli.training import (
    Plan,
    Trained,
    TrainingCommand,
    over_background,
    tuning_options,
)
from meshsplats.datasets.views import Dataset
from meshsplats.finetuning import FinetuneConfig, RunOptions, worthwhile_views
from meshsplats.finetuning.checkpoint import Checkpoint, as_begun
from meshsplats.finetuning.run_files import RunFiles
from meshsplats.finetuning.setup import Display, Setup
from meshsplats.formats.mesh_formats import keeps, written_mesh_suffixes
from meshsplats.mesh import SplatMesh
from meshsplats.prior import bind, prior_config, train_prior
from meshsplats.prior.bind import LAYERS


# Layers on a base share a depth, which only the order of fragments knows.
@tuning_options(lambda name: f"(default: {getattr(prior_config(), name)})", without=("order",))
class PriorTuningOptions(FinetuneConfig):
    """The optimisation."""


@dataclass(frozen=True)
class LayOptions:
    """Splats on the base."""

    triangles: int = 1
    """Triangles on each face, in each layer: 1 to 256; square numbers avoid T-junctions."""
    by_area: bool = False
    """Take --triangles as the mean, with more on larger faces."""
    layers: int = LAYERS
    """Layers of triangles on each face: 1 to 16."""
    spacing: option.Number = None
    """Distance between layers along the base's normals, scene units; below 0 inwards; 0: all layers lie in
    the base. Default: inwards, all layers together 1/30 of the diagonal of the base's box."""
    colors: Literal["auto", "texture", "vertices", "views", "grey"] = "auto"
    """Initial colours: the base's texture, its vertex colours, or the images that see a point most squarely;
    auto: the first of these that exists."""
    texture: option.File = None
    """Image for the base's texture coordinates, if its file names none."""


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
        if not keeps(self.output, "binding"):
            known = " or ".join(s for s in written_mesh_suffixes() if keeps(f"mesh{s}", "binding"))
            raise UsageError(f"-o must end in {known}, which keep the binding, got {self.output.name!r}")
        if self.splats is not None and self.target.data is not None:
            raise UsageError("give --data or --splats, not both")
        if self.splats is None and self.target.data is None:
            raise UsageError("give photographs with --data, or splats with --splats, as targets")
        if self.laying.texture is not None and self.laying.colors not in ("auto", "texture"):
            raise UsageError(f"--texture has no effect with --colors {self.laying.colors}")
        if self.laying.spacing and self.laying.layers == 1:
            raise UsageError("--spacing has no effect with one layer; give --layers")
        super().check()

    def plan(self, config: FinetuneConfig, earlier: Checkpoint | None, setup: Setup) -> Plan:
        from meshsplats.formats.base_meshes import load_base

        wants_texture = self.laying.colors in ("auto", "texture")
        base = load_base(self.input, texture=self.laying.texture, textures=wants_texture)
        dataset = self._dataset(base, config, earlier)
        cameras = [view.camera for view in dataset.train]
        up = guess_up(_grey_mesh(base), cameras)
        pattern = {name: getattr(self.laying, name) for name in ("triangles", "by_area", "layers", "spacing")}
        prior = bind(
            replace(base, up=up),
            **pattern,
            colors=self.laying.colors,
            views=dataset.train,
            threads=self.threads,
        )
        background = None
        if self.target.data is not None:
            dataset, background = over_background(
                dataset, prior.mesh, config, self.input, self.threads, whole=False
            )
        summary = f"{len(base.faces):,} faces carry {len(prior.mesh.faces):,} triangles"

        def optimise(run: RunOptions, show: Display) -> Trained:
            trained = train_prior(prior, dataset, config, run=run, on_progress=show)
            counts = {"base_faces": len(trained.base_faces), "triangles": len(trained.mesh.faces)}
            made = f"{counts['triangles']:,} triangles on {counts['base_faces']:,} faces"
            return Trained(trained.in_file(self.output), trained.mesh, counts, made)

        return Plan(prior.mesh, dataset, summary, background, optimise)

    def next_steps(self, files: RunFiles, config: FinetuneConfig, plan: Plan) -> list[str]:
        return [
            f"next: edit {self.input}, moving its vertices, and",
            f"  meshsplats deform {quoted(str(files.mesh))} --base edited.obj -o edited.glb",
        ]

    def _dataset(self, base: BaseMesh, config: FinetuneConfig, earlier: Checkpoint | None) -> Dataset:
        background = config.behind_splats
        if self.splats is None:
            return self.target.make(_grey_mesh(base), self.input, background, self.threads)
        cloud = self.reading.load(self.splats, base.origin)
        views = worthwhile_views(as_begun(config, earlier))
        return self.target.make(cloud, self.splats, background, self.threads, views)


def _grey_mesh(base: BaseMesh) -> SplatMesh:
    grey = np.full((len(base.vertices), 4), 0.5, np.float32)
    return SplatMesh(base.vertices, base.faces, grey, up=base.up, origin=base.origin)
