"""What a mesh is optimised on: photographs, or images of splats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from meshsplats._common.choices import Look, Masks
from meshsplats._common.options import Advanced, changed
from meshsplats._common.words import parse_up
from meshsplats.datasets.scene_views import MissingOfData
from meshsplats.errors import FileFormatError, OptionsError, OptionValueError
from meshsplats.finetuning.config import FEWEST_VIEWS

if TYPE_CHECKING:
    from meshsplats.datasets.views import Dataset
    from meshsplats.scene.camera import Camera
    from meshsplats.scene.gaussians import GaussianCloud
    from meshsplats.scene.mesh import SplatMesh

PLACING = ("placement", "distance", "up")
"""Options of cameras that are placed."""


def check_cache(gigabytes: float) -> None:
    """OptionValueError for what is no size of a cache."""
    if not gigabytes >= 0:
        raise OptionValueError(f"``cache`` must be a number of gigabytes, >= 0, got {gigabytes}")


@dataclass(frozen=True)
class Targets:
    """Photographs (``data``), else images of the splats."""

    data: Path | None = None
    """Data set of photographs (COLMAP, NeRF, nerfstudio, LLFF)."""
    downscale: int | None = None
    """With ``data``: factor by which images are smaller than photographs. Default: by the minutes."""
    test_every: int = 8
    """With ``data``: every n-th view is held out, if the data set has no split; 0: none."""
    missing: MissingOfData = "few"
    masks: Annotated[Masks, Advanced] = "count"
    """With ``data``: only pixels inside of masks count, or (subject) what is outside is clear."""
    views: int | None = None
    """Without ``data``: number of training images. Default: one per second, or per two ``steps``, from 200 to
    1000."""
    held_out: int = 8
    """Without ``data``: number of further images, for scores."""
    width: int = 400
    """Without ``data``: side of the images in pixels."""
    distance: Annotated[tuple[float, float], Advanced] = (0.9, 1.1)
    """Without ``data``: nearest and farthest camera outside, as multiples of the distance from which the
    sphere with 90 % of the splats' opacity just fits the image."""
    below: Annotated[bool | None, Advanced] = None
    """Without ``data``: views of an object from below, too. Default: with ``order`` file."""
    placement: Literal["auto", "object", "surrounded", "inside", "found"] = "auto"
    """Without ``data``: cameras all around an object, above the ground around an object in its surroundings,
    in free places inside a room, or found from the splats as 'meshsplats cameras' does. auto: found, except
    for objects."""
    cameras: Path | None = None
    """Without ``data``: cameras, a JSON list or a cameras.json of a 3DGS trainer. Default: those of a model
    folder, else placed ones (``placement``)."""
    up: str | None = None
    """Without ``data``: direction that points up, an axis (-y, z, ...) or x,y,z."""
    look: Look | None = None
    """Images of splats. area: means over pixels, right at every size (with several samples: Blender, MSAA).
    splats: as in a 3DGS viewer, for this renderer. Default: area, gaps closed; other presets: splats."""
    sh_degree: int | None = None
    """Without ``data``: render the splats with spherical harmonics up to this degree. Default: all that are
    stored."""
    cache: float = 2.0
    """Gigabytes of images kept in memory; others are read or rendered again when they are needed."""

    def look_for(self, preset: str) -> Look:
        """The look of images of splats for a ``preset`` of fine-tuning."""
        return self.look or ("area" if preset == "default" else "splats")

    def check(self) -> None:
        """OptionsError for options without effect, OptionValueError for values out of range."""
        idle = ("views", "held_out", "width", *PLACING, "below", "cameras", "look", "sh_degree")
        of_data = ("downscale", "test_every", "missing", "masks")
        names, source = (idle, "``data``") if self.data is not None else (of_data, "splats")
        given = changed(self)
        for name in names:
            if name in given:
                raise OptionsError(f"``{name}`` has no effect with {source}")
        for name in (*PLACING, "below"):
            if self.cameras is not None and name in given:
                raise OptionsError(f"``{name}`` has no effect with ``cameras``")
        if self.views is not None and self.views < 1:
            raise OptionsError(f"``views`` must be at least 1, got {self.views}")
        check_cache(self.cache)

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
        """The data set, relative to the origin of ``scene``.

        Args:
            scene: what is optimised; without photographs, splats.
            source: its file or folder, which may have cameras.
            background: (3,) display RGB behind it.
            threads: maximum number of threads; None: all processors.
            worthwhile: number of training images of splats, where ``views`` does not say.
            preset: of the fine-tuning, for the look of images of splats.
            zooms: of these images, as for ``splat_dataset``.

        Raises FileFormatError if no view is left to train on, and what ``load_dataset`` or ``splat_dataset``
        do.
        """
        from meshsplats._common.kinds import need
        from meshsplats.cameras.files import load_cameras
        from meshsplats.datasets.folder import load_dataset
        from meshsplats.datasets.splat_targets import splat_dataset
        from meshsplats.scene.gaussians import GaussianCloud
        from meshsplats.scene.mesh import SplatMesh
        from meshsplats.viewpoints.beside import cameras_beside, that_see

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
                raise FileFormatError(
                    f"{self.data}: all its {len(dataset.test)} views are held out, so there is nothing to"
                    " train on; ``test_every`` 0 holds none out"
                )
            return dataset
        if isinstance(scene, SplatMesh):
            raise OptionsError(
                f"{source} is a mesh: give its photographs with ``data``, or splats in its place"
            )
        need(GaussianCloud, scene=scene)
        assert isinstance(scene, GaussianCloud)
        if self.cameras is not None:
            cameras: list[Camera] | None = load_cameras(self.cameras, origin=scene.origin)
        else:
            placed = not set(PLACING).isdisjoint(changed(self))
            cameras = None if placed else that_see(cameras_beside(source, scene.origin), scene)
        return splat_dataset(
            scene,
            placement=self.placement,
            cameras=cameras,
            train=self.views or worthwhile,
            test=self.held_out,
            width=self.width,
            distance=self.distance,
            below=bool(self.below),
            up=None if self.up is None else parse_up(self.up),
            look=self.look_for(preset),
            zooms=zooms,
            sh_degree=self.sh_degree,
            background=background,
            threads=threads,
            cache_bytes=self.cache_bytes,
        )
