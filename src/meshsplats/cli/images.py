"""Options of the commands that make images: cameras, sizes, how images are rendered, what they cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from meshsplats.camera import MAX_SIDE, Camera
from meshsplats.cameras.files import cameras_beside, load_cameras
from meshsplats.cameras.framing import guess_up
from meshsplats.cameras.trajectories import dome, look_around, orbit
from meshsplats.cli import option
from meshsplats.cli.common import check_data, parse_up
from meshsplats.cli.messages import UsageError, flag, say
from meshsplats.datasets.views import Dataset
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

OrderOfBlending = Annotated[
    Literal["fragment", "splat"] | None, tyro.conf.arg(metavar="{fragment,splat}", help_behavior_hint="")
]
EXCLUSIVE_VIEWS = (("orbit", "dome", "look_around", "cameras", "data"), ("fov", "focal_length"))
"""Options of views of which one may be given."""
LONG_SECONDS = 10
"""Images that take longer than this, as far as can be estimated, are announced."""


@dataclass(frozen=True)
class ViewOptions:
    """Cameras and image size. Orbit, dome, look-around, cameras and data exclude each other."""

    orbit: option.Count = None
    """N views on a circle around the subject; in splats of a place, on a round through its own cameras or
    views found in it, unless --elevation, --azimuth, --distance, --look-at, --fov or --focal-length is
    given."""
    dome: option.Count = None
    """N views spread evenly over the upper half of a sphere around the subject."""
    look_around: option.Count = None
    """N views from the middle of the scene, such as a room, in one full turn."""
    cameras: option.File = None
    """Camera file: a JSON list, a cameras.json of a 3DGS trainer, a camera_path.json of nerfstudio; or the
    model folder that has one."""
    data: option.Folder = None
    """Data set of photographs (COLMAP, NeRF-synthetic, nerfstudio, LLFF): the cameras of its test views."""
    downscale: int = 1
    """With --data: factor by which images are smaller than the photographs."""
    missing: option.Missing = "few"
    elevation: option.Number = None
    """Degrees above the horizon. Default: 15; 0 with --look-around."""
    azimuth: float = 0.0
    """Degrees of the first view: 0 from the front, 90 from the subject's right-hand side in that view."""
    distance: float = 1.0
    """Multiple of the distance from which the subject just fits the image."""
    look_at: option.Point = None
    """Point to look at and to circle, in the coordinates of the file. Default: the middle of the subject."""
    fov: option.Number = None
    """Field of view across the shorter side of the image, degrees. Default: 45; 75 with --look-around."""
    focal_length: option.Number = None
    """Focal length in mm on 35 mm film, whose 36 mm span the image width: 50 is normal, 85 for portraits, 24
    wide. In place of --fov."""
    up: option.Text = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the cameras in a model
    folder, of the file, else -y, as in COLMAP's scenes."""
    width: option.Count = None
    """Image width in pixels. With --cameras or --data, images are scaled to this width."""
    height: option.Count = None
    """Image height in pixels. Default: the width. Not with --cameras or --data."""

    @property
    def moving(self) -> bool:
        """Whether the views make a turntable."""
        return self.cameras is None and self.data is None and self.dome is None

    @property
    def _placed(self) -> bool:
        """Whether an option says where cameras stand or what lens they have."""
        placing = ("dome", "elevation", "azimuth", "distance", "look_at", "fov", "focal_length")
        defaults = {f.name: f.default for f in fields(self)}
        return any(getattr(self, name) != defaults[name] for name in placing)

    def photographs(self, origin: np.ndarray) -> Dataset | None:
        """The data set of --data, relative to ``origin``, or None."""
        if self.data is None:
            return None
        from meshsplats.datasets.folder import load_dataset

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
    ) -> list[Camera]:
        """The cameras, relative to the origin of ``scene``; by default ``count`` views of an orbit, ``side``
        pixels wide. ``photographs``: the result of ``photographs()``, if it is at hand. ``film``: the default
        views follow each other smoothly, as those of --orbit do."""
        self.check()
        for name in ("width", "height"):
            value = getattr(self, name)
            if value is not None and not 1 <= value <= MAX_SIDE:
                raise ValueError(f"--{name} must be a number of pixels from 1 to {MAX_SIDE}, got {value}")
        if self.cameras is not None or self.data is not None:
            if self.data is not None:
                dataset = photographs or self.photographs(scene.origin)
                assert dataset is not None
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
            if not 1 <= self.focal_length <= 2000:
                raise ValueError(f"--focal-length must lie between 1 and 2000 mm, got {self.focal_length}")
            shorter = 36 * min(1.0, lens["height"] / lens["width"])
            fov = float(np.degrees(2 * np.arctan(shorter / (2 * self.focal_length))))
        if self.look_around is not None:
            lens["elevation"] = 0.0 if self.elevation is None else self.elevation
            lens["fov"] = 75.0 if fov is None else fov
            return look_around(scene, self.look_around, azimuth=self.azimuth, **lens)
        if not self._placed:
            size, told = (width, lens["height"]), None if self.up is None else lens["up"]
            number = count if self.orbit is None else self.orbit
            film = (film or self.orbit is not None) and number > 1
            if views := views_of_a_place(scene, source, number, side=size, up=told, film=film):
                return views
        lens["fov"] = 45.0 if fov is None else fov
        target = None if self.look_at is None else np.subtract(self.look_at, scene.origin)
        lens |= {"distance": self.distance, "target": target}
        if self.dome is not None:
            return dome(scene, self.dome, **lens)
        lens["elevation"] = 15.0 if self.elevation is None else self.elevation
        return orbit(scene, count if self.orbit is None else self.orbit, azimuth=self.azimuth, **lens)

    def check(self) -> None:
        """UsageError for options that exclude each other or have no effect."""
        if self.downscale != 1 and (self.data is None or self.width is not None):
            raise UsageError(
                "--downscale has no effect without --data"
                if self.data is None
                else "give --downscale or --width"
            )
        check_data(self.data, self.missing)
        modes = [name for name in EXCLUSIVE_VIEWS[0] if getattr(self, name) is not None]
        if len(modes) > 1:
            raise UsageError(f"give one of {', '.join(map(flag, modes))}, not several")
        if self.fov is not None and self.focal_length is not None:
            raise UsageError("give --fov or --focal-length, not both")
        placing = ("elevation", "azimuth", "distance", "look_at", "fov", "focal_length", "up", "height")
        without_effect = {
            "dome": ("elevation", "azimuth"),
            "look_around": ("distance", "look_at"),
            "cameras": placing,
            "data": placing,
        }
        for mode in modes:
            for name in without_effect.get(mode, ()):
                if getattr(self, name) != next(f.default for f in fields(self) if f.name == name):
                    raise UsageError(f"{flag(name)} has no effect with {flag(mode)}")


