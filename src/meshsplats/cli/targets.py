"""Options of targets: photographs, or images of the splats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import tyro

from meshsplats.camera import Camera
from meshsplats.cameras.files import cameras_beside, load_cameras
from meshsplats.cli import option
from meshsplats.cli.arguments import spelled
from meshsplats.cli.common import optional_up
from meshsplats.cli.messages import UsageError
from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.image_files import Masks
from meshsplats.datasets.views import Dataset
from meshsplats.finetuning.config import FEWEST_VIEWS
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

PLACING = ("placement", "distance", "up")
"""Options of cameras that are placed."""


@dataclass(frozen=True)
class TargetOptions:
    """Targets: photographs (--data), else images of the splats."""

    data: option.Folder = None
    """Data set of photographs (COLMAP, NeRF, nerfstudio, LLFF)."""
    downscale: option.Count = None
    """With --data: factor by which images are smaller than photographs. Default: by the minutes."""
    test_every: int = 8
    """With --data: every n-th view is held out, if the data set has no split; 0: none."""
    missing: option.Missing = "few"
    masks: tyro.conf.Fixed[Masks] = "count"
    """With --data: only pixels inside of masks count, or (subject) what is outside is clear."""
    views: option.Count = None
    """Without --data: number of training images. Default: one per second, or per two --steps, from 200 to
    1000."""
    held_out: int = 8
    """Without --data: number of further images, for scores."""
    width: int = 400
    """Without --data: side of the images in pixels."""
    distance: tyro.conf.Fixed[tuple[float, float]] = (0.9, 1.1)
    """Without --data: nearest and farthest camera outside, as multiples of the distance from which the
    sphere with 90 % of the splats' opacity just fits the image."""
    below: tyro.conf.Fixed[bool | None] = None
    """Without --data: views of an object from below, too. Default: with --order file."""
    placement: Literal["auto", "object", "surrounded", "inside", "found"] = "auto"
    """Without --data: cameras all around an object, above the ground around an object in its surroundings,
    in free places inside a room, or found from the splats as 'meshsplats cameras' does. auto: found, except
    for objects."""
    cameras: option.File = None
    """Without --data: cameras, a JSON list or a cameras.json of a 3DGS trainer. Default: those of a model
    folder, else placed ones (--placement)."""
    up: option.Text = None
    """Without --data: direction that points up, an axis (-y, z, ...) or x,y,z."""
    look: option.LookOfSplats = None
    """Images of splats. area: means over pixels, right at every size (with several samples: Blender, MSAA).
    splats: as in a 3DGS viewer, for this renderer. Default: area; of the other presets: splats."""
    sh_degree: option.Count = None
    """Without --data: render the splats with spherical harmonics up to this degree. Default: all that are
    stored."""
    cache: float = 2.0
    """Gigabytes of images kept in memory; others are read or rendered again when they are needed."""

    def check(self) -> None:
        """UsageError for options without effect."""
        idle = ("views", "held_out", "width", *PLACING, "below", "cameras", "look", "sh_degree")
        of_data = ("downscale", "test_every", "missing", "masks")
        names, source = (idle, "--data") if self.data is not None else (of_data, "splats")
        for name in names:
            if self._is_set(name):
                raise UsageError(f"{spelled(type(self), name)} has no effect with {source}")
        for name in (*PLACING, "below"):
            if self.cameras is not None and self._is_set(name):
                raise UsageError(f"{spelled(type(self), name)} has no effect with --cameras")
        if self.views is not None and self.views < 1:
            raise UsageError(f"--views must be at least 1, got {self.views}")
        if not self.cache >= 0:
            raise ValueError(f"--cache must be a number of gigabytes, >= 0, got {self.cache}")

    def _is_set(self, name: str) -> bool:
        return getattr(self, name) != next(f.default for f in fields(self) if f.name == name)

    def look_for(self, preset: str) -> Literal["area", "splats"]:
        return self.look or ("area" if preset == "default" else "splats")

    @property
    def cache_bytes(self) -> int:
        return int(self.cache * 1e9)

    def make(
        self,
        scene: GaussianCloud | SplatMesh,
        source: Path,
        background: Sequence[float],
        threads: int | None,
        worthwhile: int = FEWEST_VIEWS,
        preset: str = "default",
        zooms: Sequence[int] = (1,),
    ) -> Dataset:
        """The data set, relative to the origin of ``scene``: by default with ``worthwhile`` views, and with
        the look of the ``preset``. ``zooms``: of images of splats."""
        if self.data is not None:
            dataset = load_dataset(
                self.data,
                downscale=1 if self.downscale is None else self.downscale,
                test_every=self.test_every,
                background=background,
                cache_bytes=self.cache_bytes,
                missing=self.missing,
                masks=self.masks,
                origin=scene.origin,
            )
            if not dataset.train:
                raise ValueError(
                    f"{self.data}: all its {len(dataset.test)} views are held out, so there is nothing to"
                    " train on; --test-every 0 holds none out"
                )
            return dataset
        if not isinstance(scene, GaussianCloud):
            raise UsageError(f"{source} is a mesh: give its photographs with --data, or splats in its place")
        from meshsplats.datasets.splat_targets import splat_dataset

        if self.cameras is not None:
            cameras: list[Camera] | None = load_cameras(self.cameras, origin=scene.origin)
        else:
            given = any(map(self._is_set, PLACING))
            cameras = None if given else cameras_beside(source, scene.origin)
        return splat_dataset(
            scene,
            placement=self.placement,
            cameras=cameras,
            train=self.views or worthwhile,
            test=self.held_out,
            width=self.width,
            distance=self.distance,
            below=bool(self.below),
            up=optional_up(self.up),
            look=self.look_for(preset),
            zooms=zooms,
            sh_degree=self.sh_degree,
            background=background,
            threads=threads,
            cache_bytes=self.cache_bytes,
        )
