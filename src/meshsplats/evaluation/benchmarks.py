"""Benchmarks of the splatting literature: scenes, resolutions, held-out views; and ``run_benchmark``."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from meshsplats.cluster import Workers
from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.views import Dataset
from meshsplats.errors import DataWarning
from meshsplats.evaluation.backgrounds import (
    Background,
    find_background,
    model_background,
    warn_of_frame_mismatch,
)
from meshsplats.evaluation.report import SSIM_CONVENTION, Report, evaluate
from meshsplats.evaluation.strips import markdown_table
from meshsplats.formats.mesh_formats import mesh_suffixes
from meshsplats.formats.splat_formats import splat_suffixes
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh


@dataclass(frozen=True)
class Benchmark:
    """A benchmark of several scenes, each a folder of photographs in the folder of the data set."""

    title: str
    scenes: Mapping[str, int]
    """For each scene the downscaling of its images from the originals (``images_2``, ``images_4``)."""
    reported: Mapping[str, tuple[float, float, float]]
    """Scores of the literature on the same scenes: PSNR, SSIM, LPIPS (VGG)."""
    test_every: int = 8
    """Every n-th view by name is held out."""
    sh_degree: int = 0
    """Degree of the spherical harmonics of the splats that the meshes are compared with."""


_OUTDOOR = {"bicycle": 4, "garden": 4, "stump": 4}
_INDOOR = {"bonsai": 2, "counter": 2, "kitchen": 2, "room": 2}

BENCHMARKS: Mapping[str, Benchmark] = {
    "mipnerf360": Benchmark(
        "Mip-NeRF 360, 7 scenes",
        _OUTDOOR | _INDOOR,
        {"MeshSplats paper": (28.08, 0.817, 0.229), "3DGS-30K": (28.69, 0.87, 0.220)},
    ),
    "mipnerf360-9": Benchmark(
        "Mip-NeRF 360, 9 scenes", _OUTDOOR | {"flowers": 4, "treehill": 4} | _INDOOR, {}
    ),
    "tanks-and-temples": Benchmark(
        "Tanks and Temples",
        {"train": 1, "truck": 1},
        {"MeshSplats paper": (21.71, 0.766, 0.248), "3DGS-30K": (23.14, 0.841, 0.183)},
    ),
    "deep-blending": Benchmark(
        "Deep Blending",
        {"drjohnson": 1, "playroom": 1},
        {"MeshSplats paper": (29.50, 0.890, 0.254), "3DGS-30K": (29.41, 0.903, 0.243)},
    ),
}
"""The benchmarks of Table 1 of arXiv 2502.07754, at the resolutions of the 3DGS paper. Every 8th view by name
is held out, and splats are compared at degree 0. The background is the one that each scene's splats were
trained with. The 7 scenes of Mip-NeRF 360 are the public ones; the other two are available on request."""


def find_input(folder: Path, scene: str) -> Path | None:
    """Mesh, splats or model folder of ``scene`` in ``folder``: ``scene.npz``, ``scene.ply`` or ``scene/``;
    of several, the first."""
    for suffix in (".npz", ".glb", ".gltf", *mesh_suffixes(), *splat_suffixes()):
        if (folder / (scene + suffix)).is_file():
            return folder / (scene + suffix)
    return folder / scene if (folder / scene).is_dir() else None


class Candidates(NamedTuple):
    """The candidates that are scored on one scene."""

    mesh: SplatMesh
    splats: GaussianCloud | None = None
    """The splats that the mesh was made from."""
    before: SplatMesh | None = None
    """The mesh before fine-tuning."""


Scene = GaussianCloud | SplatMesh


def convert_scene(scene: Scene, dataset: Dataset) -> Candidates:
    """A mesh as it is; splats with the mesh converted from them for the training views."""
    if isinstance(scene, SplatMesh):
        return Candidates(scene)
    from meshsplats.conversion import convert

    return Candidates(convert(scene, cameras=[view.camera for view in dataset.train]), scene)


@dataclass(frozen=True)
class BenchmarkResult:
    """Scores of the scenes of a benchmark."""

    benchmark: Benchmark
    downscale: Mapping[str, int]
    """The scored scenes, with the downscaling of their images."""
    reports: tuple[Report, ...]
    """The report of each of these scenes."""

    def means(self) -> dict[str, dict[str, float | None]]:
        """Means over the scenes, in the layout of ``Report.results``."""
        keys = ("SSIM", "PSNR", "LPIPS")
        results = [report.results() for report in self.reports]
        return {
            method: {key: _mean([result.get(method, {}).get(key) for result in results]) for key in keys}
            for method in results[0]
        }

    def per_view(self) -> dict[str, Any]:
        """``Report.per_view`` of each scene."""
        return {report.scene: report.per_view() for report in self.reports}

    def to_dict(self) -> dict[str, Any]:
        """All scores and settings, for JSON."""
        return {
            "scenes": list(self.downscale),
            "missing": sorted(set(self.benchmark.scenes) - set(self.downscale)),
            "downscale": dict(self.downscale),
            "test_every": self.benchmark.test_every,
            "background": {report.scene: report.about["background"] for report in self.reports},
            "ssim_convention": SSIM_CONVENTION,
            "mean": self.means(),
            "reported": {name: list(scores) for name, scores in self.benchmark.reported.items()},
            "reports": [report.to_dict() for report in self.reports],
        }

    def table(self, notes: Sequence[str] = ()) -> str:
        """A Markdown table of the scores, beside those of the literature."""
        count = len(self.downscale)
        scenes = "1 scene" if count == 1 else f"{count:,} scenes"
        title = f"{self.benchmark.title}: {scenes} of {len(self.benchmark.scenes)}"
        return markdown_table(self.reports, title=title, reported=self.benchmark.reported, notes=notes)


def run_benchmark(
    benchmark: Benchmark,
    models: Path,
    data: Path,
    load: Callable[[Path], Scene],
    *,
    prepare: Callable[[Scene, Dataset], Candidates] = convert_scene,
    score: Callable[[str, Dataset, Background, Candidates], Report] | None = None,
    background: Sequence[float] | None = None,
    downscale: int | None = None,
    threads: int | None = None,
    workers: Workers | None = None,
) -> BenchmarkResult:
    """Scores all scenes of ``benchmark`` that are in both ``models`` and ``data``.

    Args:
        models: folder with a mesh, splats or a model folder for each scene (``find_input``).
        data: folder with a folder of photographs for each scene.
        load: reads the splats or the mesh at a path that ``find_input`` returned.
        prepare: makes the candidates from a scene and its photographs, for instance by fine-tuning.
        score: scores the candidates of the scene of that name on the photographs; ``evaluate`` by default.
            The report's ``about`` needs the entries of ``Background.to_dict``.
        background: display RGB in [0, 1] behind all scenes; ``find_background`` for each by default.
        downscale: downscaling of the images; that of the benchmark by default.
        threads: maximum number of threads; all processors by default.
        workers: score the scenes, each in a task, with ``workers.threads`` in place of ``threads``; this
            process by default. They have the folders at the same paths, and ``load``, ``prepare`` and
            ``score`` are sent to them.

    Raises:
        FileNotFoundError: no scene is there. A DataWarning names each single one that is missing.
        FileFormatError: a scene's photographs cannot be read, or one of them is missing: without it, scores
            are not those of the literature. Before any scene is scored.
    """
    found: list[tuple[str, Path]] = []
    for name in benchmark.scenes:
        source = find_input(models, name)
        if source is None or not (data / name).is_dir():
            missing = f"{data / name}" if source else f"{models / name}(.npz, .ply, ...)"
            warnings.warn(
                f"{benchmark.title}: scene {name} is left out, no {missing}", DataWarning, stacklevel=2
            )
        else:
            found.append((name, source))
    if not found:
        raise FileNotFoundError(
            f"none of the scenes of {benchmark.title} ({', '.join(benchmark.scenes)}) is both in {models} and"
            f" in {data}"
        )

    workers = workers or Workers(threads)

    def default_score(name: str, dataset: Dataset, background: Background, candidates: Candidates) -> Report:
        mesh, splats, before = candidates
        report = evaluate(mesh, dataset, splats=splats, before=before, threads=workers.threads)
        return replace(report, about={**report.about, **background.to_dict()})

    score = score or default_score
    factors = {name: downscale or benchmark.scenes[name] for name, _ in found}
    scenes = _Scenes(data, factors, benchmark.test_every, load, prepare, score, background, workers.threads)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # it comes again with each scene
        for name in factors:
            scenes.photographs(name)
    reports = dict(workers.run(scenes, found))
    return BenchmarkResult(benchmark, factors, tuple(reports[i] for i in range(len(found))))


@dataclass(frozen=True)
class _Scenes:
    """What scores the scenes of a benchmark, one by one, in any process; see ``run_benchmark``."""

    data: Path
    factors: Mapping[str, int]
    test_every: int
    load: Callable[[Path], Scene]
    prepare: Callable[[Scene, Dataset], Candidates]
    score: Callable[[str, Dataset, Background, Candidates], Report]
    background: Sequence[float] | None
    threads: int | None

    def __call__(self, found: tuple[str, Path]) -> Report:
        """Scores one scene: its name, and its mesh, splats or model folder."""
        name, source = found
        scene = self.load(source)
        dataset = self.photographs(name, scene.origin)
        judged = {"splats" if isinstance(scene, GaussianCloud) else "mesh": scene}
        named = model_background(source)
        chosen = find_background(dataset, judged, given=self.background, named=named, threads=self.threads)
        warn_of_frame_mismatch(chosen)
        dataset = dataset.over(chosen.color)
        return self.score(name, dataset, chosen, self.prepare(scene, dataset))

    def photographs(self, name: str, origin: np.ndarray | None = None) -> Dataset:
        """All photographs of the scene of that name, relative to ``origin`` (3,)."""
        downscale, test_every = self.factors[name], self.test_every
        return load_dataset(
            self.data / name, downscale=downscale, test_every=test_every, missing="error", origin=origin
        )


def _mean(values: Sequence[float | None]) -> float | None:
    """Mean of ``values``; None if one is missing."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None
