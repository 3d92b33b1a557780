"""What Blender makes of files with splats, meshes, tilesets or chains of levels: images and scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from meshsplats._common.options import changed, check_options
from meshsplats._common.words import parse_color, parse_up
from meshsplats.blender import draw
from meshsplats.blender.launch import command
from meshsplats.blender.levels import Chain, LevelMeshes, is_chain, read_chain
from meshsplats.blender.options import (
    FAST_SAMPLES,
    FAST_SPLATS,
    LIGHTS,
    Engine,
    LightOptions,
    SceneOptions,
)
from meshsplats.blender.plan import in_words
from meshsplats.blender.subject import views_within
from meshsplats.cameras.files import save_cameras
from meshsplats.conversion import ConversionOptions, convert
from meshsplats.conversion.cleaning import cropped
from meshsplats.conversion.gaps import with_usual_look
from meshsplats.conversion.merging_views import convert_within_limits, views_of_place
from meshsplats.datasets.scene_files import PartOfScene, SceneReading
from meshsplats.datasets.scene_views import SceneViews
from meshsplats.errors import OptionsError
from meshsplats.formats.outputs import CAMERAS, CONFIGURATION, beside, check_outputs, view_names
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.tiles.drawing import MAX_ERROR, tiles_mesh
from meshsplats.tiles.source import open_tileset, outline
from meshsplats.tiles.tileset import Tileset

if TYPE_CHECKING:
    from meshsplats.blender import Progress

LIT_SAMPLES = 16
"""Default number of samples per pixel of lit images."""
TILE_TRIANGLES = 2_000_000
"""Triangles that Blender gets of a tileset: about 700 MB."""
_FORMATS = (".png", ".exr", ".blend")


@dataclass(frozen=True)
class PictureOptions:
    """What Blender makes of a scene in a file."""

    lit: bool = False
    """Light the splats, with the options under "light"."""
    engine: Engine = "cycles"
    """cycles: exact. eevee: faster on a graphics card, with triangles sorted per view, which is nearly
    exact."""
    views: SceneViews = field(default_factory=SceneViews)
    lights: Literal["sun", "noon", "overcast", "studio"] | None = None
    """Light the splats (``lit``) by an afternoon sun, the default, a high sun in a clear sky, clouds, or two
    large lamps. The options under "light" change them."""
    fast: bool = False
    """A quick lit preview (``lit``): up to 30,000 splats, 4 samples, rough light and colours."""
    light: LightOptions = field(default_factory=LightOptions)
    background: str = "white"
    """Background: white, black, grey, #rrggbb, or r,g,b from 0 to 1."""
    transparent: bool = False
    """No background: images with an alpha channel."""
    samples: int | None = None
    """Unlit: side of the sample grid in each pixel, as in render. Default: 2 (a .blend: 1). With ``lit``:
    samples per pixel. Default: 16 and denoised, for previews; 64 or more for final images."""
    no_denoise: bool = False
    """With ``lit``, cycles: do not denoise."""
    format: Literal["png", "exr"] = "png"
    """Format of the images in a folder."""
    executable: Path | None = None
    """An installed Blender, 4.2 or newer, to use instead of the module bpy."""
    threads: int | None = None
    """Maximum number of threads. Default: all processors."""
    reading: SceneReading = field(default_factory=SceneReading)
    part: PartOfScene = field(default_factory=PartOfScene)
    max_splats: int | None = None
    """Merge splats that are alike until at most this many are left: a preview in less time."""
    max_error: float | None = None
    """Tileset: take tiles whose geometric error is at most this many pixels in the images. Default: 1."""

    @property
    def is_lit(self) -> bool:
        """Whether lights shine on the splats."""
        return self.lit or self.fast or self.lights is not None

    def named_light(self) -> LightOptions:
        """The light of ``lights``, with those options of ``light`` that are not as by default. An environment
        image lights alone, unless ``lights`` or an option of the sun is given.

        In Python, a value that is the default of ``LightOptions`` cannot be told from none: for such a change
        of a named light, leave out ``lights`` and give ``replace(LIGHTS["noon"], sun_strength=2.5)`` as
        ``light``.
        """
        given = {name: getattr(self.light, name) for name in changed(self.light)}
        if "hdri" in given and self.lights is None and not any(name.startswith("sun") for name in given):
            given["sun_strength"] = 0.0
        return replace(LIGHTS[self.lights or "sun"], **given)

    def scene_options(self, output: Path) -> SceneOptions:
        """The scene for Blender, for an ``output`` of this name.

        Raises:
            OptionsError: options contradict each other or have no effect.
            ValueError: one is out of range.
            FileNotFoundError: the environment image is missing.
        """
        suffix = output.suffix.lower()
        check_options(self)
        self.views.check()
        if suffix and suffix not in _FORMATS:
            known = ", ".join(_FORMATS)
            raise OptionsError(f"``output`` must end in {known}, or name a folder, got {output.name!r}")
        if self.transparent and self.background != "white":
            raise OptionsError("``transparent`` and ``background`` exclude each other")
        if not self.is_lit and self.light != type(self.light)():
            raise OptionsError("the options of light need ``lit``")
        if self.no_denoise and (not self.is_lit or self.engine != "cycles"):
            raise OptionsError("``no_denoise`` is for ``lit`` with Cycles: other images are not denoised")
        if suffix and self.format != "png":
            raise OptionsError("``format`` is for a folder of images: the name given with ``output`` decides")
        if self.light.hdri is not None and self.background != "white":
            raise OptionsError("``background`` has no effect with ``hdri``, which is the background")
        if self.light.ground == "catcher" and self.background != "white":
            raise OptionsError(
                "``background`` has no effect with ``ground`` catcher, whose images have an alpha channel:"
                " leave it out, or choose a plane or none"
            )
        samples = self.samples
        if samples is None:
            lit = FAST_SAMPLES if self.fast else LIT_SAMPLES
            samples = lit if self.is_lit else 1 if suffix == ".blend" else 2
        elif suffix == ".blend" and not self.is_lit and samples > 1:
            raise OptionsError("``samples``: an unlit .blend takes one sample per pixel; render it larger")
        options = SceneOptions(
            light=self.named_light() if self.is_lit else None,
            engine=self.engine,
            samples=samples,
            background=None if self.transparent else parse_color(self.background),
            denoise=self.is_lit and self.engine == "cycles" and not self.no_denoise,
            threads=self.threads,
            fast=self.fast,
        )
        options.check()
        return options

    def chosen_views(self) -> SceneViews:
        """Mirror and ball need room beside the subject."""
        wide = self.is_lit and (self.light.mirror or self.light.glass) and self.views.cameras is None
        if wide and self.views.look_around is None and self.views.distance == 1.0:
            return replace(self.views, distance=1.7)
        return self.views

    @property
    def up(self) -> np.ndarray | None:
        """(3,) direction, where the user names it."""
        return None if self.views.up is None else parse_up(self.views.up)

    @property
    def most_splats(self) -> int | None:
        """To which splats are merged; None: not at all."""
        return self.max_splats or (FAST_SPLATS if self.fast else None)

    def merges(self, cloud: GaussianCloud) -> bool:
        """Whether it has more splats than that."""
        return len(cloud) > (self.most_splats or len(cloud))

    def converted(self, scene: GaussianCloud | SplatMesh, source: Path) -> SplatMesh:
        """The mesh of ``scene``, from ``source``. OptionsError for ``max_splats`` of a mesh."""
        if isinstance(scene, SplatMesh):
            if self.max_splats is not None:
                raise OptionsError("``max_splats`` is for splats: this is a mesh already")
            return scene
        # Crossed ellipses stand upright on the surface, where they catch too little light.
        mode: Literal["flat"] | None = "flat" if self.is_lit else None
        options = ConversionOptions(max_splats=self.most_splats, mode=mode)
        if not self.merges(scene):
            options = with_usual_look(scene, options, threads=self.threads)
        # Merging by what is seen takes three times as long; of an object, it is worth 0.4 dB.
        if self.fast and self.merges(scene) and self._is_object(scene, source):
            return convert(scene, options, up=self.up, threads=self.threads)
        return convert_within_limits(scene, options, up=self.up, source=source, threads=self.threads)

    def _is_object(self, cloud: GaussianCloud, source: Path) -> bool:
        return views_of_place(cloud, source, up=self.up, threads=self.threads) is None


