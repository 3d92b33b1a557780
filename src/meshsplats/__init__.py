"""MeshSplats: Gaussian splats as ordinary triangle meshes.

The usual way through the package is ``load_gaussians`` -> ``convert`` -> ``finetune`` -> ``save_mesh``, with
``render`` and ``compare`` to look at the result. Names are loaded when first used, so that ``import
meshsplats`` stays quick. All of them load with NumPy alone; a function that needs an extra says so when it is
called.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from meshsplats._common.lazy import lazy_names

if TYPE_CHECKING:  # what editors and type checkers see; _HOME says the same at run time
    from meshsplats.cameras.files import load_cameras, save_cameras
    from meshsplats.cameras.trajectories import dome, look_around, look_at, orbit
    from meshsplats.cluster import Workers, open_workers
    from meshsplats.conversion import ConversionOptions, bake_filter, convert, simplify
    from meshsplats.conversion.streaming import convert_blocks
    from meshsplats.datasets.folder import load_dataset
    from meshsplats.datasets.points import load_points
    from meshsplats.datasets.splat_targets import splat_dataset
    from meshsplats.datasets.views import Dataset, View, ViewImage
    from meshsplats.errors import (
        ClusterError,
        DataWarning,
        DeviceError,
        DivergenceError,
        FileFormatError,
        MissingDependencyError,
        NoTextureWarning,
        OtherRunError,
    )
    from meshsplats.evaluation.backgrounds import find_background
    from meshsplats.evaluation.comparison import Comparison, compare
    from meshsplats.evaluation.metrics import psnr, ssim
    from meshsplats.evaluation.report import Report, evaluate
    from meshsplats.finetuning import (
        FinetuneConfig,
        Interrupted,
        Progress,
        RunOptions,
        finetune,
        finetune_ordered,
        make_config,
        starting_mesh,
    )
    from meshsplats.formats.base_meshes import load_base, load_vertex_colored, save_base
    from meshsplats.formats.cutting import cut_mesh
    from meshsplats.formats.gaussians import load_gaussians, save_gaussian_blocks, save_gaussians
    from meshsplats.formats.meshes import load_mesh, save_mesh, save_mesh_blocks
    from meshsplats.formats.scenes import save_scene
    from meshsplats.formats.streaming import SplatStream, stream_gaussians
    from meshsplats.formats.tensors import gaussians_from_tensors, gaussians_to_tensors
    from meshsplats.images.writing import save_image
    from meshsplats.prior import MeshPrior, load_prior, train_prior
    from meshsplats.prior.laying import bind
    from meshsplats.rendering import Rendering, render, render_splats
    from meshsplats.rendering.autograd import rasterize
    from meshsplats.rendering.looks import draw_splats
    from meshsplats.rendering.ordering import drawing_order
    from meshsplats.rendering.plain_colors import plain_colors_of
    from meshsplats.rendering.samples import needed_samples
    from meshsplats.scene.base_mesh import BaseMesh
    from meshsplats.scene.camera import Camera
    from meshsplats.scene.gaussians import GaussianCloud
    from meshsplats.scene.mesh import SplatMesh
    from meshsplats.surfaces import SurfaceOptions, draw_surface, make_surface
    from meshsplats.tiles.building import build_tiles
    from meshsplats.tiles.drawing import render_tiles, tiles_mesh
    from meshsplats.tiles.options import TileOptions
    from meshsplats.tiles.tileset import Tileset
    from meshsplats.training import TrainConfig, train, train_config
    from meshsplats.viewer.page import PageOptions, make_page
    from meshsplats.viewpoints.finding import FoundCameras, find_cameras

__version__: str

_HOME = {
    "meshsplats.scene.base_mesh": ("BaseMesh",),
    "meshsplats.scene.camera": ("Camera",),
    "meshsplats.cameras.files": ("load_cameras", "save_cameras"),
    "meshsplats.cameras.trajectories": ("dome", "look_around", "look_at", "orbit"),
    "meshsplats.cluster": ("Workers", "open_workers"),
    "meshsplats.conversion": ("ConversionOptions", "bake_filter", "convert", "simplify"),
    "meshsplats.conversion.streaming": ("convert_blocks",),
    "meshsplats.datasets.folder": ("load_dataset",),
    "meshsplats.datasets.points": ("load_points",),
    "meshsplats.datasets.splat_targets": ("splat_dataset",),
    "meshsplats.datasets.views": ("Dataset", "View", "ViewImage"),
    "meshsplats.errors": (
        *("ClusterError", "DeviceError", "DivergenceError", "FileFormatError", "MissingDependencyError"),
        *("OtherRunError", "DataWarning", "NoTextureWarning"),
    ),
    "meshsplats.evaluation.backgrounds": ("find_background",),
    "meshsplats.evaluation.comparison": ("Comparison", "compare"),
    "meshsplats.evaluation.metrics": ("psnr", "ssim"),
    "meshsplats.evaluation.report": ("Report", "evaluate"),
    "meshsplats.finetuning": (
        *("FinetuneConfig", "Interrupted", "Progress", "RunOptions"),
        *("finetune", "finetune_ordered", "make_config", "starting_mesh"),
    ),
    "meshsplats.formats.base_meshes": ("load_base", "load_vertex_colored", "save_base"),
    "meshsplats.formats.cutting": ("cut_mesh",),
    "meshsplats.formats.gaussians": ("load_gaussians", "save_gaussian_blocks", "save_gaussians"),
    "meshsplats.formats.scenes": ("save_scene",),
    "meshsplats.formats.meshes": ("load_mesh", "save_mesh", "save_mesh_blocks"),
    "meshsplats.formats.streaming": ("SplatStream", "stream_gaussians"),
    "meshsplats.formats.tensors": ("gaussians_from_tensors", "gaussians_to_tensors"),
    "meshsplats.scene.gaussians": ("GaussianCloud",),
    "meshsplats.images.writing": ("save_image",),
    "meshsplats.scene.mesh": ("SplatMesh",),
    "meshsplats.prior": ("MeshPrior", "load_prior", "train_prior"),
    "meshsplats.prior.laying": ("bind",),
    "meshsplats.rendering": ("Rendering", "render", "render_splats"),
    "meshsplats.rendering.autograd": ("rasterize",),
    "meshsplats.rendering.ordering": ("drawing_order",),
    "meshsplats.rendering.plain_colors": ("plain_colors_of",),
    "meshsplats.rendering.looks": ("draw_splats",),
    "meshsplats.rendering.samples": ("needed_samples",),
    "meshsplats.surfaces": ("SurfaceOptions", "draw_surface", "make_surface"),
    "meshsplats.tiles.building": ("build_tiles",),
    "meshsplats.tiles.drawing": ("render_tiles", "tiles_mesh"),
    "meshsplats.tiles.options": ("TileOptions",),
    "meshsplats.tiles.tileset": ("Tileset",),
    "meshsplats.training": ("TrainConfig", "train", "train_config"),
    "meshsplats.viewer.page": ("PageOptions", "make_page"),
    "meshsplats.viewpoints.finding": ("FoundCameras", "find_cameras"),
}
_MODULES = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "BaseMesh",
    "Camera",
    "ClusterError",
    "Comparison",
    "ConversionOptions",
    "DataWarning",
    "Dataset",
    "DeviceError",
    "DivergenceError",
    "FileFormatError",
    "FinetuneConfig",
    "FoundCameras",
    "GaussianCloud",
    "Interrupted",
    "MeshPrior",
    "MissingDependencyError",
    "NoTextureWarning",
    "OtherRunError",
    "PageOptions",
    "Progress",
    "Rendering",
    "Report",
    "RunOptions",
    "SplatMesh",
    "SplatStream",
    "SurfaceOptions",
    "TileOptions",
    "Tileset",
    "TrainConfig",
    "View",
    "ViewImage",
    "Workers",
    "__version__",
    "bake_filter",
    "bind",
    "build_tiles",
    "compare",
    "convert",
    "convert_blocks",
    "cut_mesh",
    "dome",
    "draw_splats",
    "draw_surface",
    "drawing_order",
    "evaluate",
    "find_background",
    "find_cameras",
    "finetune",
    "finetune_ordered",
    "gaussians_from_tensors",
    "gaussians_to_tensors",
    "load_base",
    "load_cameras",
    "load_dataset",
    "load_gaussians",
    "load_mesh",
    "load_points",
    "load_prior",
    "load_vertex_colored",
    "look_around",
    "look_at",
    "make_config",
    "make_page",
    "make_surface",
    "needed_samples",
    "open_workers",
    "orbit",
    "plain_colors_of",
    "psnr",
    "rasterize",
    "render",
    "render_splats",
    "render_tiles",
    "save_base",
    "save_cameras",
    "save_gaussian_blocks",
    "save_gaussians",
    "save_image",
    "save_mesh",
    "save_mesh_blocks",
    "save_scene",
    "simplify",
    "splat_dataset",
    "ssim",
    "starting_mesh",
    "stream_gaussians",
    "tiles_mesh",
    "train",
    "train_config",
    "train_prior",
]

if not TYPE_CHECKING:  # a checker would take any name for one that this finds
    _loaded = lazy_names(__name__, _HOME)

    def __getattr__(name: str) -> Any:
        if name != "__version__":
            return _loaded(name)
        globals()[name] = value = _version()
        return value


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version  # most of the time of "import meshsplats"

    try:
        return version("meshsplats")
    except PackageNotFoundError:  # run from a source tree that was never installed
        return "0+unknown"


def __dir__() -> list[str]:
    return list(__all__)
