"""Surfaces of scenes in files, as the files of their levels of detail, with a preview."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._files.atomic import together
from meshsplats.cameras.files import load_cameras
from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.scene_files import SceneReading
from meshsplats.datasets.scene_views import MasksOfData, MissingOfData, check_photographs
from meshsplats.errors import OptionsError
from meshsplats.formats import base_meshes
from meshsplats.formats.outputs import CONFIGURATION, PREVIEW, beside, check_outputs, scaled
from meshsplats.formats.surfaces.solids import upright
from meshsplats.images.writing import save_image
from meshsplats.rendering.previews import SIDE
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.surfaces import draw_surface
from meshsplats.surfaces.fusion import parts_of
from meshsplats.surfaces.making import surfaces_from
from meshsplats.surfaces.options import SurfaceOptions, level_options
from meshsplats.surfaces.views import Sources, place_of, sources_of
from meshsplats.viewpoints.finding import FoundCameras
from meshsplats.viewpoints.opening import opening_camera

_PRINT = 100.0
"""Millimetres of the longest side of a print that ``scale`` is named for."""
_VIEWS = 8
"""Cameras in the file of a place."""


@dataclass(frozen=True)
class SurfaceFileOptions:
    """Surfaces and their files."""

    surface: SurfaceOptions = field(default_factory=SurfaceOptions)
    levels: int = 1
    """Levels of detail, each with a quarter of the triangles of the one before: MESH.glb, MESH_lod1.glb..."""
    data: Path | None = None
    """Data set of photographs to fit shape and texture to, in place of images of the scene."""
    missing: MissingOfData = "few"
    masks: MasksOfData = "count"
    cameras: Path | None = None
    """Camera file: from where images are made, in place of ``views``."""
    unlit: bool = False
    """A material that shows the texture as it is, without lights."""
    image: base_meshes.TextureImage | None = None
    """File of the texture. Default: png, or jpg where that is large and the format knows it."""
    collision: base_meshes.Collision | None = None
    """Mark the surface as a static collider for engines. drawn (.glb, USD): rendered, too; only (.glb, USD):
    not rendered; convex (.glb): rendered, its convex decomposition being the collider in Unreal. Default:
    no collider."""
    scale: float | None = None
    """Multiply all lengths: a scene unit of .stl and .3mf is a millimetre."""
    no_preview: bool = False
    """Write no preview."""

    def checked(self, output: Path) -> SurfaceOptions:
        """The options of the finest surface, of which those are by default that are None.

        Raises:
            OptionsError: options contradict each other, have no effect or do not fit the name ``output``.
            ValueError: one is out of range.
        """
        suffix, known = output.suffix.lower(), ", ".join(base_meshes.BASE_SUFFIXES)
        printed, plain = suffix in base_meshes.PRINTED, suffix in base_meshes.UNTEXTURED
        if suffix not in base_meshes.BASE_SUFFIXES:
            raise OptionsError(f"``output`` must end in {known}, got {output.name!r}")
        base_meshes.check_writing(output, unlit=self.unlit, image=self.image, collision=self.collision)
        if printed and self.surface.shape in ("open", "floor"):
            raise OptionsError(f"{suffix} is for printing, which wants a solid: ``shape`` closed")
        if plain and self.surface.texture:
            raise OptionsError(f"``texture`` is for formats that hold one, not for {suffix}")
        if self.image is not None and (plain or self.surface.texture == 0):
            raise OptionsError("``image`` is the file of a texture, and there is none")
        check_photographs(self.data, self.missing, self.cameras, self.masks)
        if self.scale is not None and not 0 < self.scale < np.inf:
            raise OptionsError(f"``scale`` must be above 0, got {self.scale}")
        given = {name: value for name, value in asdict(self.surface).items() if value is not None}
        given |= ({"texture": 0} if plain else {}) | ({"shape": "closed"} if printed else {})
        options = SurfaceOptions(**given).checked()
        level_options(options.sized(closed=True), self.levels)  # open surfaces have more of everything
        return options


@dataclass(frozen=True)
class SurfaceRun:
    """The surfaces of the scene at ``source`` as ``output``, the file of the finest one.

    ``place`` makes of a surface the one that is written; ``record`` writes what is noted at this path, with
    which the surfaces appear; ``say`` gets lines about them.
    """

    source: Path
    output: Path
    options: SurfaceFileOptions = field(default_factory=SurfaceFileOptions)
    reading: SceneReading = field(default_factory=SceneReading)
    threads: int | None = None
    place: Callable[[BaseMesh], BaseMesh] = lambda base: base
    record: Callable[[Path], object] = lambda path: None
    say: Callable[[str], object] = lambda text: None

    @property
    def preview(self) -> Path:
        """Its file, where there is one."""
        return beside(self.output, PREVIEW)

    def check(self, force: bool) -> SurfaceOptions:
        """``SurfaceFileOptions.checked``. OSError for outputs that exist, unless ``force``, or cannot be
        written, OverwritingError if one of them is the source."""
        chosen, options = self.options, self.options.checked(self.output)
        meshes, textured = base_meshes.level_files(self.output, chosen.levels), chosen.collision != "only"
        more = [
            path
            for mesh in meshes
            for path in base_meshes.companions(mesh, chosen.image)
            if options.texture != 0 and textured
        ]
        previews = [] if chosen.no_preview else [self.preview]
        outputs = [*meshes, *more, beside(self.output, CONFIGURATION), *previews]
        check_outputs(outputs, force, inputs=[self.source])
        return options

    def save(
        self, *, force: bool = False, progress: Callable[[str, int, int], object] | None = None
    ) -> tuple[GaussianCloud | SplatMesh, list[tuple[Path, BaseMesh]]]:
        """Makes them. The scene, and each file with its surface.

        Args:
            force: replace files that are there.
            progress: as for ``surfaces_from``.
        """
        chosen, options = self.options, self.check(force)
        said = progress or (lambda *_: None)
        said("reading", 0, 1)
        scene = self.reading.load_scene(self.source, threads=self.threads)
        data = None
        if chosen.data is not None:
            how: dict[str, Any] = {"missing": chosen.missing, "masks": chosen.masks}
            data = load_dataset(chosen.data, **how, origin=scene.origin)
        given = None if chosen.cameras is None else load_cameras(chosen.cameras, origin=scene.origin)
        said("looking for views", 0, 1)
        sources = sources_of(scene, data, given, options, self.threads)
        if options.shape == "auto" and sources.closed and sources.found is None:
            self.say("taken for an object, as its triangles are no splats: ``shape`` open is for places")
        sized = options.sized(sources.closed)
        chosen_here = [f"at most {sized.faces:,} triangles"] if options.faces is None else []
        chosen_here += [f"a texture of {sized.texture} texels"] if options.texture is None else []
        if chosen_here and not sources.closed:
            self.say(f"an open surface: by default {', '.join(chosen_here)}")
        bases = surfaces_from(scene, sources, options, chosen.levels, threads=self.threads, progress=said)
        files = base_meshes.level_files(self.output, chosen.levels)
        save = partial(
            base_meshes.save_base, unlit=chosen.unlit, image=chosen.image, collision=chosen.collision
        )
        said("saving", 0, 1)
        asked = sources.found is not None or not chosen.no_preview
        place = place_of(scene, sources) if asked else None
        views = self._views(place, sources) if place is not None else []
        with together():
            for base, path in zip(bases, files, strict=True):
                here = scaled(base, chosen.scale)
                there = self.place(here)
                moved = np.mean(here.vertices.astype(np.float64) - there.vertices, axis=0)
                has_views = path == files[0] and path.suffix.lower() in base_meshes.SHADED
                own = [camera.relative_to(moved) for camera in views] if has_views else ()
                save(there, path, cameras=own)
            if self.output.suffix.lower() in base_meshes.PRINTED:
                self._say_size(bases[0])
            self.record(beside(self.output, CONFIGURATION))
            if not chosen.no_preview:
                self._draw_preview(scene, bases[0], place)
        return scene, list(zip(files, bases, strict=True))

    def rows(self, made: Sequence[tuple[Path, BaseMesh]]) -> list[dict[str, Any]]:
        """What there is to say of each file, for JSON; of prints with their sides in millimetres, z last, and
        how many solids there are that do not touch."""
        found: list[dict[str, Any]] = [
            {"mesh": str(path), "triangles": len(base.faces), "bytes": path.stat().st_size}
            for path, base in made
        ]
        if self.output.suffix.lower() in base_meshes.PRINTED:
            for row, (_, base) in zip(found, made, strict=True):
                row |= {"millimetres": self._sides(base), "solids": _solids(base)}
        return found

    def _sides(self, base: BaseMesh) -> list[float]:
        """Sides of a print, z last."""
        sides = np.ptp(upright(scaled(base, self.options.scale)), axis=0)
        return [float(f"{side:.4g}") for side in sides]

    def _say_size(self, base: BaseMesh) -> None:
        """A line about the size and the solids of a print: splats have no unit, so it may be tiny."""
        sides, solids = self._sides(base), _solids(base)
        text = " x ".join(f"{side:g}" for side in sides) + " mm"
        if self.options.scale is None:
            text += f"; ``scale`` {_PRINT / max(sides):.3g} makes it {_PRINT:g} mm"
        if solids > 1:
            text += f"; {solids} solids that do not touch"
        self.say(text)

    def _views(self, place: FoundCameras, sources: Sources) -> list[Camera]:
        """Views of the place in the units of the surface that is written, the first one to open with."""
        factor = 1.0 if self.options.scale is None else self.options.scale
        seen = [*place.cameras[:_VIEWS], *subsample(sources.depth, _VIEWS - 1)][:_VIEWS]
        made = []
        for camera in seen:
            matrix = camera.world_to_camera.copy()
            matrix[:3, 3] *= factor
            near = None if camera.near is None else camera.near * factor
            made.append(replace(camera, world_to_camera=matrix, near=near))
        return made

    def _draw_preview(
        self, scene: GaussianCloud | SplatMesh, base: BaseMesh, place: FoundCameras | None
    ) -> None:
        if place is None:
            camera = opening_camera(scene, self.threads)
        else:
            self.say(place.seen_in_words())
            camera = place.cameras[0].within(SIDE)
        save_image(self.preview, draw_surface(base, camera, threads=self.threads))


def _solids(base: BaseMesh) -> int:
    return int(parts_of(base.faces, len(base.vertices)).max()) + 1
