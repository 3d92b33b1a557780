"""``meshsplats finetune``: a mesh that looks better, from photographs or from the splats alone."""

from __future__ import annotations

import shlex
import time
import warnings
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from meshsplats.cameras.files import save_cameras
from meshsplats.cli.common import (
    Count,
    Number,
    Output,
    SplatOptions,
    check_mesh_suffix,
    configuration,
    load_scene,
    write_json,
)
from meshsplats.cli.convert import StartOptions as ConversionOptions
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
from meshsplats.conversion.selection import choose_splats
from meshsplats.datasets.views import Dataset, ViewImage
from meshsplats.errors import DataWarning
from meshsplats.evaluation.backgrounds import Background
from meshsplats.finetuning import (
    FinetuneConfig,
    Interrupted,
    finetune,
    make_config,
    starting_mesh,
    worthwhile_views,
)
from meshsplats.finetuning.checkpoint import OtherRunError
from meshsplats.finetuning.step import samples_of
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    _Tuning = FinetuneConfig
else:
    _Tuning = described(FinetuneConfig)


@dataclass(frozen=True)
class Finetune:
    """Optimises a mesh until its pictures are those of the splats, or of photographs.

    Splats are converted first. Beside the result: its configuration, a preview picture, and a folder NAME.run
    with metrics, previews and a checkpoint, from which --resume goes on after Ctrl-C or a kill.
    """

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, or, with --data, a mesh."""
    output: Output
    """The tuned mesh: .npz or .ply, which keep everything; .glb, .usdc, .obj."""
    preset: Literal["default", "paper", "published"] = "default"
    """default: the best measured at equal time. paper: the values in the text of the MeshSplats paper.
    published: the rates of its code."""
    epochs: Number = None
    """Length: so many times all training views."""
    steps: Count = None
    """Length: so many steps."""
    minutes: Number = None
    """Length: so much time for the whole command."""
    start: Literal["same", "default", "paper"] = "same"
    """What the splats are converted to; same: as --preset has it. default: one ellipse of 8 triangles a
    splat. paper: the paper's conversion, also for published."""
    resume: bool = False
    """Go on where an interrupted run of the same command stopped; with --force also after its end, for
    longer."""
    target: TargetOptions = field(default_factory=TargetOptions)
    tuning: _Tuning = field(default_factory=_Tuning)
    conversion: ConversionOptions = field(default_factory=ConversionOptions)
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
        from meshsplats.formats.meshes import save_mesh

        began = time.perf_counter() - STARTING_UP
        check_mesh_suffix(self.output)
        config = self.configured()
        self.target.check()
        files = RunFiles(self.output)
        files.check([self.input], resume=self.resume, force=self.force)
        scene = load_scene(self.input, self.reading)
        if isinstance(scene, GaussianCloud) and self.conversion.crop is not None:
            # Pictures of what is cut off are nothing to learn from; other choices of splats leave gaps that
            # the rest has to fill.
            scene = choose_splats(scene, crop=self.conversion.crop)
        earlier = earlier_part(self, files)
        # A run that is made longer goes on with the views that it has.
        worthwhile = earlier.views if earlier and earlier.views else worthwhile_views(config)
        dataset = self.target.make(
            scene, self.input, background_of(config), self.threads, worthwhile, self.preset
        )
        background = None
        if self.target.data is not None:
            whole = self.conversion.crop is None
            if not whole:
                _warn_of_the_rest(dataset.train[0].load())
            dataset, background = behind(dataset, scene, config, self.input, self.threads, whole=whole)
        mesh = scene if isinstance(scene, SplatMesh) else self._converted(scene, dataset)
        what = f"{len(mesh.faces):,} triangles"
        if isinstance(scene, GaussianCloud) and (mesh.splat_count or 0) < len(scene):
            what += f" of {mesh.splat_count:,} splats, {len(scene):,} before"
        announce(what, mesh, dataset, self.target.cache_bytes)
        options = run_options(self, files, began)
        try:
            with files.claimed([self.input], resume=self.resume, force=self.force), shown() as show:
                note_command("finetune", self, files)
                tuned = finetune(mesh, dataset, config, run=options, on_progress=show)
        except Interrupted as stop:
            return stopped(stop, files)
        except OtherRunError as error:
            raise naming_options(error, "finetune", self, files) from None
        save_mesh(tuned, files.mesh)
        record = configuration("finetune", self) | {"tuning": config.to_dict()}
        write_json(files.config, record | ({} if background is None else background.to_dict()))
        if self.target.data is None and dataset.test:
            save_cameras([view.camera for view in dataset.test], files.held_out)
        draw_preview(tuned, files.preview)
        triangles = len(tuned.faces)
        seconds = time.perf_counter() - began
        tell(self, files, seconds, earlier, {"triangles": triangles}, f"{triangles:,} triangles")
        if not self.json:
            print(f"next: {self._next(files, config, background, dataset)}")
        return 0

    def configured(self) -> FinetuneConfig:
        """The preset with what was given."""
        return make_config(self.preset, **given(self))

    def _converted(self, cloud: GaussianCloud, dataset: Dataset) -> SplatMesh:
        start = self.preset if self.start == "same" else self.start
        cameras = [view.camera for view in dataset.train]
        options = asdict(self.conversion) | {"crop": None}  # that is done
        del options["look"]
        return starting_mesh(cloud, cameras, preset=start, look=dataset.look, **options)

    def _next(
        self, files: RunFiles, config: FinetuneConfig, background: Background | None, dataset: Dataset
    ) -> str:
        """The command that scores the result as it was trained, or one that shows it where there is none."""
        target, folder = self.target, self.output.with_suffix("")
        if self.conversion.crop is not None or (target.data is None and not dataset.test):
            return shlex.join(["meshsplats", "render", str(self.output), "-o", f"{folder}-pictures"])
        words: list[str | Path | int] = ["meshsplats", "evaluate", self.output]
        if target.data is not None:
            words += ["--data", target.data]
            words += ["--downscale", target.downscale] if target.downscale != 1 else []
            words += ["--test-every", target.test_every] if target.test_every != 8 else []
        else:
            words += ["--splats", self.input, "--cameras", files.held_out, *self.reading.again()]
            words += ["--look", dataset.look] if dataset.look != "area" else []
            words += ["--sh-degree", target.sh_degree] if target.sh_degree is not None else []
        if background is not None:
            words += ["--background", background.name]
        elif config.background == "black":
            words += ["--background", "black"]
        words += ["--samples", samples_of(dataset.train[0], config)]
        words += ["-o", f"{folder}-evaluation"]
        return shlex.join(map(str, words))


def _warn_of_the_rest(picture: ViewImage) -> None:
    if picture.alpha is None and picture.mask is None:
        warnings.warn(
            "--crop with photographs that have neither masks nor alpha: what it cuts off is still on them,"
            " and will be painted on the rest; to have a part, cut the tuned mesh",
            DataWarning,
            stacklevel=2,
        )
