"""``meshsplats evaluate``: scores against held-out photographs, or against images of the splats."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from meshsplats._origin import shared_origin
from meshsplats._words import optional_color, parse_color
from meshsplats.cameras.files import load_cameras
from meshsplats.cli import option
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import ClusterOptions, SplatOptions, print_table, track
from meshsplats.cli.messages import UsageError, flag
from meshsplats.cli.records import write_configuration
from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.scene_views import check_photographs
from meshsplats.datasets.splat_targets import splat_views
from meshsplats.datasets.views import WHITE, Dataset
from meshsplats.errors import FileFormatError
from meshsplats.evaluation.backgrounds import Background, choose_background
from meshsplats.evaluation.benchmarks import BENCHMARKS, Benchmark, Candidates, convert_scene, run_benchmark
from meshsplats.evaluation.report import SSIM_CONVENTION, Report, ScoredView, evaluate
from meshsplats.evaluation.results import (
    PER_VIEW,
    REPORT,
    RESULTS,
    TABLE,
    Strips,
    notes,
    save_benchmark,
    save_report,
)
from meshsplats.evaluation.strips import image_folder, mesh_names, score_table
from meshsplats.finetuning.targets import Targets
from meshsplats.formats.outputs import CONFIGURATION, check_outputs, view_names
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

Files = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]


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
    data: option.Folder = None
    """Data set of photographs; with --protocol the folder of its scenes. Default: images of the splats."""
    before: option.File = None
    """Another mesh to score, such as the one before fine-tuning."""
    splats: option.File = None
    """The splats. With --data: scored, too, at SH degree 0 and with all spherical harmonics. Without: their
    images are the ground truth (also scored at SH degree 0)."""
    images: option.Folder = None
    """Images by other programs to score, such as Blender: a file for each view, by its name or in order."""
    cameras: option.File = None
    """Without --data: cameras. Default: those that finetune holds out."""
    look: Literal["area", "splats"] = "area"
    """Without --data: kind of ground truth. area: means over each pixel's area, as in programs that take
    several samples per pixel. splats: images of a 3DGS viewer at this size."""
    sh_degree: option.Count = None
    """Without --data: SH degree of the ground truth. Default: all that are stored."""
    lpips: Files = ()
    """Weights of LPIPS, files or a folder: torchvision's vgg16-397923af.pth and vgg.pth of the package lpips,
    or one file of both (see docs/finetuning.md). Default: no LPIPS."""
    network: Literal["vgg", "alex"] = "vgg"
    """Network of LPIPS; splatting papers use vgg."""
    fit_exposure: bool = False
    """Also score with a gain and an offset per channel, fitted to each image."""
    samples: option.Count = None
    """Side of the sample grid in each pixel, for meshes. Default: what the mesh needs at this size, 2 to 8; 1
    with --look splats."""
    order: option.OrderOfBlending = None
    """Order in which the triangles of meshes are blended: exact at every sample, or whole splats by their
    centres. Default: that of each mesh."""
    background: option.Text = None
    """Background: white, black, grey, #rrggbb, or r,g,b from 0 to 1. Default: white; for photographs without
    alpha that of the model folder, else black or white, the one that fits the splats best."""
    downscale: option.Count = None
    """Factor by which images are smaller than the photographs. Default: 1, or that of the protocol."""
    test_every: int = 8
    """Every n-th view is held out, if the data set has no split."""
    missing: option.Missing = "few"
    masks: option.MeaningOfMasks = "count"
    protocol: Annotated[
        Literal["mipnerf360", "mipnerf360-9", "tanks-and-temples", "deep-blending"] | None,
        tyro.conf.arg(metavar="{" + ",".join(BENCHMARKS) + "}", help_behavior_hint=""),
    ] = None
    """Score all scenes of a benchmark as in the paper's Table 1."""
    tune: Annotated[
        Literal["default", "paper"] | None, tyro.conf.arg(metavar="{default,paper}", help_behavior_hint="")
    ] = None
    """With --protocol: first fine-tune each scene on its training views, with this preset."""
    strips: int = 8
    """Number of views, spread over all, for which strips and enlarged crops are written."""
    amplify: float = 4.0
    """Factor of the error in the strips."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    threads: option.Threads = None
    json: option.AsJson = False
    force: option.Force = False

    def execute(self) -> None:
        self._check()
        start = time.perf_counter()
        if self.protocol is not None:
            reports = self._run_benchmark(BENCHMARKS[self.protocol])
        else:
            self._check_outputs(self.output)
            meshes = {name: self._load_mesh(path) for name, path in mesh_names(self.mesh).items()}
            before = None if self.before is None else self._load_mesh(self.before)
            splats = None if self.splats is None else self.reading.load(self.splats)
            known = [each for each in (splats, *meshes.values(), before) if each is not None]
            origin = shared_origin(each.origin for each in known)
            splats = None if splats is None else splats.relative_to(origin)
            before = None if before is None else before.relative_to(origin)
            meshes = {name: mesh.relative_to(origin) for name, mesh in meshes.items()}
            dataset = self._dataset(splats, origin if known else None)
            scenes = {"splats": splats, **meshes, "mesh before": before}
            source = self.splats or (self.mesh[0] if self.mesh else None)
            background = self._background(dataset, scenes, source)
            if self.data is None and splats is not None:
                # Their images are the ground truth; a mesh can reach degree 0 of it.
                more = splats.sh_degree > 0 and self.sh_degree != 0
                splats = replace(splats, sh=splats.sh[:, :1]) if more else None
            reports = [self._score(self.output, dataset, background, meshes, splats, before)]
        seconds = round(time.perf_counter() - start, 2)
        write_configuration(self.output / CONFIGURATION, "evaluate", self)
        if self.json:
            print(json.dumps({"scenes": [r.to_dict() for r in reports], "seconds": seconds}, indent=1))
            return
        print_table(*score_table(reports, {}), left=2)
        for note in notes(reports):
            print(note)
        print(f"SSIM: convention {SSIM_CONVENTION!r}; {seconds:.1f} s; {self.output}/")

    def _check(self) -> None:
        optional_color(self.background)
        if self.amplify <= 0 or self.strips < 0:
            raise ValueError("--amplify must be positive and --strips >= 0")
        if self.protocol is not None:
            if self.data is None or len(self.mesh) != 1:
                raise UsageError("--protocol needs a folder of meshes or models, and --data with the scenes")
            for name in ("before", "splats", "images", "cameras", "sh_degree", "order"):
                if getattr(self, name) is not None:
                    raise UsageError(f"{flag(name)} has no effect with --protocol")
            if self.missing != "few":
                raise UsageError("--missing has no effect with --protocol, which needs every image")
            return
        if self.cluster.cluster is not None:
            raise UsageError("--cluster is for the scenes of --protocol")
        if self.tune is not None:
            raise UsageError("--tune is for --protocol; otherwise use meshsplats finetune, then evaluate")
        if len(set(map(os.path.abspath, self.mesh))) < len(self.mesh):
            raise UsageError("a mesh was given twice")
        if not self.mesh and self.images is None and (self.splats is None or self.data is None):
            raise UsageError("nothing to score: give a mesh, --images, or --splats with --data")
        if self.data is None and self.splats is None:
            raise UsageError("nothing to compare with: give --data, or --splats")
        of_splats = {"cameras": self.cameras, "sh_degree": self.sh_degree, "look": self.look}
        for name, value in of_splats.items():
            if self.data is not None and value not in (None, "area"):
                raise UsageError(f"{flag(name)} has no effect with --data")
        if self.data is None and self.downscale is not None:
            raise UsageError("--downscale has no effect without --data")
        check_photographs(self.data, self.missing, masks=self.masks)

    def _check_outputs(self, folder: Path) -> None:
        names = (RESULTS, PER_VIEW, REPORT, TABLE, CONFIGURATION)
        check_outputs([folder / name for name in names], self.force, folder)

    def _load_mesh(self, path: Path) -> SplatMesh:
        found = self.reading.load_scene(path)
        if not isinstance(found, SplatMesh):
            raise FileFormatError(
                f"{path}: splats, not a mesh; give them with --splats, or convert them first"
            )
        return found if self.order is None else replace(found, order=self.order)

    def _dataset(self, splats: GaussianCloud | None, origin: np.ndarray | None) -> Dataset:
        if self.data is not None:
            return load_dataset(
                self.data,
                downscale=1 if self.downscale is None else self.downscale,
                test_every=self.test_every,
                missing=self.missing,
                masks=self.masks,
                origin=origin,
            )
        background = WHITE if self.background is None else parse_color(self.background)
        assert splats is not None
        assert self.splats is not None
        if self.cameras is not None:
            views = splat_views(
                splats,
                load_cameras(self.cameras, origin=splats.origin),
                look=self.look,
                sh_degree=self.sh_degree,
                background=background,
                threads=self.threads,
            )
            return Dataset((), views, "splats", self.look, splats.origin)
        made = Targets(look=self.look, sh_degree=self.sh_degree).make(
            splats, self.splats, background, self.threads
        )
        return replace(made, train=())

    def _background(
        self, dataset: Dataset, scenes: Mapping[str, GaussianCloud | SplatMesh | None], source: Path | None
    ) -> Background:
        known = {name: scene for name, scene in scenes.items() if scene is not None}
        photographs = None if self.data is None else dataset
        return choose_background(optional_color(self.background), photographs, known, source, self.threads)

    def _score(
        self,
        folder: Path,
        dataset: Dataset,
        background: Background,
        meshes: Mapping[str, SplatMesh],
        splats: GaussianCloud | None,
        before: SplatMesh | None,
    ) -> Report:
        """Evaluates one scene over ``background`` and writes its files into ``folder``."""
        from meshsplats.evaluation.lpips import load_lpips

        dataset = dataset.over(background.color)
        views = dataset.test or dataset.views
        images = None if self.images is None else image_folder(self.images, [v.camera for v in views])
        lpips = load_lpips(list(self.lpips) or None, network=self.network)
        folder.mkdir(exist_ok=True)
        here = self.cluster.cluster is None  # workers share a terminal
        bar = iter(track(range(len(views)), "scoring", len(views)) if here else range(len(views)))
        next(bar, None)
        save_strips = Strips(folder, view_names(len(views)), self.strips, self.amplify)

        def keep(scored: ScoredView) -> None:
            save_strips(scored)
            next(bar, None)

        report = evaluate(
            meshes,
            dataset,
            before=before,
            splats=splats,
            images=images,
            samples=self.samples,
            lpips=lpips,
            fit_exposure=self.fit_exposure,
            threads=self.threads,
            on_view=keep,
        )
        about: dict[str, Any] = {**background.to_dict(), "lpips_network": self.network if lpips else None}
        if self.cameras is not None:
            about["held_out"] = None  # it is unknown what a mesh was trained on
        report = replace(report, about={**report.about, **about})
        save_report(report, folder)
        return report

    def _run_benchmark(self, benchmark: Benchmark) -> list[Report]:
        """Scores the scenes of ``benchmark`` and writes the files of each and those of all."""
        assert self.data is not None
        (folder,) = self.mesh
        self._check_outputs(self.output)

        with self.cluster.workers(self.threads) as workers:
            task = replace(self, threads=workers.threads)
            result = run_benchmark(
                benchmark,
                folder,
                self.data,
                self.reading.load_scene,
                prepare=convert_scene if self.tune is None else task._tuned_candidates,
                score=task._score_scene,
                background=None if self.background is None else parse_color(self.background),
                downscale=self.downscale,
                workers=workers,
            )
        assert self.protocol is not None
        save_benchmark(result, self.output, self.protocol)
        return list(result.reports)

    def _score_scene(
        self, scene: str, dataset: Dataset, background: Background, candidates: Candidates
    ) -> Report:
        mesh, splats, before = candidates
        self.output.mkdir(exist_ok=True)
        return self._score(self.output / scene, dataset, background, {"mesh": mesh}, splats, before)

    def _tuned_candidates(self, scene: GaussianCloud | SplatMesh, dataset: Dataset) -> Candidates:
        from meshsplats.finetuning.candidates import tuned_candidates

        assert self.tune is not None
        return tuned_candidates(scene, dataset, self.tune, self.threads)
