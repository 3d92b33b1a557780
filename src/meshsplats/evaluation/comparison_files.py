"""Splats and a mesh from files compared, with images side by side and scores as files."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from meshsplats._common.kinds import as_path
from meshsplats._files.atomic import write_json
from meshsplats.cameras.files import save_cameras
from meshsplats.conversion import convert
from meshsplats.conversion.cleaning import cropped
from meshsplats.conversion.gaps import without_gaps
from meshsplats.errors import FileFormatError
from meshsplats.evaluation.backgrounds import Background, choose_background
from meshsplats.evaluation.comparison import Comparison, compare_views
from meshsplats.evaluation.options import ComparisonOptions
from meshsplats.formats.meshes import load_mesh
from meshsplats.formats.outputs import CAMERAS, CONFIGURATION, check_outputs, view_names
from meshsplats.formats.sniff import identify
from meshsplats.images.writing import amplified_error, save_image, strip
from meshsplats.rendering.looks import mesh_samples
from meshsplats.rendering.sight import check_sight
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

RESULTS = "results.json"


@dataclass(frozen=True)
class SavedComparison:
    """A comparison, and what was compared."""

    scores: Comparison
    background: Background
    result: dict[str, Any]
    """As in the file ``results.json``."""


def save_comparison(
    splats: str | os.PathLike[str],
    mesh: str | os.PathLike[str] | None,
    folder: str | os.PathLike[str],
    options: ComparisonOptions,
    *,
    force: bool = False,
    say: Callable[[str], object] = lambda text: None,
    progress: Callable[[Iterable[Any], int], Iterable[Any]] | None = None,
) -> SavedComparison:
    """Compares the ``splats`` of a file with the ``mesh`` of another, or with the one that they are converted
    to, and writes scores, cameras and a strip splats | mesh | error of each view into ``folder``.

    Args:
        force: replace files that are there.
        say: gets lines about the views.
        progress: shows the progress of views, of which there are so many, and passes them on.

    Raises what ``ComparisonOptions.check`` and ``check_outputs`` raise, and FileFormatError for a file of
    another kind.
    """
    splats, folder = as_path("splats", splats), as_path("folder", folder)
    options.check()
    if splats.is_file() and identify(splats) == "mesh":
        raise FileFormatError(
            f"{splats}: a mesh, not splats: give the splats first, then the mesh; 'meshsplats evaluate'"
            " compares a mesh with photographs"
        )
    cloud = options.reading.load(splats, up=options.views.up, threads=options.draw.threads)
    cloud, look = cropped(cloud, options.part.crop), options.look or "area"
    if options.look is None:
        cloud = without_gaps(cloud, options.draw.threads)
    photographs = options.views.photographs(cloud.origin)
    cameras = options.views.make(cloud, splats, count=8, side=400, photographs=photographs, say=say)
    check_sight(cloud, cameras, threads=options.draw.threads)
    strips = view_names(len(cameras))
    check_outputs([folder / name for name in (*strips, RESULTS, CAMERAS, CONFIGURATION)], force, folder)
    made = _mesh(None if mesh is None else as_path("mesh", mesh), cloud, cameras, options)
    start, draw = time.perf_counter(), options.draw
    background = choose_background(draw.color, photographs, {"splats": cloud}, splats, draw.threads)
    samples = draw.samples or mesh_samples(look, made, cameras)
    views: Iterable[Any] = compare_views(
        cloud,
        made,
        cameras,
        look=look,
        sh_degree=draw.sh_degree,
        background=background.color,
        samples=samples,
        max_layers=draw.max_layers,
        threads=draw.threads,
        device=draw.device,
    )
    views, scores = progress(views, len(cameras)) if progress else views, []
    captions = ("splats", "mesh", f"error x {options.amplify:g}")
    for name, view in zip(strips, views, strict=True):
        scores.append(view.score)
        folder.mkdir(exist_ok=True)
        error = amplified_error(view.splats, view.mesh, options.amplify)
        save_image(folder / name, strip([view.splats, view.mesh, error], captions))
    comparison = Comparison(tuple(scores))
    result = {
        "splats": len(cloud),
        "triangles": len(made.faces),
        "look": look,
        "samples": samples,
        "ssim_convention": "3dgs",
        "error_amplified": options.amplify,
        **background.to_dict(),
        "seconds": round(time.perf_counter() - start, 3),
        **comparison.to_dict(),
    }
    write_json(folder / RESULTS, result)
    save_cameras(cameras, folder / CAMERAS, origin=cloud.origin)
    return SavedComparison(comparison, background, result)


def _mesh(
    path: Path | None, cloud: GaussianCloud, cameras: Sequence[Camera], options: ComparisonOptions
) -> SplatMesh:
    if path is None:
        mesh = convert(cloud, preset=options.preset, cameras=cameras, look=options.look or "area")
    elif identify(path) != "mesh":
        raise FileFormatError(f"{path}: not a mesh; give splats first, then the mesh")
    else:
        mesh = cropped(load_mesh(path, origin=cloud.origin), options.part.crop)
    return mesh if options.draw.order is None else replace(mesh, order=options.draw.order)
