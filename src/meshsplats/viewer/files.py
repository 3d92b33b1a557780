"""Pages of scenes in files: which files, from where they are seen, over which background."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from meshsplats._common.words import optional_color, optional_up
from meshsplats.cameras.files import load_cameras
from meshsplats.conversion.cleaning import cropped
from meshsplats.conversion.merging_views import VIEWS
from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.scene_files import PartOfScene, SceneReading
from meshsplats.datasets.scene_views import MissingOfData, check_photographs
from meshsplats.datasets.views import Dataset
from meshsplats.errors import FileFormatError, OptionsError
from meshsplats.evaluation.backgrounds import choose_background
from meshsplats.formats.base_meshes import load_base
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewer import content
from meshsplats.viewer.content import (
    MOST_TRIANGLES,
    Content,
    TooManyTrianglesError,
    content_of_mesh,
    content_of_splats,
    measured,
)
from meshsplats.viewer.page import Page, PageOptions
from meshsplats.viewpoints.beside import cameras_beside, record_of
from meshsplats.viewpoints.showing import default_views, opening_beside

FOUND_VIEWS = 12
"""Viewpoints of a place, where the input has none."""
EXCLUSIVE = (("cameras", "data"), ("splats", "without_splats"), ("max_triangles", "whole"))
"""Options that exclude each other."""
Shown = GaussianCloud | SplatMesh | BaseMesh


@dataclass(frozen=True)
class ViewingOptions:
    """What a page shows of a file."""

    splats: Path | None = None
    """Splats to compare a mesh with. Default: the input, where that is splats."""
    surface: Path | None = None
    """A surface to compare the input with: .glb or .obj with its texture, or another opaque mesh, not one of
    splats."""
    without_splats: bool = False
    """Leave the splats out: the page is smaller."""
    max_triangles: int | None = None
    """Splats are merged until their mesh has no more triangles. Default: 4,000,000."""
    whole: bool = False
    """Merge no splats, up to 20,000,000 triangles."""
    cameras: Path | None = None
    """Viewpoints to choose from: a JSON list of cameras, a cameras.json of a 3DGS trainer, or the model
    folder that has one. Default: those of the input, if it is a model folder."""
    data: Path | None = None
    """Data set of photographs (COLMAP, NeRF-synthetic, nerfstudio, LLFF): viewpoints to choose from."""
    missing: MissingOfData = "few"
    up: str | None = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the cameras, else of the
    mesh."""
    background: str | None = None
    """Background: white, black, grey, #rrggbb, or r,g,b from 0 to 1. Default: white; with ``data`` that of
    the model folder or of the photographs."""
    title: str | None = None
    """Name of the scene in the page. Default: that of the file."""
    without_controls: bool = False
    """Nothing over the scene, for a page within another: no title, no settings, until H is pressed."""
    reading: SceneReading = field(default_factory=SceneReading)
    part: PartOfScene = field(default_factory=PartOfScene)

    def check(self) -> None:
        """OptionsError for options that contradict each other, have no effect or are out of range."""
        check_photographs(self.data, self.missing)
        for first, second in EXCLUSIVE:
            if getattr(self, first) and getattr(self, second):
                raise OptionsError(f"give ``{first}`` or ``{second}``, not both")
        if self.max_triangles is not None and not 8 <= self.max_triangles <= MOST_TRIANGLES:
            raise OptionsError(
                f"``max_triangles`` must be from 8, one splat's, to {MOST_TRIANGLES:,},"
                f" got {self.max_triangles}"
            )
        optional_color(self.background)
        optional_up(self.up)


@dataclass(frozen=True)
class ShownFile:
    """What a page of the file ``source`` shows, and from where."""

    source: Path
    options: ViewingOptions
    content: Content
    cameras: list[Camera]
    photographs: Dataset | None
    threads: int | None = None

    def page(self, name: str) -> tuple[Page, dict[str, Any]]:
        """The page, with the title ``name`` unless the options have one, and its sizes and errors
        (``content.measured``)."""
        content, options = self.content, self.options
        background = choose_background(
            optional_color(options.background),
            None if content.mesh is None else self.photographs,
            {} if content.mesh is None else {"mesh": content.mesh},
            self.source,
            self.threads,
            whole=options.part.crop is None,
        )
        made = content.page(
            self.cameras,
            PageOptions(
                title=options.title or name,
                background=background.color,
                up=optional_up(options.up),
                merged_from=content.merged_from,
                controls=not options.without_controls,
            ),
        )
        return made, measured(content, made, self.cameras, self.threads)


