"""``meshsplats prior``: splats on a classical mesh, trained on photographs or on splats."""

from __future__ import annotations

import shlex
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import tyro

from meshsplats.base_mesh import BaseMesh
from meshsplats.camera import Camera
from meshsplats.cameras.framing import guess_up
from meshsplats.cli import UsageError
from meshsplats.cli.common import Count, File, Number, Output, SplatOptions, configuration, write_json
from meshsplats.cli.targets import TargetOptions
from meshsplats.cli.training import (
    STARTING_UP,
    RunFiles,
    announce,
    background_of,
    behind,
    described,
    draw_preview,
    earlier_part,
    given,
    naming_options,
    note_command,
    run_options,
    shown,
    stopped,
    tell,
)
from meshsplats.datasets.views import Dataset
from meshsplats.finetuning import FinetuneConfig, Interrupted, worthwhile_views
from meshsplats.finetuning.checkpoint import Checkpoint, OtherRunError
from meshsplats.mesh import SplatMesh
from meshsplats.prior import MeshPrior, bind, prior_config, train_prior
from meshsplats.prior.bind import LAYERS

SUFFIXES = (".npz", ".glb")

if TYPE_CHECKING:
    _Training = FinetuneConfig
else:
    _Training = described(FinetuneConfig, prior_config())


@dataclass(frozen=True)
class LayOptions:
    """How splats are laid on the base."""

    triangles: int = 1
    """Triangles on each face, in each layer: 1 to 256; square numbers fit without T-junctions."""
    by_area: bool = False
    """So many on average, more on larger faces."""
    layers: int = LAYERS
    """Layers of triangles on each face: 1 to 16."""
    spacing: Number = None
    """Scene units from one layer to the next along the base's normals; below 0 inwards. 0: all layers lie in
    the base. Default: inwards, all together 1/30 of the diagonal of the base's box."""
    colors: Literal["auto", "texture", "vertices", "views", "grey"] = "auto"
    """Where colours begin: the base's texture, its vertex colours, the pictures that see a place most
    squarely; auto: the first of these that there is."""
    texture: File = None
    """Image that is laid on the base by its texture coordinates, where its file names none."""