@dataclass(frozen=True)
class DrawOptions:
    """How images are rendered."""

    background: option.Text = None
    """Background: white, black, grey, #rrggbb, or r,g,b from 0 to 1. Default: white; with --data that of the
    model folder or of the photographs."""
    samples: option.Count = None
    """Side of the sample grid in each pixel: 2 means 2 x 2. Default: what the mesh needs at this size, 2 to
    8; 1 for splats, whose filter is as wide as a pixel. compare: of the mesh."""
    sh_degree: option.Count = None
    """Render splats with spherical harmonics up to this degree, 0 to 3. Default: all that are stored."""
    max_layers: option.Count = None
    """Blend only the nearest N triangles of a mesh at each sample, like N passes of depth peeling. Default:
    all."""
    order: OrderOfBlending = None
    """Order in which the triangles of a mesh are blended: exact at every sample, or whole splats by their
    centres. Default: that of the mesh."""
    threads: option.Threads = None
    device: Literal["cpu", "gpu"] = "cpu"
    """Where meshes are rendered. gpu: by WebGPU, on any graphics card (extra gpu)."""

    def check_device(self) -> None:
        """Raises MissingDependencyError or DeviceError if there is no such device."""
        from meshsplats.rendering.devices import engine

        engine(self.device).check()


def views_of_a_place(
    scene: GaussianCloud | SplatMesh, source: Path, count: int, **options: Any
) -> list[Camera] | None:
    """``default_views``; says where they come from."""
    from meshsplats.viewpoints.showing import default_views

    if (shown := default_views(scene, source, count, **options)) is None:
        return None
    say(shown[1])
    return shown[0]


def announce_cost(
    scene: SplatMesh | GaussianCloud, cameras: Sequence[Camera], samples: int, threads: int | None
) -> None:
    """Says before the work how long images may take, where layers upon layers make it long."""
    from meshsplats.rendering.layers import MANY_LAYERS, estimated_seconds, layers

    count = layers(scene, cameras[0])
    if (
        count > MANY_LAYERS
        and (seconds := estimated_seconds(scene, cameras, samples, threads)) > LONG_SECONDS
    ):
        long = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
        say(f"about {count:,.0f} layers lie over each other at each pixel: this may take about {long}")
