"""MeshSplats: Gaussian splats as ordinary triangle meshes.

Names are loaded when first used, so that ``import meshsplats`` stays quick.
"""

from __future__ import annotations

import importlib
from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("meshsplats")
except PackageNotFoundError:  # run from a source tree that was never installed
    __version__ = "0+unknown"

_HOME = {
    "GaussianCloud": "meshsplats.gaussians",
    "SplatMesh": "meshsplats.mesh",
    "Camera": "meshsplats.camera",
    "load_cameras": "meshsplats.cameras.files",
    "save_cameras": "meshsplats.cameras.files",
    "dome": "meshsplats.cameras.trajectories",
    "orbit": "meshsplats.cameras.trajectories",
    "Dataset": "meshsplats.datasets.views",
    "View": "meshsplats.datasets.views",
    "load_dataset": "meshsplats.datasets.folder",
    "splat_views": "meshsplats.datasets.splat_targets",
    "splat_dataset": "meshsplats.datasets.splat_targets",
    "load_gaussians": "meshsplats.formats.gaussians",
    "save_gaussians": "meshsplats.formats.gaussians",
    "load_mesh": "meshsplats.formats.meshes",
    "save_mesh": "meshsplats.formats.meshes",
    "convert": "meshsplats.conversion",
    "bake_filter": "meshsplats.conversion",
    "simplify": "meshsplats.conversion",
    "render": "meshsplats.rendering",
    "render_splats": "meshsplats.rendering",
    "Rendering": "meshsplats.rendering",
    "draw_splats": "meshsplats.rendering.looks",
    "needed_samples": "meshsplats.rendering.samples",
    "finetune": "meshsplats.finetuning",
    "FinetuneConfig": "meshsplats.finetuning",
    "MeshPrior": "meshsplats.prior",
    "load_prior": "meshsplats.prior",
    "evaluate": "meshsplats.evaluation.report",
    "find_background": "meshsplats.evaluation.backgrounds",
    "Report": "meshsplats.evaluation.report",
    "psnr": "meshsplats.evaluation.metrics",
    "ssim": "meshsplats.evaluation.metrics",
    "FileFormatError": "meshsplats.errors",
    "MissingDependencyError": "meshsplats.errors",
    "DataWarning": "meshsplats.errors",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str):
    if name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'meshsplats' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
