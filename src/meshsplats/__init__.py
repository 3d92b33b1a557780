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
    "load_cameras": "meshsplats.camera",
    "save_cameras": "meshsplats.camera",
    "dome": "meshsplats.camera",
    "orbit": "meshsplats.camera",
    "Dataset": "meshsplats.dataset",
    "View": "meshsplats.dataset",
    "load_dataset": "meshsplats.dataset",
    "splat_views": "meshsplats.dataset",
    "splat_dataset": "meshsplats.datasets.around",
    "load_gaussians": "meshsplats.formats.splats",
    "save_gaussians": "meshsplats.formats.splats",
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
    "evaluate": "meshsplats.evaluation",
    "find_background": "meshsplats.backgrounds",
    "Report": "meshsplats.evaluation",
    "psnr": "meshsplats.metrics",
    "ssim": "meshsplats.metrics",
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