@dataclass(frozen=True)
class Prior:
    """Lays splats on a mesh and optimises them until they look like photographs, or like other splats.

    They stay bound to the mesh: 'meshsplats deform' moves them as the mesh is edited. Beside the result: its
    configuration, a preview picture, and a folder NAME.run with metrics, previews and a checkpoint, from
    which --resume goes on.
    """

    input: tyro.conf.Positional[Path]
    """Base mesh: .obj, .ply, .glb, .gltf, .npz, USD. In the frame of the photographs or splats."""
    output: Output
    """The result with its binding to the base: .npz, which keeps everything exactly, or .glb."""
    splats: File = None
    """Splats to learn from, in place of --data: a file or a model folder."""
    epochs: Number = None
    """Length: so many times all training views."""
    steps: Count = None
    """Length: so many steps."""
    minutes: Number = None
    """Length: so much time for the whole command."""
    resume: bool = False
    """Go on where an interrupted run of the same command stopped; with --force also after its end, for
    longer."""
    laying: LayOptions = field(default_factory=LayOptions)
    target: TargetOptions = field(default_factory=TargetOptions)
    tuning: _Training = field(default_factory=_Training)
    reading: SplatOptions = field(default_factory=SplatOptions)
    report_every: int = 100
    """Steps from one score on held-out views to the next."""
    preview_every: int = 500
    """Steps from one preview picture of the run to the next; after each quarter of a short run. 0: none."""
    threads: Count = None
    """At most N threads. Default: all processors."""
    json: bool = False
    """Print the result as JSON."""
    force: bool = False
    """Overwrite existing outputs."""

    def run(self) -> int:
        from meshsplats.formats.base_meshes import load_base
        from meshsplats.formats.meshes import save_mesh

        began = time.perf_counter() - STARTING_UP
        config = self.configured()
        self._check()
        files = RunFiles(self.output)
        inputs = [path for path in (self.input, self.splats) if path]
        files.check(inputs, resume=self.resume, force=self.force)
        wants_texture = self.laying.colors in ("auto", "texture")
        base = load_base(self.input, texture=self.laying.texture, textures=wants_texture)
        earlier = earlier_part(self, files)
        dataset = self._dataset(base, config, earlier)
        up = guess_up(SplatMesh(base.vertices, base.faces, _grey(base), up=base.up), _cameras(dataset))
        laid = {name: getattr(self.laying, name) for name in ("triangles", "by_area", "layers", "spacing")}
        prior = bind(
            replace(base, up=up),
            **laid,
            colors=self.laying.colors,
            views=dataset.train,
            threads=self.threads,
        )
        record = configuration("prior", self) | {"tuning": config.to_dict()}
        if self.target.data is not None:
            dataset, background = behind(dataset, prior.mesh, config, self.input, self.threads, whole=False)
            record |= background.to_dict()
        what = f"{len(base.faces):,} faces carry {len(prior.mesh.faces):,} triangles"
        announce(what, prior.mesh, dataset, self.target.cache_bytes)
        options = run_options(self, files, began)
        try:
            with files.claimed(inputs, resume=self.resume, force=self.force), shown() as show:
                note_command("prior", self, files)
                trained = train_prior(prior, dataset, config, run=options, on_progress=show)
        except Interrupted as stop:
            return stopped(stop, files)
        except OtherRunError as error:
            raise naming_options(error, "prior", self, files) from None
        save_mesh(exported(trained, files.mesh), files.mesh)
        write_json(files.config, record)
        draw_preview(trained.mesh, files.preview)
        counts = {"base_faces": len(trained.base_faces), "triangles": len(trained.mesh.faces)}
        made = f"{counts['triangles']:,} triangles on {counts['base_faces']:,} faces"
        tell(self, files, time.perf_counter() - began, earlier, counts, made)
        if not self.json:
            print(f"next: edit {self.input}, moving its vertices, and")
            print(f"  meshsplats deform {shlex.quote(str(files.mesh))} --base edited.obj -o edited.glb")
        return 0

    def configured(self) -> FinetuneConfig:
        """The configuration with what was given."""
        return prior_config(**given(self))

    def _check(self) -> None:
        """UsageError for options that contradict each other or would do nothing."""
        if self.output.suffix.lower() not in SUFFIXES:
            known = " or ".join(SUFFIXES)
            raise UsageError(f"-o must end in {known}, which keep the binding, got {self.output.name!r}")
        if self.splats is not None and self.target.data is not None:
            raise UsageError("give --data or --splats, not both")
        if self.splats is None and self.target.data is None:
            raise UsageError("give photographs with --data, or splats with --splats, to learn from")
        if self.laying.texture is not None and self.laying.colors not in ("auto", "texture"):
            raise UsageError(f"--texture has no effect with --colors {self.laying.colors}")
        if self.laying.spacing and self.laying.layers == 1:
            raise UsageError("--spacing has no effect with one layer; give --layers")
        self.target.check()

    def _dataset(self, base: BaseMesh, config: FinetuneConfig, earlier: Checkpoint | None) -> Dataset:
        background = background_of(config)
        if self.splats is None:
            mesh = SplatMesh(base.vertices, base.faces, _grey(base))
            return self.target.make(mesh, self.input, background, self.threads)
        cloud = self.reading.load(self.splats)
        worthwhile = earlier.views if earlier and earlier.views else worthwhile_views(config)
        return self.target.make(cloud, self.splats, background, self.threads, worthwhile)


def exported(prior: MeshPrior, path: Path) -> SplatMesh:
    """The mesh of ``prior`` as it stands, for the format of ``path``: layers that are coplanar are set apart
    by ``export_lift`` where other programs are to draw them."""
    if path.suffix.lower() == ".npz":
        return prior.mesh
    return prior.pose(lift=prior.export_lift)


def _grey(base: BaseMesh) -> np.ndarray:
    return np.full((len(base.vertices), 4), 0.5, np.float32)


def _cameras(dataset: Dataset) -> list[Camera]:
    return [view.camera for view in dataset.train]
