"""Options of commands and programs that draw splats and meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from meshsplats._common.words import optional_color
from meshsplats.scene.order import Order

if TYPE_CHECKING:
    from meshsplats.scene.camera import Camera
    from meshsplats.scene.gaussians import GaussianCloud
    from meshsplats.scene.mesh import SplatMesh

LONG_SECONDS = 10
"""Images that take longer than this, as far as can be estimated, are announced."""


@dataclass(frozen=True)
class DrawingOptions:
    """How images are rendered."""

    background: str | None = None
    """Background: white, black, grey, #rrggbb, or r,g,b from 0 to 1. Default: white; with ``data`` that of
    the model folder or of the photographs."""
    samples: int | None = None
    """Side of the sample grid in each pixel: 2 means 2 x 2. Default: what the mesh needs at this size, 2 to
    8; 1 for splats, whose filter is as wide as a pixel. compare: of the mesh."""
    sh_degree: int | None = None
    """Render splats with spherical harmonics up to this degree, 0 to 3. Default: all that are stored."""
    max_layers: int | None = None
    """Blend only the nearest N triangles of a mesh at each sample, like N passes of depth peeling. Default:
    all."""
    order: Order | None = None
    """Order in which the triangles of a mesh are blended: exact at every sample, or whole splats by their
    centres. Default: that of the mesh."""
    threads: int | None = None
    """Maximum number of threads. Default: all processors."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Where meshes are rendered. gpu: by WebGPU, on any graphics card (extra gpu)."""

    @property
    def color(self) -> tuple[float, float, float] | None:
        """``background`` as display RGB; None where it is not given. ValueError for what is no colour."""
        return optional_color(self.background)

    def check_device(self) -> None:
        """Raises MissingDependencyError or DeviceError if there is no such device."""
        from meshsplats.rendering.devices import engine

        engine(self.device).check()


def announce_cost(
    scene: SplatMesh | GaussianCloud,
    cameras: Sequence[Camera],
    samples: int,
    threads: int | None,
    say: Callable[[str], object],
) -> None:
    """Says before the work how long images may take, where layers upon layers make it long, or a single
    image is long: progress tells of many."""
    from meshsplats.rendering.layers import MANY_LAYERS, estimated_seconds, layers

    camera = cameras[0]
    count = layers(scene, camera)
    many = count > MANY_LAYERS
    if (seconds := estimated_seconds(scene, cameras if many else [camera], samples, threads)) > LONG_SECONDS:
        long = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
        if many:
            say(f"about {count:,.0f} layers overlap at each pixel (overdraw): this may take {long}")
        else:
            size = f"{camera.width:,} x {camera.height:,} pixels of {samples} x {samples} samples"
            say(f"{size} take about {long} or more")