def shown_file(
    source: Path,
    options: ViewingOptions,
    *,
    say: Callable[[str], object] = lambda text: None,
    threads: int | None = None,
) -> ShownFile:
    """Reads the file or folder ``source`` for a page. ``say`` gets lines that say where views come from, and
    why there is no coarse level of a large mesh. ``threads``: at most this many.

    Raises OptionsError as ``ViewingOptions.check`` does, and for options without effect on this file or with
    more triangles than a page can hold, FileFormatError and OSError for files that cannot be read.
    """
    options.check()
    reading = options.reading
    scene: Shown = reading.load_shown(source, up=options.up, threads=threads)
    if not isinstance(scene, BaseMesh):
        scene = cropped(scene, options.part.crop)
    _check_effects(scene, source, options)
    photographs = None
    if options.data is not None:
        photographs = load_dataset(options.data, missing=options.missing, origin=scene.origin)
    cameras = _cameras(scene, source, options, photographs, say, threads)
    content = _content(scene, options, cameras, say, threads)
    return ShownFile(source, options, content, cameras, photographs, threads)


def _check_effects(scene: Shown, source: Path, options: ViewingOptions) -> None:
    if isinstance(scene, BaseMesh) and (options.surface is not None or options.part.crop is not None):
        given = "crop" if options.surface is None else "surface"
        raise OptionsError(f"{source} is a textured surface: ``{given}`` has no effect")
    if isinstance(scene, GaussianCloud):
        if options.splats is not None:
            raise OptionsError(f"{source} is splats: ``splats`` is for a mesh")
    elif options.max_triangles is not None or options.whole:
        given = "whole" if options.whole else "max_triangles"
        raise OptionsError(f"{source} is a mesh: ``{given}`` is for splats")


def _content(
    scene: Shown,
    options: ViewingOptions,
    cameras: Sequence[Camera],
    say: Callable[[str], object],
    threads: int | None,
) -> Content:
    beside = None if options.surface is None else _surface(options.surface, scene)
    try:
        if isinstance(scene, GaussianCloud):
            advice = "leave ``whole`` out, or make 'meshsplats tiles'"
            most = None if options.whole else options.max_triangles or content.TRIANGLES
            how: dict[str, Any] = {"shown": not options.without_splats, "threads": threads}
            up = optional_up(options.up)
            options.reading.tell_of("converting", len(scene))
            made = content_of_splats(scene, cameras, max_triangles=most, up=up, **how)
            return replace(made, surface=beside)
        advice = "fine-tune it with ``max_triangles``, or make 'meshsplats tiles'"
        splats = None
        if options.splats is not None:
            # The page has the up of the mesh.
            drawn = options.reading.load(options.splats, scene.origin, find_up=False)
            splats = cropped(drawn, options.part.crop)
        if isinstance(scene, BaseMesh):
            return Content(None, splats, surface=scene)
        return replace(content_of_mesh(scene, splats, threads, say), surface=beside)
    except TooManyTrianglesError as error:
        raise OptionsError(f"{error}: {advice}") from None


def _surface(file: Path, scene: Shown) -> BaseMesh:
    """The surface in ``file``, where ``scene`` stands; OptionsError for a mesh whose colours are none of a
    surface."""
    try:
        return load_base(file, origin=scene.origin)
    except FileFormatError:
        raise
    except ValueError as error:
        raise OptionsError(
            f"``surface``: {file} is no surface, as one of 'meshsplats surface' is, but perhaps a mesh of"
            f" splats, whose colours depend on the view: {error}"
        ) from None


def _cameras(
    scene: Shown,
    source: Path,
    options: ViewingOptions,
    photographs: Dataset | None,
    say: Callable[[str], object],
    threads: int | None,
) -> list[Camera]:
    if photographs is not None:
        return [view.upright for view in photographs.views]
    if options.cameras is not None:
        return load_cameras(options.cameras, origin=scene.origin)
    beside = cameras_beside(source, scene.origin)
    opening = opening_beside(source, scene.origin) if isinstance(scene, GaussianCloud) else None
    first = [] if opening is None else [opening]
    if beside is not None and record_of(source) is None:
        return [*first, *beside]
    # As many as splats are merged for, where views are looked for: once is enough.
    searched = isinstance(scene, GaussianCloud) and not beside
    count, up = max(FOUND_VIEWS, VIEWS) if searched else FOUND_VIEWS, optional_up(options.up)
    if isinstance(scene, GaussianCloud):
        options.reading.tell_of("looking for views of", len(scene))
    found = default_views(scene, source, count, up=up, given=beside or (), threads=threads)
    if found is None:
        return first
    say(found[1])
    return found[0][:FOUND_VIEWS]
