"""Options of the commands that make images: cameras, sizes, how images are rendered, what they cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from meshsplats._options import changed
from meshsplats.camera import Camera
from meshsplats.cli import option
from meshsplats.cli.arguments import as_cli_options
from meshsplats.cli.common import check_data
from meshsplats.cli.messages import UsageError, flag, say
from meshsplats.datasets.scene_views import SceneViews
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

OrderOfBlending = Annotated[
    Literal["fragment", "splat"] | None, tyro.conf.arg(metavar="{fragment,splat}", help_behavior_hint="")
]
EXCLUSIVE_VIEWS = (("orbit", "dome", "look_around", "cameras", "data"), ("fov", "focal_length"))
"""Options of views of which one may be given."""
LONG_SECONDS = 10
"""Images that take longer than this, as far as can be estimated, are announced."""


@as_cli_options(
    metavars={"cameras": "FILE", "data": "FOLDER", "look_at": "X Y Z", "up": "TEXT"}, presets=False
)
class ViewOptions(SceneViews):
    """Cameras and image size. Orbit, dome, look-around, cameras and data exclude each other."""

    def check(self) -> None:
        """UsageError for options that exclude each other or have no effect."""
        if self.downscale != 1 and (self.data is None or self.width is not None):
            idle, both = "--downscale has no effect without --data", "give --downscale or --width"
            raise UsageError(idle if self.data is None else both)
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
                if name in changed(self):
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
