"""Cameras for images of a scene: around it, inside it, from a file, or those of photographs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from meshsplats._common.choices import MAX_SIDE, Masks, Missing
from meshsplats._common.options import Help, Range, changed, check_options
from meshsplats._common.words import parse_up
from meshsplats.errors import OptionsError

if TYPE_CHECKING:
    import numpy as np

    from meshsplats.datasets.views import Dataset
    from meshsplats.scene.camera import Camera
    from meshsplats.scene.gaussians import GaussianCloud
    from meshsplats.scene.mesh import SplatMesh

    Origin = Sequence[float] | np.ndarray

MissingOfData = Annotated[
    Missing,
    Help(
        "With ``data``, where images are missing. few: leave their views out if fewer than half are missing,"
        " else an error; skip: leave any number out; error: always an error."
    ),
]
"""An option of whatever has an option ``data``, a data set of photographs."""
MasksOfData = Annotated[
    Masks, Help("With ``data``: only pixels inside of masks count, or masks cut out a subject.")
]
"""Another."""
WAYS_OF_VIEWS = (("orbit", "dome", "look_around", "cameras", "data"), ("fov", "focal_length"))
"""Options of views of which one may be given."""


def cameras_named(
    cameras: Path | None, data: Path | None, missing: Missing = "few", origin: Origin = (0, 0, 0)
) -> list[Camera] | None:
    """The cameras in a file, or those of the training views of a data set, as they were held, relative to
    ``origin`` (3,); None if neither is named. ``missing``: as in ``load_dataset``."""
    from meshsplats.cameras.files import load_cameras
    from meshsplats.datasets.folder import load_dataset

    if data is not None:
        dataset = load_dataset(data, missing=missing, origin=origin)
        return [view.upright for view in dataset.train or dataset.views]
    return None if cameras is None else load_cameras(cameras, origin=origin)


def check_photographs(
    data: Path | None, missing: Missing, cameras: Path | None = None, masks: Masks = "count"
) -> None:
    """OptionsError for ``missing`` and ``masks`` without ``data``, and for ``cameras`` with it."""
    if cameras is not None and data is not None:
        raise OptionsError("give ``cameras`` or ``data``, not both")
    if missing != "few" and data is None:
        raise OptionsError("``missing`` has no effect without ``data``")
    if masks != "count" and data is None:
        raise OptionsError("``masks`` has no effect without ``data``")


@dataclass(frozen=True)
class SceneViews:
    """From where images of a scene are taken, and their size. ``orbit``, ``dome``, ``look_around``,
    ``cameras`` and ``data`` exclude each other."""

    orbit: int | None = None
    """N views on a circle around the subject; in splats of a place, on a round through its own cameras or
    views found in it, unless ``elevation``, ``azimuth``, ``distance``, ``look_at``, ``fov`` or
    ``focal_length`` is given."""
    dome: int | None = None
    """N views spread evenly over the upper half of a sphere around the subject."""
    look_around: int | None = None
    """N views from the middle of the scene, such as a room, in one full turn."""
    cameras: Path | None = None
    """Camera file: a JSON list, a cameras.json of a 3DGS trainer, a camera_path.json of nerfstudio; or the
    model folder that has one."""
    data: Path | None = None
    """Data set of photographs (COLMAP, NeRF-synthetic, nerfstudio, LLFF): the cameras of its test views."""
    downscale: int = 1
    """With ``data``: factor by which images are smaller than the photographs."""
    missing: MissingOfData = "few"
    elevation: float | None = None
    """Degrees above the horizon. Default: 15; 0 with ``look_around``."""
    azimuth: float | None = None
    """Degrees of the first view: 0 from the front, 90 from the subject's right-hand side in that view.
    Default: 0; of a single image, the side of an object that shows most."""
    distance: float = 1.0
    """Multiple of the distance from which the subject just fits the image."""
    look_at: tuple[float, float, float] | None = None
    """Point to look at and to circle, in the coordinates of the file. Default: the middle of the subject."""
    fov: float | None = None
    """Field of view across the shorter side of the image, degrees. Default: 45; 75 with ``look_around``."""
    focal_length: Annotated[float | None, Range(1, 2000)] = None
    """Focal length in mm on 35 mm film, whose 36 mm span the image width: 50 is normal, 85 for portraits, 24
    wide. In place of ``fov``."""
    up: str | None = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the cameras in a model
    folder, of the file, else -y, as in COLMAP's scenes, z of a survey, or as an object stands."""
    width: Annotated[int | None, Range(1, MAX_SIDE)] = None
    """Image width in pixels. With ``cameras`` or ``data``, images are scaled to this width."""
    height: Annotated[int | None, Range(1, MAX_SIDE)] = None
    """Image height in pixels. Default: the width. Not with ``cameras`` or ``data``."""

    def check(self) -> None:
        """OptionsError for options that exclude each other or have no effect."""
        if self.downscale != 1 and (self.data is None or self.width is not None):
            idle, both = "``downscale`` has no effect without ``data``", "give ``downscale`` or ``width``"
            raise OptionsError(idle if self.data is None else both)
        check_photographs(self.data, self.missing)
        modes = [name for name in WAYS_OF_VIEWS[0] if getattr(self, name) is not None]
        if len(modes) > 1:
            raise OptionsError(f"give one of {', '.join(f'``{mode}``' for mode in modes)}, not several")
        if self.fov is not None and self.focal_length is not None:
            raise OptionsError("give ``fov`` or ``focal_length``, not both")
        placing = ("elevation", "azimuth", "distance", "look_at", "fov", "focal_length", "up", "height")
        without_effect = {
            "dome": ("elevation", "azimuth"),
            "look_around": ("distance", "look_at"),
            "cameras": placing,
            "data": placing,
        }
        for mode in modes:
            for name in without_effect.get(mode, ()):
                if name in changed(self):
                    raise OptionsError(f"``{name}`` has no effect with ``{mode}``")

    @property
    def moving(self) -> bool:
        """Whether the views make a turntable."""
        return self.cameras is None and self.data is None and self.dome is None

    @property
    def _placed(self) -> bool:
        """Whether an option says where cameras stand or what lens they have."""
        placing = {"dome", "elevation", "azimuth", "distance", "look_at", "fov", "focal_length"}
        return not placing.isdisjoint(changed(self))

    def photographs(self, origin: np.ndarray) -> Dataset | None:
        """The data set of ``data``, relative to ``origin``, or None."""
        from meshsplats.datasets.folder import load_dataset

        if self.data is None:
            return None
        return load_dataset(self.data, downscale=self.downscale, missing=self.missing, origin=origin)

    def make(
        self,
        scene: GaussianCloud | SplatMesh,
        source: Path,
        *,
        count: int,
        side: int,
        photographs: Dataset | None = None,
        film: bool = False,
        say: Callable[[str], object] = lambda text: None,
    ) -> list[Camera]:
        """The cameras, relative to the origin of ``scene``.

        Args:
            scene: splats or a mesh.
            source: its file or folder, which may have cameras.
            count: number of the default views, of an orbit or found in a place.
            side: their size in pixels.
            photographs: the result of ``photographs()``, if it is at hand.
            film: the default views follow each other smoothly, as those of ``orbit`` do.
            say: gets a line that says where views of a place come from.

        Raises ValueError for values out of range, FileFormatError and OSError for files that cannot be read.
        """
        from meshsplats.cameras.files import load_cameras
        from meshsplats.cameras.framing import guess_up
        from meshsplats.cameras.trajectories import dome, look_around, orbit
        from meshsplats.viewpoints.beside import cameras_beside
        from meshsplats.viewpoints.opening import opening_azimuth
        from meshsplats.viewpoints.showing import default_views

        check_options(self)
        if self.cameras is not None or self.data is not None:
            if dataset := photographs or self.photographs(scene.origin):
                cameras = [view.camera for view in dataset.test or dataset.views]
            else:
                assert self.cameras is not None
                cameras = load_cameras(self.cameras, origin=scene.origin)
            return cameras if self.width is None else [c.scaled(self.width / c.width) for c in cameras]
        width = next(v for v in (self.width, self.height, side) if v is not None)
        lens: dict[str, Any] = {"width": width, "height": width if self.height is None else self.height}
        beside = None if self.up is not None else cameras_beside(source, scene.origin)
        lens["up"] = guess_up(scene, beside) if self.up is None else parse_up(self.up)
        fov = self.fov
        if self.focal_length is not None:
            shorter = 36 * min(1.0, lens["height"] / lens["width"])
            import numpy as np

            fov = float(np.degrees(2 * np.arctan(shorter / (2 * self.focal_length))))
        if self.look_around is not None:
            lens["elevation"] = 0.0 if self.elevation is None else self.elevation
            lens["fov"] = 75.0 if fov is None else fov
            return look_around(scene, self.look_around, azimuth=self.azimuth or 0.0, **lens)
        if not self._placed:
            size, told = (width, lens["height"]), None if self.up is None else lens["up"]
            number = count if self.orbit is None else self.orbit
            film = (film or self.orbit is not None) and number > 1
            if found := default_views(scene, source, number, side=size, up=told, film=film):
                say(found[1])
                return found[0]
        lens["fov"] = 45.0 if fov is None else fov
        target = None if self.look_at is None else self.look_at - scene.origin
        lens |= {"distance": self.distance, "target": target}
        if self.dome is not None:
            return dome(scene, self.dome, **lens)
        lens["elevation"] = 15.0 if self.elevation is None else self.elevation
        number, azimuth = count if self.orbit is None else self.orbit, self.azimuth
        if azimuth is None:
            azimuth = opening_azimuth(scene, up=lens["up"]) if number == 1 and not film else 0.0
        return orbit(scene, number, azimuth=azimuth, **lens)
