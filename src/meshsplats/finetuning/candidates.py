"""Scenes of a benchmark, fine-tuned before they are scored."""

from __future__ import annotations

from meshsplats.conversion.options import ConversionOptions, Preset
from meshsplats.datasets.views import Dataset
from meshsplats.evaluation.benchmarks import Candidates
from meshsplats.finetuning.config import make_config
from meshsplats.finetuning.initial import for_photographs, starting_mesh
from meshsplats.finetuning.run import finetune
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh


def tuned_candidates(
    scene: GaussianCloud | SplatMesh,
    dataset: Dataset,
    preset: Preset = "default",
    threads: int | None = None,
) -> Candidates:
    """What ``run_benchmark`` scores of a ``scene``: the mesh that is fine-tuned on the training views of
    ``dataset`` with a ``preset``, the splats, and the mesh at the start. Splats are converted first."""
    splats, start = (scene, None) if isinstance(scene, GaussianCloud) else (None, scene)
    if splats is not None:
        options = ConversionOptions()
        if preset == "default":
            options = for_photographs(options, splats, dataset.train, threads)
        start = starting_mesh(splats, [view.camera for view in dataset.train], options, preset=preset)
    assert start is not None
    run = RunOptions(threads=threads, report_every=0)
    return Candidates(finetune(start, dataset, make_config(preset), run=run), splats, start)
