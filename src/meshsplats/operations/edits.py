"""Splats and meshes in files cleaned, simplified or baked, as files again."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from meshsplats._common.kinds import as_path
from meshsplats._common.words import plural
from meshsplats._files.atomic import together
from meshsplats.conversion import bake_filter
from meshsplats.conversion.cleaning import Findings, find, remove, save_strip
from meshsplats.conversion.cleaning_rules import FLOATERS, CleaningRules
from meshsplats.conversion.footprint import FRAMING_PIXELS, FRAMING_VIEWS
from meshsplats.conversion.merging_views import simplify_for_views
from meshsplats.conversion.surroundings import floaters
from meshsplats.datasets.scene_files import SceneReading
from meshsplats.datasets.scene_views import cameras_named
from meshsplats.errors import FileFormatError, StraysWarning
from meshsplats.evaluation.viewers import alpha_for_viewers
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.formats.meshes import load_mesh, save_mesh
from meshsplats.formats.outputs import (
    CONFIGURATION,
    PREVIEW,
    beside,
    check_mesh_suffix,
    check_outputs,
    check_splat_endings,
)
from meshsplats.formats.sniff import identify
from meshsplats.formats.splat_formats import written_ending
from meshsplats.operations.options import BakingOptions, SimplifyOptions
from meshsplats.rendering.plain_colors import plain_colors_of
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewpoints.beside import cameras_beside, that_see
from meshsplats.viewpoints.showing import default_views

Place = Callable[[Any], Any]
"""Makes of a scene the one that is written."""


@dataclass(frozen=True)
class Cleaned:
    """A scene that was cleaned."""

    rules: CleaningRules
    found: Findings
    left: GaussianCloud | SplatMesh
    preview: Path

    @property
    def extent(self) -> tuple[list[float], list[float]]:
        """Least and greatest corner of what is left, in the world."""
        left = self.left
        places = left.means if isinstance(left, GaussianCloud) else left.vertices
        lower, upper = (
            [round(float(v), 4) for v in side + left.origin]
            for side in (places.min(axis=0), places.max(axis=0))
        )
        return lower, upper


def clean_file(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str],
    rules: CleaningRules | None = None,
    *,
    reading: SceneReading | None = None,
    preview_only: bool = False,
    place: Place = lambda scene: scene,
    threads: int | None = None,
    force: bool = False,
) -> Cleaned:
    """Writes what is left of the splats or the mesh ``source`` without floaters, and before | removed, in red
    | after, as ``NAME.preview.png`` beside the ``output`` NAME.

    Args:
        rules: what is removed; those that are None count as no rule. By default, and where all are None, what
            ``floaters`` finds.
        reading: how the file is read.
        preview_only: write no result.
        place: makes of what is left the scene that is written.
        threads: at most this many; all processors by default.
        force: replace files that are there.
    """
    source, output = as_path("source", source), as_path("output", output)
    preview = beside(output, PREVIEW)
    check_outputs([preview] if preview_only else [output, preview], force, inputs=[source])
    reading = reading or SceneReading()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StraysWarning)  # which names this command
        scene = reading.load_scene(source, threads=threads)
    if isinstance(scene, GaussianCloud):
        check_splat_endings(written_ending(output.name))
    else:
        check_mesh_suffix(output)
    many = len(scene) if isinstance(scene, GaussianCloud) else scene.splat_count or 0
    reading.tell_of("looking for floaters among", many)
    if rules is None or all(value is None for value in vars(rules).values()):
        rules, found = FLOATERS, floaters(scene, source, threads=threads)
    else:
        found = find(scene, rules)
    left = remove(scene, found)
    result: Any = left if preview_only else place(left)
    with together():
        if not preview_only:
            if isinstance(left, SplatMesh):
                save_mesh(result, output, **alpha_for_viewers(left, output, threads))
            else:
                save_gaussians(result, output)
        save_strip(scene, left, found, preview, threads)
    return Cleaned(rules, found, left, preview)


@dataclass(frozen=True)
class Simplified:
    """Splats that were merged."""

    read: int
    kept: GaussianCloud
    preview: Path
    """Where there is one."""
    seconds: float
    """Of the merging."""


@dataclass(frozen=True)
class EditCallbacks:
    """What a program does for files of splats that appear together with its own."""

    place: Place = lambda scene: scene
    record: Callable[[Path], object] = lambda path: None
    """Writes what is noted at this path."""
    draw: Callable[[GaussianCloud, Path, Camera | None], object] = lambda cloud, path, camera: None
    """Writes a preview, from the camera where there is one."""


def simplify_file(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str],
    options: SimplifyOptions,
    callbacks: EditCallbacks | None = None,
    *,
    reading: SceneReading | None = None,
    threads: int | None = None,
    force: bool = False,
) -> Simplified:
    """Writes the splats of the file ``source``, the most alike merged, to ``output``.

    Args:
        options: how many are left.
        callbacks: what is done beside that.
        reading: how the file is read.
        threads: at most this many; all processors by default.
        force: replace files that are there.

    Raises what ``SimplifyOptions.check`` and ``check_outputs`` raise, and FileFormatError for a mesh.
    """
    source, output = as_path("source", source), as_path("output", output)
    own = callbacks or EditCallbacks()
    check_splat_endings(written_ending(output.name))
    options.check()
    preview, config = beside(output, PREVIEW), beside(output, CONFIGURATION)
    check_outputs([output, config, *([] if options.no_preview else [preview])], force, inputs=[source])
    if identify(source) != "splats":
        raise FileFormatError(f"{source}: not splats; simplify needs a splat file or a model folder")
    reading = reading or SceneReading()
    cloud = reading.load(source, threads=threads)
    cameras = cameras_named(options.cameras, options.data, options.missing, cloud.origin)
    if cameras is None:
        cameras = that_see(cameras_beside(source, cloud.origin), cloud) or []
    start, wanted = time.perf_counter(), options.wanted(len(cloud))
    reading.tell_of("merging", len(cloud), f" to {wanted:,}")
    kept = simplify_for_views(cloud, wanted, cameras, threads=threads)
    seconds = time.perf_counter() - start
    placed = own.place(kept)
    shown = None if options.no_preview else default_views(cloud, source, 1, given=cameras, threads=threads)
    with together():
        save_gaussians(placed, output)
        own.record(config)
        if not options.no_preview:
            own.draw(kept, preview, shown[0][0] if shown and shown[0] else None)
    return Simplified(len(cloud), kept, preview, seconds)


@dataclass(frozen=True)
class Baked:
    """A mesh that was baked."""

    mesh: SplatMesh
    filter_px2: float
    degree: int
    """Of the colours that were baked; 0: none."""
    cameras: list[Camera]

    def in_words(self) -> str:
        """What was baked, and for which views."""
        count, first = len(self.cameras), self.cameras[0]
        parts = [f"a filter of {self.filter_px2:g} px^2"] * (self.filter_px2 > 0)
        parts += [f"colours of degree {self.degree}"] * (self.degree > 0)
        views = f"{plural(count, 'view')} of {first.width} x {first.height}"
        return f"{' and '.join(parts)} for {views}"


def bake_file(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str],
    options: BakingOptions,
    *,
    place: Place = lambda scene: scene,
    force: bool = False,
    say: Callable[[str], object] = lambda text: None,
) -> Baked:
    """Writes the mesh ``source`` with its filter, and where asked for its colours, as part of it.

    ``place`` makes of it the mesh that is written; ``say`` gets a line about the views. FileFormatError
    where there is nothing to bake.
    """
    source, output = as_path("source", source), as_path("output", output)
    check_mesh_suffix(output)
    options.views.check()
    check_outputs([output], force, inputs=[source])
    mesh = load_mesh(source)
    px2 = mesh.filter_px2 if options.filter_px2 is None else options.filter_px2
    degree = mesh.sh_degree if options.colors else 0
    if options.colors and not degree:
        raise FileFormatError(f"{source}: its colours are the same from everywhere: leave out ``colors``")
    if not (px2 or degree):
        more = "; ``colors`` bakes its colours" if mesh.sh_degree else ""
        raise FileFormatError(
            f"{source}: the mesh has no filter, there is nothing to bake; ``filter_px2`` gives it one{more}"
        )
    cameras = options.views.make(mesh, source, count=FRAMING_VIEWS, side=FRAMING_PIXELS, say=say)
    if degree:  # with the filter, which shows how much of each vertex a view sees
        mesh = replace(mesh, plain_colors=plain_colors_of(mesh, cameras)).plain
    baked = bake_filter(mesh, cameras, filter_px2=px2)
    save_mesh(place(baked), output, **alpha_for_viewers(baked, output))
    return Baked(baked, px2, degree, cameras)