@dataclass(frozen=True)
class Pictures:
    """What Blender made."""

    images: Sequence[Path]
    """None for a .blend."""
    cameras: Sequence[Camera]
    config: Path
    """For the record of the program that had it made."""
    triangles: int
    result: dict[str, Any]
    """As of ``draw``."""


@dataclass(frozen=True)
class PictureRun:
    """Images of the scene at ``source`` as ``output``: an image, a folder, or a .blend with a camera for each
    view. ``say`` gets lines about the work."""

    source: Path
    output: Path
    options: PictureOptions
    say: Callable[[str], object] = lambda text: None

    def save(
        self, *, force: bool = False, progress: Callable[[Progress, int], object] = lambda at, images: None
    ) -> Pictures:
        """Makes them, and the file of their cameras.

        Args:
            force: replace files that are there.
            progress: gets the progress of Blender, and the number of images.

        Raises what ``PictureOptions.scene_options``, ``check_outputs`` and ``draw`` raise, and OptionsError
        for several views of one file or images of a chain.
        """
        chosen, suffix = self.options, self.output.suffix.lower()
        options = chosen.scene_options(self.output)
        chain = self._chain(suffix)
        command(chosen.executable)
        blend = [self.output] if suffix == ".blend" else []
        records = [
            beside(self.output, record) if suffix else self.output / record
            for record in (CAMERAS, CONFIGURATION)
        ]
        # Before views are looked for, which takes longest; how many images a folder gets is known after it.
        folder = None if suffix else self.output
        check_outputs([*self._images(suffix, 1), *blend, *records], force, folder)
        tileset = open_tileset(self.source, crop=chosen.part.crop, max_error=chosen.max_error)
        scene, *coarser = [outline(tileset)] if tileset else self._scenes(chain)
        count = 1 if suffix else 60
        views = chosen.chosen_views()
        # The search for most views comes first: what asks for fewer, or for cameras, gets some of these.
        if isinstance(scene, GaussianCloud) and chosen.merges(scene):
            views_of_place(scene, self.source, up=chosen.up, threads=chosen.threads)
        if options.light is not None and not tileset:
            within = views_within(scene, self.source, up=chosen.up, threads=chosen.threads)
            options = replace(options, within=tuple(within))
        cameras = views.make(scene, self.source, count=count, side=800, film=not suffix, say=self.say)
        if suffix in (".png", ".exr") and len(cameras) > 1:
            raise OptionsError(f"{len(cameras):,} views do not fit one {suffix}: give ``output`` a folder")
        images = self._images(suffix, len(cameras))
        check_outputs([*images, *blend, *records], force, folder)
        mesh = self._tiles(tileset, cameras) if tileset else chosen.converted(scene, self.source)
        subject: SplatMesh | LevelMeshes = mesh
        if chain:
            levels = [mesh, *(chosen.converted(level, self.source) for level in coarser)]
            subject = LevelMeshes(chain.name, levels, [level.screen_size for level in chain.levels])
        if not suffix:
            self.output.mkdir(exist_ok=True)
        result = draw(
            subject,
            cameras,
            images=images,
            blend=self.output if blend else None,
            options=options,
            executable=chosen.executable,
            announce=lambda ahead: self.say(in_words(ahead, options, len(images))),
            progress=lambda at: progress(at, len(images)),
        )
        save_cameras(cameras, records[0], origin=scene.origin)
        return Pictures(images, cameras, records[1], len(mesh.faces), result)

    def _scenes(self, chain: Chain | None) -> list[GaussianCloud | SplatMesh]:
        """The scene, or those of the levels of a chain, relative to the origin of the finest."""
        files = [level.path for level in chain.levels] if chain else [self.source]
        part, reading, up = self.options.part, self.options.reading, self.options.views.up
        scenes = (reading.load_scene(file, up=up, threads=self.options.threads) for file in files)
        first, *others = (cropped(scene, part.crop) for scene in scenes)
        return [first, *(level.relative_to(first.origin) for level in others)]

    def _chain(self, suffix: str) -> Chain | None:
        """The chain of levels of detail that the source names, or None."""
        if not is_chain(self.source):
            return None
        if suffix != ".blend":
            raise OptionsError(
                f"{self.source}: a chain of levels of detail makes a .blend; for images, give one mesh of it"
            )
        return read_chain(self.source)

    def _tiles(self, tileset: Tileset, cameras: Sequence[Camera]) -> SplatMesh:
        """The tiles that the cameras need."""
        wanted = MAX_ERROR if self.options.max_error is None else self.options.max_error
        mesh, error = tiles_mesh(tileset, cameras, max_error=wanted, max_triangles=TILE_TRIANGLES)
        if error > wanted:
            self.say(
                f"the views need more than {TILE_TRIANGLES:,} triangles: errors are up to {error:.1f}, not"
                f" {wanted:g} pixels. Render views of parts, or 'meshsplats render', which draws in parts"
            )
        return mesh

    def _images(self, suffix: str, count: int) -> list[Path]:
        if suffix:
            return [] if suffix == ".blend" else [self.output]
        return [self.output / name for name in view_names(count, suffix=f".{self.options.format}")]
