"""Images of splats, meshes and tilesets from many cameras, as the contents of files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from meshsplats.cameras.files import load_cameras
from meshsplats.cluster import Shared, Workers
from meshsplats.formats.outputs import CAMERAS, CONFIGURATION, recorded_options, view_names
from meshsplats.images.writing import encode_array, encode_depth_png, encode_image, straight_rgba
from meshsplats.rendering import render, render_splats
from meshsplats.rendering.samples import needed_samples
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.order import Order
from meshsplats.tiles.drawing import MAX_ERROR, render_tiles, samples_for
from meshsplats.tiles.tileset import Tileset

Scene = GaussianCloud | SplatMesh | Tileset


@dataclass(frozen=True)
class FrameOptions:
    """How images are drawn; ``render`` and ``render_splats`` describe what has no word here."""

    background: tuple[float, ...] = (1.0, 1.0, 1.0)
    """Display RGB."""
    transparent: bool = False
    """Images have an alpha channel; ``background`` should be black."""
    samples: int | None = None
    """None: what the scene needs; 1 for splats."""
    sh_degree: int | None = None
    max_layers: int | None = None
    cutoff: float | None = None
    order: Order | None = None
    device: Literal["cpu", "gpu"] = "cpu"
    depth: Literal["none", "png", "npy"] = "none"
    """Depth images of meshes: 16-bit PNG, in steps of ``depth_unit``, or float arrays."""
    depth_unit: float | None = None
    """See ``depth_unit``."""
    max_error: float = MAX_ERROR
    """Largest geometric error of the tiles of a tileset, in pixels."""

    def for_scene(self, scene: Scene, cameras: Sequence[Camera]) -> FrameOptions:
        """These options with the number of samples, and with the background as ``scene`` is blended."""
        background, samples = self.background, self.samples
        if isinstance(scene, SplatMesh) and scene.blending == "linear":
            background = tuple(srgb_to_linear(np.array(background)).tolist())
        if samples is None:
            if isinstance(scene, GaussianCloud):
                samples = 1
            elif isinstance(scene, SplatMesh):
                samples = needed_samples(scene, cameras)
            else:
                samples = samples_for(scene, cameras, self.max_error)
        return replace(self, background=background, samples=samples)


def draw_frames(
    scene: Scene,
    cameras: Sequence[Camera],
    options: FrameOptions,
    *,
    workers: Workers,
    load: Callable[[], Scene],
) -> Iterator[tuple[int, tuple[bytes, bytes | None]]]:
    """The contents of the image file of each camera, and of the depth file if there is one, with the camera's
    index, as they are finished. ``options``: as ``for_scene`` returns them. ``load``: gives workers in other
    processes the ``scene``."""
    shared = Shared(load)
    shared.hold(scene)
    return workers.run(_Frames(shared, options, workers.threads).draw, cameras)


def depth_unit(points: np.ndarray, cameras: Sequence[Camera]) -> float:
    """Scene units per step of a 16-bit depth image: the farthest of ``points`` (n, 3) in all views fits."""
    corners = points if len(points) else np.zeros((1, 3), np.float32)
    farthest = max(
        float((corners @ c.world_to_camera[2, :3] + c.world_to_camera[2, 3]).max()) for c in cameras
    )
    return max(farthest, 1e-6) / 65535


def remove_older(folder: Path, kept: Sequence[Path]) -> None:
    """Removes the images of an earlier 'meshsplats render' into ``folder``, which its records name, except
    ``kept``."""
    if recorded_options(folder / CONFIGURATION, "render") is None:
        return
    try:
        count = len(load_cameras(folder / CAMERAS))
    except (OSError, ValueError):
        return
    names = [f"turntable.{kind}" for kind in ("webp", "gif", "png")]
    for prefix, suffix in (("view", ".png"), ("depth", ".png"), ("depth", ".npy")):
        names += view_names(count, prefix, suffix)
    for name in names:
        if folder / name not in kept:
            (folder / name).unlink(missing_ok=True)


@dataclass(frozen=True)
class _Frames:
    """Draws the images, each in a task."""

    scene: Shared[Scene]
    options: FrameOptions
    threads: int | None

    def draw(self, camera: Camera) -> tuple[bytes, bytes | None]:
        scene, chosen = self.scene.get(), self.options
        common: dict[str, Any] = {
            "background": chosen.background,
            "samples": chosen.samples,
            "threads": self.threads,
        }
        if isinstance(scene, GaussianCloud):
            drawn = render_splats(scene, camera, sh_degree=chosen.sh_degree, **common)
        else:
            common |= {"max_layers": chosen.max_layers, "depth": chosen.depth != "none"}
            common |= {"cutoff": chosen.cutoff, "order": chosen.order, "device": chosen.device}
            if isinstance(scene, Tileset):
                drawn = render_tiles(scene, camera, max_error=chosen.max_error, **common)
            else:
                drawn = render(scene, camera, **common)
        image = straight_rgba(drawn.color, drawn.alpha) if chosen.transparent else drawn.color
        if isinstance(scene, SplatMesh) and scene.blending == "linear":
            image[..., :3] = linear_to_srgb(image[..., :3])
        content = encode_image("view.png", image)
        if drawn.depth is None:
            return content, None
        mean = drawn.mean_depth(empty=0)
        unit = chosen.depth_unit
        return content, encode_array(mean) if unit is None else encode_depth_png(mean, unit)
