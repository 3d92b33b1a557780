"""Images of a scene as files: one, or a folder of views with depth images and a turntable."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from meshsplats._common.kinds import as_path
from meshsplats._files.atomic import write_bytes
from meshsplats.cameras.files import save_cameras
from meshsplats.cluster import Workers, open_workers
from meshsplats.conversion.cleaning import cropped
from meshsplats.datasets.views import Dataset
from meshsplats.errors import DataWarning, OptionsError, OptionValueError
from meshsplats.evaluation.backgrounds import choose_background
from meshsplats.formats.outputs import CAMERAS, CONFIGURATION, beside, check_outputs, view_names
from meshsplats.rendering.drawing import announce_cost
from meshsplats.renders.frames import FrameOptions, Scene, depth_unit, draw_frames, remove_older
from meshsplats.renders.options import ImageOptions
from meshsplats.scene.camera import Camera, hiding_near_plane
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.tiles.drawing import MAX_ERROR
from meshsplats.tiles.source import open_tileset, outline
from meshsplats.tiles.tileset import Tileset


@dataclass(frozen=True)
class ImageFiles:
    """The outputs."""

    images: Sequence[Path]
    depths: Sequence[Path]
    turntable: Path | None
    cameras: Path
    config: Path
    """For the record of the program that makes them."""

    @property
    def every(self) -> list[Path]:
        """All of them."""
        turntable = [self.turntable] if self.turntable else []
        return [*self.images, *self.depths, *turntable, self.cameras, self.config]


@dataclass(frozen=True)
class SavedImages:
    """Images that were made."""

    files: ImageFiles
    cameras: Sequence[Camera]
    record: dict[str, Any]
    """The background, and the unit of depth images."""


def say_nothing(text: str) -> None:
    """For who wants no lines about the work."""


def in_this_process(threads: int | None) -> AbstractContextManager[Workers]:
    """Workers of this process."""
    return open_workers(None, threads)


@dataclass(frozen=True)
class ImageRun:
    """Images of the scene at ``source`` as ``output``, a .png or a folder.

    ``say`` gets lines about what is drawn. ``workers``: opens the workers with at most so many threads each.
    """

    source: Path
    output: Path
    options: ImageOptions = field(default_factory=ImageOptions)
    say: Callable[[str], object] = say_nothing
    workers: Callable[[int | None], AbstractContextManager[Workers]] = in_this_process

    def __post_init__(self) -> None:
        for name in ("source", "output"):
            object.__setattr__(self, name, as_path(name, getattr(self, name)))

    def save(
        self, *, force: bool = False, progress: Callable[[Iterable[Any], int], Iterable[Any]] | None = None
    ) -> SavedImages:
        """Makes them, and the file of their cameras.

        Args:
            force: replace images that are there.
            progress: shows the progress of images, of which there are so many, and passes them on.

        Raises what ``ImageOptions.check`` and ``check_outputs`` raise, and OptionsError for several views of
        one file.
        """
        chosen, single = self.options, self.output.suffix.lower() == ".png"
        chosen.check(self.output)
        tileset = open_tileset(self.source, crop=chosen.part.crop, max_error=chosen.max_error)
        scene = outline(tileset) if tileset else self._read()
        self._check_scene(scene)
        photographs = chosen.views.photographs(scene.origin)
        how: dict[str, Any] = {"photographs": photographs, "film": not single, "say": self.say}
        cameras = chosen.views.make(scene, self.source, count=1 if single else 60, side=800, **how)
        if tileset is None:
            places = scene.means if isinstance(scene, GaussianCloud) else scene.vertices
            if hidden := hiding_near_plane(cameras, places):
                warnings.warn(f"the cameras see nothing: {hidden}", DataWarning, stacklevel=2)
        if single and len(cameras) > 1:
            raise OptionsError(f"{len(cameras):,} views do not fit one .png: give ``output`` a folder")
        files = self._files(single, len(cameras))
        check_outputs(files.every, force, None if single else self.output)
        scene, record = self._drawable(scene), dict[str, Any]()
        unit = None
        if chosen.depth == "png" and isinstance(scene, SplatMesh):
            points = tileset.root.corners() if tileset else scene.vertices
            record["depth_unit"] = unit = depth_unit(points, cameras)
        color = (0.0, 0.0, 0.0)
        if not chosen.transparent:
            color, about = self._background(scene, photographs)
            record |= about
        if not single:
            remove_older(self.output, files.every)
        self._draw(tileset or scene, cameras, files, self._frame_options(color, unit), progress)
        if files.turntable:
            from meshsplats.images.reading import load_image
            from meshsplats.images.writing import save_animation

            save_animation(files.turntable, map(load_image, files.images), fps=chosen.fps)
        save_cameras(cameras, files.cameras, origin=scene.origin)
        return SavedImages(files, cameras, record)

    def load(self) -> Scene:
        """What is drawn, from the source."""
        chosen = self.options
        tileset = open_tileset(self.source, crop=chosen.part.crop, max_error=chosen.max_error)
        return tileset or self._drawable(self._read())

    def _read(self) -> GaussianCloud | SplatMesh:
        chosen = self.options
        threads = chosen.draw.threads
        scene = chosen.reading.load_scene(self.source, up=chosen.views.up, threads=threads)
        return cropped(scene, chosen.part.crop)

    def _check_scene(self, scene: GaussianCloud | SplatMesh) -> None:
        if isinstance(scene, SplatMesh) and self.options.as_splats:
            raise OptionValueError(f"{self.source} is a mesh: ``as_splats`` needs a splat file")
        if self.options.draw.sh_degree is not None and not self.options.as_splats:
            raise OptionsError(
                "``sh_degree`` limits the harmonics of splats: add ``as_splats`` to render them"
            )

    def _drawable(self, scene: GaussianCloud | SplatMesh) -> GaussianCloud | SplatMesh:
        """``scene``, converted if it is splats that are to be drawn as a mesh."""
        if isinstance(scene, SplatMesh) or self.options.as_splats:
            return scene
        from meshsplats.conversion import convert
        from meshsplats.conversion.gaps import with_usual_look

        return convert(scene, with_usual_look(scene, threads=self.options.draw.threads))

    def _background(
        self, scene: GaussianCloud | SplatMesh, photographs: Dataset | None
    ) -> tuple[tuple[float, float, float], dict[str, Any]]:
        kind, draw = "splats" if isinstance(scene, GaussianCloud) else "mesh", self.options.draw
        found = choose_background(
            draw.color, photographs, {kind: scene}, self.source, draw.threads, whole=False
        )
        return found.color, found.to_dict()

    def _files(self, single: bool, count: int) -> ImageFiles:
        out, depth, animation = self.output, self.options.depth, self.options.animation
        if single:
            depths = [out.with_suffix(f".depth.{depth}")] if depth != "none" else []
            return ImageFiles([out], depths, None, beside(out, CAMERAS), beside(out, CONFIGURATION))
        images = [out / name for name in view_names(count)]
        depths = [] if depth == "none" else [out / name for name in view_names(count, "depth", f".{depth}")]
        turns = self.options.views.moving and animation != "none" and count > 1
        turntable = out / f"turntable.{animation}" if turns else None
        return ImageFiles(images, depths, turntable, out / CAMERAS, out / CONFIGURATION)

    def _frame_options(self, color: tuple[float, float, float], unit: float | None) -> FrameOptions:
        chosen, draw = self.options, self.options.draw
        return FrameOptions(
            background=color,
            transparent=chosen.transparent,
            samples=draw.samples,
            sh_degree=draw.sh_degree,
            max_layers=draw.max_layers,
            cutoff=chosen.cutoff,
            order=draw.order,
            device=draw.device,
            depth=chosen.depth,
            depth_unit=unit,
            max_error=MAX_ERROR if chosen.max_error is None else chosen.max_error,
        )

    def _draw(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        files: ImageFiles,
        chosen: FrameOptions,
        progress: Callable[[Iterable[Any], int], Iterable[Any]] | None,
    ) -> None:
        threads = self.options.draw.threads
        chosen = chosen.for_scene(scene, cameras)
        if not isinstance(scene, Tileset):
            announce_cost(scene, cameras, chosen.samples or 1, threads, self.say)
        with self.workers(threads) as workers:
            drawn: Iterable[Any] = draw_frames(scene, cameras, chosen, workers=workers, load=self.load)
            for i, (image, depth) in progress(drawn, len(cameras)) if progress else drawn:
                if not files.images[i].parent.exists():
                    files.images[i].parent.mkdir()  # not before there is something to write
                write_bytes(files.images[i], image)
                if depth is not None:
                    write_bytes(files.depths[i], depth)
